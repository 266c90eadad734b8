"""Harmonics of the residual force: the part of a line in the motion that the laws of the model do not explain.

Nonlinear laws make harmonics and sums of strong lines. The mean tangent reads them as forces; the residual force, from
which the laws are subtracted, holds real forces only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.signals.band_limit import passband

from .harmonic_fit import RECORD_PIECES, demodulate

MIN_BAND_GAIN = 0.9  # of the band filter, at a frequency that counts as in the band
MIN_UNEXPLAINED_REL = 0.5  # residual amplitude over that by the mean tangent: with less the laws explain the line


def residual_harmonics(point: WorkingPoint, i: int, angle: Array, count: int) -> Complexes:
    """(count,) harmonics of the residual force at location i over an angle (n,) rad, N, under a window."""
    window = np.sin(np.pi * (np.arange(RECORD_PIECES) + 0.5) / RECORD_PIECES) ** 2
    return np.asarray(np.average(demodulate(point.force[i], angle, count), axis=0, weights=window))


def residual_tells(point: WorkingPoint, f_hz: Array) -> NDArray[np.bool_]:
    """(f,) whether the residual force is the better reading of a line: in the band, if the model has laws."""
    if not point.placed:
        return np.zeros(f_hz.size, bool)
    return np.asarray(passband(f_hz, point.data.rate_hz, point.data.band) > MIN_BAND_GAIN)
