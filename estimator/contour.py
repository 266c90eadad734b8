"""Where the determinant of the path likelihood is summed: beside the imaginary axis, past the slowest mode.

From the path to the force the way is causal, so its Jacobian is that of the highest derivatives, whatever the rest of
the law: in terms of the modes p of the linearised rotor, Im p > 0, with T the length of the record,

    sum over the band of log |det A|^2 = -T sum of Re p + what does not depend on the parameters.

Along the imaginary axis the sum gives T sum |Re p| (Jensen's formula) and cannot tell a mode that grows from one that
decays as fast: the likelihood had a second maximum at the mirror image, k of a cross-coupling near whirl came out 50 %
high and c as much too low. And a mode narrower than the spacing of the bins is summed by chance. Along s = shift + iw
every mode lies to the left, shift - Re p away, and the sum is linear in Re p. A mode that a step takes across the line
shows in the phase of det A, which then turns the other way about it (`turns`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
MARGIN = 1.0  # of the spacing of the bins, at least, from any mode to the line: a sum is then good to exp(-2 pi)


@dataclass(frozen=True, slots=True)
class Contour:
    """s : (bins,) rad/s. offset : what the way there adds to 2 sum log |det A| of a block of the record, nats."""

    s: Complexes
    offset: float


def contour(A: Complexes, mass: Array, D: Array, f_hz: Array) -> Contour:
    """The line for a mean response A (bins, places, places) kg at f_hz, evenly spaced but for gaps, and mean tangents
    D (places, places, 2) of displacement and velocity, N/m and N s/m."""
    iw: Complexes = np.asarray(2j * np.pi * f_hz, dtype=np.complex128)
    length = 1.0 / float(np.diff(f_hz).min())
    resonance = np.sqrt(np.median(np.maximum(np.diag(D[..., 0]) / mass, 0.0)))
    near = int(np.argmin(np.abs(iw.imag - resonance)))
    modes = modes_at(A[near], mass, iw[near], (f_hz[0], f_hz[-1]))
    shift, turned = past(modes, MARGIN / length, (f_hz[0], f_hz[-1]))
    return Contour(shift + iw, length * shift * turned / np.pi)


def past(modes: Complexes, margin_hz: float | Array, band: tuple[float, float]) -> tuple[float, float]:
    """The shift of the line past the slowest of the modes of the band, (0, 0) where none is near the axis; and rad by
    which det A turns along a line half-way, each mode taken as one to its left: a block of T seconds has T / pi of that
    for each rad/s of shift.

    margin_hz : from each mode to the line, at least.
    """
    if modes.size == 0 or (shift := float((modes.real + 2 * np.pi * margin_hz).max())) <= 0.0:
        return 0.0, 0.0
    low, high = 2 * np.pi * band[0], 2 * np.pi * band[1]
    r, w = 0.5 * shift - modes.real, modes.imag
    turned = np.pi - np.arctan(r / (high - w)) - np.arctan(r / (w - low)) + np.arctan(r / (low + w))
    turned -= np.arctan(r / (high + w)) + 2 * (np.arctan(0.5 * shift / low) - np.arctan(0.5 * shift / high))
    return shift, float(turned.sum())


def modes_at(A: Complexes, mass: Array, s: complex, band: tuple[float, float]) -> Complexes:
    """(modes,) rad/s of those in the band, Hz, of m s^2 + c s + k, real: s^2 A at s = iw."""
    P = mass.size
    rest = (A - np.diag(mass)) * s**2
    free = np.zeros((2 * P, 2 * P))
    free[:P, P:] = np.eye(P)
    free[P:] = -np.hstack([rest.real, rest.imag / s.imag]) / mass[:, None]
    modes = np.linalg.eigvals(free)
    return np.asarray(modes[(modes.imag > 2 * np.pi * band[0]) & (modes.imag < 2 * np.pi * band[1])], np.complex128)


def modes_of(A: Complexes, mass: Array, f_hz: Array, size: Array | None = None) -> Complexes:
    """The same of A (f, places, places), as it is where its determinant is least. size : (f,) |det A|, if known."""
    near = int(np.argmin(np.abs(np.linalg.det(A)) if size is None else size))
    return modes_at(A[near], mass, 2j * np.pi * f_hz[near], (f_hz[0], f_hz[-1]))


def along(s: Complexes, A: Complexes, mass: Array, D: Array) -> Complexes:
    """A, known at i Im s, at s: (bins, places, places). The stiffness is taken to be the same in both."""
    if not s.real.any():
        return A
    iw, s = 1j * s.imag[:, None, None], s[:, None, None]
    return np.asarray(np.diag(mass) + (A - np.diag(mass) - D[..., 1] / iw) * (iw / s) ** 2 + D[..., 1] / s)


def turns(determinant: Complexes) -> float:
    """rad by which det A (bins,) turns along a line: pi for every mode that lies to the left, -pi to the right."""
    return float(np.angle(determinant[1:] / determinant[:-1]).sum())
