"""Single samples far outside all others: no vibration, as no signal that passed an anti-alias filter has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array

from .thresholds import RECORD_THRESHOLDS, Thresholds

GAUSSIAN_MAD = 0.6745  # median absolute deviation over the standard deviation of a Gaussian
MIN_SAMPLES = 16  # for the robust standard deviation
MAX_SPIKE_SHARE = 0.01  # of the samples: more are no single samples
NEIGHBOUR_ROWS = (-4, -3, -2, 2, 3, 4)  # distances; a spike may have two samples


def spike_rows(y: Array, limits: Thresholds = RECORD_THRESHOLDS) -> NDArray[np.intp]:
    """Rows of the spikes of a channel.

    Parameters
    ----------
    y : (n,) float64
        Samples in any unit; NaN where one is missing.
    limits : Thresholds
        Limits of the checks.

    Returns
    -------
    (k,) int
        Empty where the channel has fewer than 16 samples, or half of them have one value.
    """
    there = np.isfinite(y)
    z = y[there]
    if z.size < MIN_SAMPLES:
        return np.zeros(0, dtype=np.intp)
    with np.errstate(over="ignore", invalid="ignore"):
        centre = np.median(z)
        sd = np.median(np.abs(z - centre)) / GAUSSIAN_MAD
        if not 0.0 < sd < np.inf:
            return np.zeros(0, dtype=np.intp)
        size = np.where(there, np.abs(y - centre) / sd, 0.0)
    rows = np.flatnonzero(size > limits.min_spike_sd)
    if not rows.size or rows.size > max(MAX_SPIKE_SHARE * y.size, 2):
        return np.zeros(0, dtype=np.intp)
    near = np.ones(rows.size)
    for shift in NEIGHBOUR_ROWS:
        at = rows + shift
        inside = (at >= 0) & (at < y.size)
        near = np.maximum(near, np.where(inside, size[np.clip(at, 0, y.size - 1)], 0.0))
    # at an end of the samples the neighbours on one side are unknown: a shock may begin there
    least = np.where((rows < 2) | (rows >= y.size - 2), limits.min_spike_ratio * limits.min_spike_sd, 0.0)
    return rows[size[rows] > np.maximum(limits.min_spike_ratio * near, least)]
