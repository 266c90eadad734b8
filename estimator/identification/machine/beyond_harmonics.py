"""What of a line in the motion is a force: beside strong lines the laws of a model make others of them, harmonics and
sums, which a linear reading of the motion takes for forces. The inferred force has what the laws do not explain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.signals.band_limit import passband

from .harmonic_fit import PIECES, demodulate

HEARD = 0.9  # gain of the band filter from where a frequency counts as in the band
LEAST = 0.5  # of the amplitude by a linear reading: with less left the laws explain the line


def residual_harmonics(point: WorkingPoint, i: int, angle: Array, count: int) -> Complexes:
    """(count,) N of the inferred force at place i over an angle (n,), under a window that keeps other lines out."""
    window = np.sin(np.pi * (np.arange(PIECES) + 0.5) / PIECES) ** 2
    return np.asarray(np.average(demodulate(point.force[i], angle, count), axis=0, weights=window))


def residual_tells(point: WorkingPoint, f_hz: Array) -> NDArray[np.bool_]:
    """(f,) where the inferred force says more than a linear reading: in the band, beside laws."""
    if not point.placed:
        return np.zeros(f_hz.size, bool)
    return np.asarray(passband(f_hz, point.data.rate_hz, point.data.band) > HEARD)
