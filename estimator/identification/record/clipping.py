"""Clipped channels, from the raw samples alone."""

from __future__ import annotations

import numpy as np
from scipy.special import betainc

from estimator.arrays import Array

from .thresholds import RECORD_LIMITS


def clipping_level(y: Array) -> tuple[float, int] | None:
    """Level of a clipped channel and number of samples at it.

    The density of any vibration falls towards its extremes. A limiter collects all samples beyond its level in one
    value, or in a narrow range if noise is added after it.

    Parameters
    ----------
    y : (n,) float64
        Samples of one channel, any unit; NaN where a sample is missing.

    Returns
    -------
    tuple of (float, int) or None
        Level in the unit of ``y`` and number of samples at it; None if the channel is not clipped or has under 1000
        samples.
    """
    y = np.ascontiguousarray(y)  # a column is read five times
    if np.count_nonzero(np.isfinite(y)) < 1000:
        return None
    low, high = np.nanmin(y), np.nanmax(y)
    reach = RECORD_LIMITS.extreme_range_rel * (high - low)
    ends = _pileup(y[y >= high - reach]), _pileup(-y[y <= low + reach])
    found = [end for end in ends if end is not None]
    if found:
        return max(level for level, _ in found), sum(count for _, count in found)
    top = float(max(high, -low))
    near = (1.0 - RECORD_LIMITS.extreme_range_rel) * top
    size = np.abs(y[(y > near) | (y < -near)])
    if size.size <= 40:
        return None
    # no noise: the same crest again and again
    if len(np.unique(np.round(size / top, 6))) <= RECORD_LIMITS.max_repeated_values:
        return None
    edge = np.partition(size, -20)[-20:].mean()  # a spike in the noise does not make the level
    at = int(np.sum(size > 0.993 * edge))
    before = int(np.sum((size > 0.965 * edge) & (size <= 0.979 * edge)))
    if at > 40 and at > 3 * before + 40 and top < 1.3 * edge:
        return float(np.median(size[size > 0.993 * edge])), at
    return None


def _pileup(z: Array) -> tuple[float, int] | None:
    """Largest of some values and number of those that have it; None if a falling density allows as many."""
    top = z.max()
    equal = z >= top - RECORD_LIMITS.rounding_rel * abs(top)
    count = int(np.count_nonzero(equal))
    below = z[~equal]
    if count <= RECORD_LIMITS.min_pile_samples or not below.size:
        return None
    next_count = np.count_nonzero(below >= below.max() - RECORD_LIMITS.rounding_rel * abs(top))
    return (float(top), count) if count > 3 * next_count + RECORD_LIMITS.min_pile_samples else None


def pileup_p_value(count: int) -> float:
    """p-value of a pile-up of `count` samples.

    The next value has a third of the samples beyond `min_pile_samples`; under a falling density both are equally
    likely.

    Parameters
    ----------
    count : int
        Samples at the extreme value.
    """
    return float(betainc(count, max(count - RECORD_LIMITS.min_pile_samples, 0) / 3 + 1, 0.5))
