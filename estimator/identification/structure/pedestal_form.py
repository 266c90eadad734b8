"""A bearing that stands on a pedestal, as spectra are fitted with one: mass, frequency and damping in a form in which a
search may go anywhere, and what the bearing's stiffness loses by it."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array, Complexes

LOWER_LIMITS, UPPER_LIMITS = np.array([-2.3, 2.0, -6.0]), np.array([3.0, 11.0, -0.36])  # of the three coordinates


def pedestal_starts(peak_hz: float) -> tuple[tuple[float, ...], ...]:
    """Where a search begins, in its form, at a resonance of the cap."""
    return tuple((m, float(np.log(peak_hz * f)), -3.0) for m in (0.0, 1.5) for f in (0.5, 1.2, 2.0, 3.5))


def pedestal_values(z: Array, cap_mass: float) -> Array:
    """(3,) kg, Hz and damping ratio of a point (3,) of the search; of points (3, m, 1) too."""
    return np.asarray((np.exp(np.clip(z.T, LOWER_LIMITS, UPPER_LIMITS)) * [cap_mass, 1.0, 1.0]).T)


def is_at_limit(z: Array) -> bool:
    """Whether a search ended at an end of what a pedestal may be, but for one that is too heavy or stiff to be told."""
    return bool(z[0] <= LOWER_LIMITS[0] or z[1] <= LOWER_LIMITS[1] or z[2] >= UPPER_LIMITS[2])


def pedestal_coordinates(p: Array, cap_mass: float) -> Array:
    """The point of the search with these values."""
    return np.asarray(np.log(p / [cap_mass, 1.0, 1.0]))


def stiffness_lost(w: Array, k: float, c: float, p: Array) -> Complexes:
    """(f,) N/m that the stiffness D = k + i w c of a bearing loses on a pedestal p (3,): D^2 over the sum of both."""
    M, w0, zeta = p[0], 2 * np.pi * p[1], p[2]
    D = k + 1j * w * c
    return np.asarray(D * D / (M * (w0**2 - w**2 + 2j * zeta * w * w0) + D))
