"""The line along which the determinant of the path likelihood is summed: right of the imaginary axis and of all modes.

The map from motion to force is causal, so its Jacobian is that of the highest derivatives, for any law. In the modes p
of the linearised rotor, Im p > 0, with T the length of the record,

    sum over the band of log |det A|^2 = -T sum of Re p + a constant.

Along the imaginary axis the sum is T sum |Re p| (Jensen's formula). It does not distinguish a mode that grows from one
that decays as fast, and the likelihood has a second maximum at the mirror image. Also, a mode narrower than the spacing
of the bins is summed by chance. Along s = shift + iw every mode lies to the left, at the distance shift - Re p, and the
sum is linear in Re p. A mode that a step takes across the line shows in the phase of det A, which then turns the other
way. The line has a wide margin where it is needed, because a law on trial may move a mode far.

At its ends, and where bins are left out, the line returns to the axis, as steep there as far from it. So it has the
ends of the axis, and its sum but for the modes. A straight line without the ways back would bias the slopes.

A disc or a shaft that resonates in the band moves with the caps as modes of the rotor. Its response at s differs from
that at iw, and both are exact. The stiffness of all else is taken to be the same at s and iw.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.model.background import Background
from estimator.model.rotor_matrices import Rotor

MARGIN_BINS = 1.0  # least distance of a mode from the line, spacings of the bins: the error is exp(-2 pi)
WIDE_MARGIN_BINS = 4.0  # distance from the line where one is needed, spacings of the bins


def contour(A: Complexes, mass: Array, D: Array, f_hz: Array, rotor: Rotor | None = None) -> Complexes:
    """(bins,) rad/s, the line.

    A : (bins, places, places) kg, at f_hz, which is evenly spaced but for gaps. mass : (places,) kg. D : (places,
    places, 2) mean tangents by displacement and velocity, N/m and N s/m. rotor : shaft and discs; None without.
    """
    w = 2 * np.pi * f_hz
    length = 1.0 / float(np.diff(f_hz).min())
    resonance = np.sqrt(np.median(np.maximum(np.diag(D[..., 0]) / mass, 0.0)))
    near = int(np.argmin(np.abs(w - resonance)))
    modes = modes_at(A[near], mass, 1j * w[near], rotor)
    band = contiguous_bands(f_hz)
    needed = shift_past_modes(modes, MARGIN_BINS / length, band) > 0.0
    return line_at_shift(w, shift_past_modes(modes, WIDE_MARGIN_BINS / length, band) if needed else 0.0, band)


def line_at_shift(w: Array, shift: float, band: Sequence[tuple[float, float]]) -> Complexes:
    """(w,) rad/s, a line from the axis at the ends of all stretches of w (rad/s) to `shift` rad/s right of it."""
    inside = np.max([np.minimum(w - low, high - w) for low, high in band], axis=0)
    x = np.clip(inside / max(shift, 1e-300), 0.0, 1.0)
    return np.asarray(shift * x**2 * (3.0 - 2.0 * x) + 1j * w, np.complex128)


def contiguous_bands(f_hz: Array) -> list[tuple[float, float]]:
    """First and last rad/s of each stretch of evenly spaced frequencies."""
    w, gaps = 2 * np.pi * f_hz, np.flatnonzero(np.diff(f_hz) > 1.5 * np.diff(f_hz).min())
    return list(zip(w[[0, *(gaps + 1)]].tolist(), w[[*gaps, -1]].tolist(), strict=True))


def shift_past_modes(modes: Complexes, margin_hz: float | Array, band: Sequence[tuple[float, float]]) -> float:
    """rad/s from the axis to the line right of the modes of the band; 0 where no mode is near the axis.

    A mode where bins are left out is not summed, so the line need not pass it.

    modes : (modes,) rad/s. margin_hz : least distance of each mode from the line. band : rad/s, its stretches.
    """
    inside = np.any([(modes.imag > low) & (modes.imag < high) for low, high in band], axis=0)
    return max(float((modes.real + 2 * np.pi * margin_hz)[inside].max(initial=0.0)), 0.0)


def modes_at(A: Complexes, mass: Array, s: complex, rotor: Rotor | None = None) -> Complexes:
    """(modes,) rad/s of the rotor m s^2 + c s + k whose response is s^2 A at s, with the modes of shaft and discs."""
    P, rest = mass.size, (A - np.diag(mass)) * s**2
    if rotor is None:
        M, C, K = (np.zeros((P, P)) for _ in range(3))
    else:
        rest = rest - rotor.dynamic(np.array([s / 1j]))[0]
        M, C, K = rotor.M.copy(), rotor.C.copy(), rotor.K.copy()
    M[range(P), range(P)] += mass
    K[:P, :P] += rest.real
    C[:P, :P] += rest.imag / s.imag
    n = len(M)
    free = np.zeros((2 * n, 2 * n))
    free[:n, n:] = np.eye(n)
    free[n:] = -np.linalg.solve(M, np.hstack([K, C]))
    modes = np.linalg.eigvals(free)
    return np.asarray(modes[modes.imag > 0.0], np.complex128)


def continued_tangent(
    s: Complexes, A: Complexes, mass: Array, D: Array, rotor: Rotor | None = None,
    background: Background | None = None, places: tuple[str, ...] = (),
) -> Complexes:  # fmt: skip
    """(bins, places, places) kg: A at s (bins,), from A at i Im s. D : mean tangents as in `contour`."""
    if not s.real.any():
        return A
    iw, s1 = 1j * s.imag[:, None, None], s[:, None, None]

    def bearings(s: NDArray[Any]) -> Complexes:
        made = np.asarray(D[..., 0] + s[:, None, None] * D[..., 1], np.complex128)
        if background is None:
            return made
        made = made * background.deflections(places, s)[:, None, :]
        np.einsum("fii->fi", made)[...] += background.attached_stiffness(places, s)
        return np.asarray(made)

    there, here = bearings(s), bearings(1j * s.imag)
    moved = (there - here) / s1**2
    out = np.diag(mass) + (A - np.diag(mass)) * (iw / s1) ** 2 + moved
    if rotor is not None:
        out += (rotor.dynamic(s / 1j) - rotor.dynamic(s.imag)) / s1**2
    return np.asarray(out)


def phase_steps(determinant: Complexes) -> Array:
    """(bins - 1,) rad by which det A (bins,) turns along a line: in all pi for a mode left of it, -pi for one right."""
    return np.asarray(np.angle(determinant[1:] / determinant[:-1]), np.float64)
