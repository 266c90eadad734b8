"""Single samples far outside all others: no vibration, as no signal that passed an anti-alias filter has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array

from .thresholds import PIECE_ROWS, RECORD_LIMITS


def robust_scale(y: Array) -> tuple[float, float]:
    """Median of a channel (n,), and the standard deviation of a Gaussian with its median absolute deviation.

    Of a long channel they are of samples drawn at random: their error is 0.4 % of the deviation. NaN with fewer
    than 16 finite samples.
    """
    if y.size > RECORD_LIMITS.max_median_samples:
        y = y[np.random.default_rng(0).integers(0, y.size, RECORD_LIMITS.max_median_samples)]
    z = y[np.isfinite(y)].astype(np.float64, copy=False)
    if z.size < RECORD_LIMITS.min_samples:
        return np.nan, np.nan
    centre = float(np.median(z))
    with np.errstate(over="ignore"):
        return centre, float(np.median(np.abs(z - centre))) / RECORD_LIMITS.gaussian_mad


def surely_without_spikes(y: Array) -> NDArray[np.bool_]:
    """(channels,) whether a short channel stays below half of the limit of a spike, by the scale of a few samples.

    Medians of all samples would be a third of the cost of a live estimate. y : (n, channels).
    """
    if not 4 * RECORD_LIMITS.few_samples < len(y) < PIECE_ROWS:
        return np.zeros(y.shape[1], bool)
    few = y[:: max(1, len(y) // RECORD_LIMITS.few_samples)]
    with np.errstate(over="ignore", invalid="ignore"):
        centre = np.median(few, axis=0)
        sd = np.median(np.abs(few - centre), axis=0) / RECORD_LIMITS.gaussian_mad
        reach = np.maximum(y.max(axis=0) - centre, centre - y.min(axis=0))
        return np.asarray((reach < 0.5 * RECORD_LIMITS.min_spike_sd * sd) & (sd < np.inf))


def spike_rows(y: Array) -> NDArray[np.intp]:
    """Rows of the spikes of a channel.

    Parameters
    ----------
    y : (n,) float64 or float32
        Samples in any unit; NaN where one is missing.

    Returns
    -------
    (k,) int
        Empty where the channel has fewer than 16 samples, or half of them have one value.
    """
    centre, sd = robust_scale(y)
    if not 0.0 < sd < np.inf:
        return np.zeros(0, dtype=np.intp)
    limit = RECORD_LIMITS.min_spike_sd * sd
    with np.errstate(over="ignore", invalid="ignore"):
        rows = np.concatenate(
            [
                first + np.flatnonzero(np.abs(y[first : first + PIECE_ROWS] - centre) > limit)
                for first in range(0, y.size, PIECE_ROWS)
            ]
        )
        rows = rows[np.isfinite(y[rows])]
    if not rows.size or rows.size > max(RECORD_LIMITS.max_spike_share * y.size, 2):
        return np.zeros(0, dtype=np.intp)

    def size(at: NDArray[np.intp]) -> Array:
        """Distance of some samples from the median in robust standard deviations; 0 where one is missing."""
        own = np.asarray(y[at], np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.where(np.isfinite(own), np.abs(own - centre) / sd, 0.0)

    near = np.ones(rows.size)
    for shift in RECORD_LIMITS.neighbour_rows:
        at = rows + shift
        inside = (at >= 0) & (at < y.size)
        near = np.maximum(near, np.where(inside, size(np.clip(at, 0, y.size - 1)), 0.0))
    # at an end of the samples the neighbours on one side are unknown: a shock may begin there
    least = np.where((rows < 2) | (rows >= y.size - 2), RECORD_LIMITS.min_spike_ratio * RECORD_LIMITS.min_spike_sd, 0.0)
    return np.asarray(rows[size(rows) > np.maximum(RECORD_LIMITS.min_spike_ratio * near, least)], dtype=np.intp)
