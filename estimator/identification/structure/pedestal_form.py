"""A bearing on a pedestal: coordinates of its mass, frequency and damping in which a search is unbounded.

The coordinates are ln(mass / cap mass), ln(frequency in Hz) and ln(damping ratio).
"""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array, Complexes

LOWER_LIMITS, UPPER_LIMITS = np.array([-2.3, 2.0, -6.0]), np.array([3.0, 11.0, -0.36])  # of the three coordinates


def pedestal_starts(peak_hz: float) -> tuple[tuple[float, ...], ...]:
    """Points of the search from which it starts, for a resonance of the cap at peak_hz."""
    return tuple((m, float(np.log(peak_hz * f)), -3.0) for m in (0.0, 1.5) for f in (0.5, 1.2, 2.0, 3.5))


def pedestal_values(z: Array, cap_mass: float) -> Array:
    """(3,) mass in kg, frequency in Hz and damping ratio at a point (3,) of the search, or (3, m, 1) at m points."""
    return np.asarray((np.exp(np.clip(z.T, LOWER_LIMITS, UPPER_LIMITS)) * [cap_mass, 1.0, 1.0]).T)


def is_at_limit(z: Array) -> bool:
    """Whether a search ended at a limit of the pedestal's range that means that there is none.

    A pedestal too heavy or too stiff to be identified lies at the other limits.
    """
    return bool(z[0] <= LOWER_LIMITS[0] or z[1] <= LOWER_LIMITS[1] or z[2] >= UPPER_LIMITS[2])


def pedestal_coordinates(p: Array, cap_mass: float) -> Array:
    """The point (3,) of the search with these values (3,)."""
    return np.asarray(np.log(p / [cap_mass, 1.0, 1.0]))


def stiffness_lost(w: Array, k: float, c: float, p: Array) -> Complexes:
    """(f,) N/m that the stiffness of a bearing loses on a pedestal p (3,).

    It is D^2 / (D + P), with D = k + i w c of the bearing and P the dynamic stiffness of the pedestal.
    """
    M, w0, zeta = p[0], 2 * np.pi * p[1], p[2]
    D = k + 1j * w * c
    return np.asarray(D * D / (M * (w0**2 - w**2 + 2j * zeta * w * w0) + D))
