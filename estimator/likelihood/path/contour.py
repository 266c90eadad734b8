"""Where the determinant of the path likelihood is summed: beside the imaginary axis, past the slowest mode.

From the path to the force the way is causal, so its Jacobian is that of the highest derivatives, whatever the rest of
the law: in terms of the modes p of the linearised rotor, Im p > 0, with T the length of the record,

    sum over the band of log |det A|^2 = -T sum of Re p + what does not depend on the parameters.

Along the imaginary axis the sum gives T sum |Re p| (Jensen's formula) and cannot tell a mode that grows from one that
decays as fast: the likelihood had a second maximum at the mirror image, k of a cross-coupling near whirl came out 50 %
high and c as much too low. And a mode narrower than the spacing of the bins is summed by chance. Along s = shift + iw
every mode lies to the left, shift - Re p away, and the sum is linear in Re p. A mode that a step takes across the line
shows in the phase of det A, which then turns the other way about it (`turns`). Of a rotor past whirl a law on trial is
to take it far: with the line at a bin from the slowest mode of a model without the cross-coupling, that was in its way.

At its ends, and where bins are left out, the line comes back to the axis, as steep as it is far from it (`line`): it
has the ends of the axis, and so its sum but for the modes. Straight, with the ways there taken as they are at one
point, it left out what they add to the slopes: beside a disc that resonates in the band the delay of what one cap makes
of the other was 3 us off, 4 standard deviations, and c 0.4.

A disc that resonates in the band moves with the caps as a mode of the rotor, sharp as nothing damps it there, and what
it answers at s is not what it answers at iw: with its stiffness taken to be the same, kL was 4 to 7 standard deviations
off, its sum of a mode of 1 Hz at 305 Hz by chance (51.2 kHz, a disc of 1.4 kg, caps of 0.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.model.disc import Disc

MARGIN_BINS = 1.0  # of the spacing of the bins, at least, from any mode to the line: a sum is then good to exp(-2 pi)
WIDE_MARGIN_BINS = 4.0  # of the same, where the line is needed


def contour(
    A: Complexes, mass: Array, D: Array, f_hz: Array, disc: Disc | None = None, places: tuple[str, ...] = ()
) -> Complexes:  # fmt: skip
    """(bins,) rad/s: the line for a mean response A (bins, places, places) kg at f_hz, evenly spaced but for gaps, and
    mean tangents D (places, places, 2) of displacement and velocity, N/m and N s/m. disc : on the shaft between the
    places."""
    w = 2 * np.pi * f_hz
    length = 1.0 / float(np.diff(f_hz).min())
    resonance = np.sqrt(np.median(np.maximum(np.diag(D[..., 0]) / mass, 0.0)))
    near = int(np.argmin(np.abs(w - resonance)))
    modes = modes_at(A[near], mass, 1j * w[near], disc, places)
    band = contiguous_bands(f_hz)
    needed = shift_past_modes(modes, MARGIN_BINS / length, band) > 0.0
    return line_at_shift(w, shift_past_modes(modes, WIDE_MARGIN_BINS / length, band) if needed else 0.0, band)


def line_at_shift(w: Array, shift: float, band: Sequence[tuple[float, float]]) -> Complexes:
    """(w,) rad/s from the axis at the ends of all stretches to `shift` beside it."""
    inside = np.max([np.minimum(w - low, high - w) for low, high in band], axis=0)
    x = np.clip(inside / max(shift, 1e-300), 0.0, 1.0)
    return np.asarray(shift * x**2 * (3.0 - 2.0 * x) + 1j * w, np.complex128)


def contiguous_bands(f_hz: Array) -> list[tuple[float, float]]:
    """rad/s, where the frequencies are evenly spaced: from, to."""
    w, gaps = 2 * np.pi * f_hz, np.flatnonzero(np.diff(f_hz) > 1.5 * np.diff(f_hz).min())
    return list(zip(w[[0, *(gaps + 1)]].tolist(), w[[*gaps, -1]].tolist(), strict=True))


def shift_past_modes(modes: Complexes, margin_hz: float | Array, band: Sequence[tuple[float, float]]) -> float:
    """rad/s from the axis to the line past the slowest of the modes of the band, 0 where none is near the axis.

    margin_hz : from each mode to the line, at least. band : rad/s, its stretches.
    """
    inside = (modes.imag > band[0][0]) & (modes.imag < band[-1][1])
    return max(float((modes.real + 2 * np.pi * margin_hz)[inside].max(initial=0.0)), 0.0)


def modes_at(
    A: Complexes, mass: Array, s: complex, disc: Disc | None = None, places: tuple[str, ...] = ()
) -> Complexes:  # fmt: skip
    """(modes,) rad/s of m s^2 + c s + k, real: s^2 A at s = iw; with a disc on the shaft, of it and the caps."""
    P, rest = mass.size, (A - np.diag(mass)) * s**2
    if disc is None:
        m, C, K = mass, np.zeros((P, P)), np.zeros((P, P))
    else:
        rest = rest - disc.at_caps(places, np.array([s / 1j]))[0]
        discs, C, K = disc.joined(places)
        m = np.concatenate([mass, discs])
    K[:P, :P] += rest.real
    C[:P, :P] += rest.imag / s.imag
    n = m.size
    free = np.zeros((2 * n, 2 * n))
    free[:n, n:] = np.eye(n)
    free[n:] = -np.hstack([K, C]) / m[:, None]
    modes = np.linalg.eigvals(free)
    return np.asarray(modes[modes.imag > 0.0], np.complex128)


def slowest_modes(
    A: Complexes, mass: Array, f_hz: Array, size: Array | None = None, disc: Disc | None = None,
    places: tuple[str, ...] = (),
) -> Complexes:  # fmt: skip
    """The same of A (f, places, places), as it is where its determinant is least. size : (f,) |det A|, if known."""
    near = int(np.argmin(np.abs(np.linalg.det(A)) if size is None else size))
    modes = modes_at(A[near], mass, 2j * np.pi * f_hz[near], disc, places)
    inside = (modes.imag > 2 * np.pi * f_hz[0]) & (modes.imag < 2 * np.pi * f_hz[-1])
    return np.asarray(modes[inside], np.complex128)


def continued_tangent(
    s: Complexes, A: Complexes, mass: Array, D: Array, disc: Disc | None = None, places: tuple[str, ...] = ()
) -> Complexes:  # fmt: skip
    """A, known at i Im s, at s: (bins, places, places). But for the disc's the stiffness is taken to be the same in
    both."""
    if not s.real.any():
        return A
    iw, s1 = 1j * s.imag[:, None, None], s[:, None, None]
    rest = A - np.diag(mass) - D[..., 1] / iw
    out = np.diag(mass) + rest * (iw / s1) ** 2 + D[..., 1] / s1
    if disc is not None:
        out += (disc.at_caps(places, s / 1j) - disc.at_caps(places, s.imag)) / s1**2
    return np.asarray(out)


def phase_steps(determinant: Complexes) -> Array:
    """(bins - 1,) rad by which det A (bins,) turns along a line, in all pi for every mode that lies to the left, -pi to
    the right."""
    return np.asarray(np.angle(determinant[1:] / determinant[:-1]), np.float64)
