"""Weights that leave moving lines out of the likelihood, block by block.

A run-up moves the shaft orders through the band. A line is a bin of the residual force of a block, summed over the
places, that exceeds the bins four to ten bins away on both sides; no resonance does so. Weak lines are found in a
running average over the last blocks: by frequency, or by shaft order where a tacho gives the speed, so that a line does
not move while the speed changes. The bins of a line get weight 0 and its neighbours count for them, so the sums remain
those of a smooth spectrum, and the likelihood and its Jacobian stay unchanged.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.arrays import Array

AnyComplexes = NDArray[np.complex128] | NDArray[np.complex64]
FALSE_ALARMS_PER_BLOCK = 1e-4
NEAR_BINS, FAR_BINS = 4, 10  # range of the neighbours that a bin is compared with
AVERAGED_BLOCKS = 5.0  # memory of the running average
INDEPENDENT_SHARE = 0.5  # of neighbouring bins under the window, and of neighbouring blocks


@cache
def _limit(bins: int, places: int, blocks: float) -> float:
    """Ratio of a bin to the larger of its two sides that noise exceeds in FALSE_ALARMS_PER_BLOCK of the blocks."""
    from scipy.stats import f

    own = 2.0 * places * max(1.0, 1.5 * INDEPENDENT_SHARE * blocks)
    return float(f.isf(FALSE_ALARMS_PER_BLOCK / bins, own, own * (FAR_BINS - NEAR_BINS + 1) * INDEPENDENT_SHARE))


@njit(cache=True, error_model="numpy", nogil=True)
def _stand_out(power, limit, out):  # type: ignore[no-untyped-def]
    """Fill out (n,) with the result of `line_ratio`; the sides are running sums, mirrored at the ends."""
    n, reach = power.size, FAR_BINS - NEAR_BINS + 1
    sums = np.empty(n + 2 * FAR_BINS + 1)
    sums[0] = 0.0
    for i in range(n + 2 * FAR_BINS):
        k = abs(i - FAR_BINS)
        sums[i + 1] = sums[i] + power[k if k < n else 2 * (n - 1) - k]
    for i in range(n):
        below, above = sums[i + reach] - sums[i], sums[i + 2 * FAR_BINS + 1] - sums[i + FAR_BINS + NEAR_BINS]
        ratio = power[i] / max(max(below, above) / reach, 1e-300)
        out[i] = ratio if ratio > limit else 0.0


def line_ratio(power: Array, places: int, blocks: float) -> Array:
    """(bins,) ratio of each bin to its surroundings if it is a line, else 0. power : mean over `blocks` blocks."""
    out = np.empty(power.size)
    _stand_out(power, _limit(power.size, places, round(blocks, 1)), out)
    return out


def line_bins(ratio: Array) -> NDArray[np.bool_]:
    """(bins,) whether a bin is left out: lines, and their neighbours as far as the window leaks."""
    out = np.zeros(ratio.size, bool)
    for k in np.flatnonzero(ratio):
        half = 3 if ratio[k] < 300.0 else 4 if ratio[k] < 1e5 else 10
        out[max(k - half, 0) : k + half + 1] = True
    return out


def bin_weights(out: NDArray[np.bool_]) -> Array:
    """(bins,) weights: 0 for bins left out, more for the neighbours on both sides, so that the sum stays."""
    w = np.ones(out.size)
    w[out] = 0.0
    kept = np.flatnonzero(~out)
    if kept.size == 0:
        return w
    edges = np.flatnonzero(np.diff(np.concatenate([[False], out, [False]]).astype(np.int8)))
    for a, b in edges.reshape(-1, 2):
        at, half = int(np.searchsorted(kept, a)), -(-(b - a) // 2)
        beside = kept[max(at - half, 0) : at + half]
        w[beside] += (b - a) / beside.size
    return w


class MovingLines:
    """Weights of the bins of the next block. orders : whether the average is by shaft order, not by frequency."""

    def __init__(self, f_hz: Array, orders: bool = False) -> None:
        self._f_hz, self._orders = f_hz, orders
        self._mean = np.zeros(f_hz.size)
        self._blocks = 0.0
        self._speed_hz = 0.0  # that the axis of the average is scaled to

    def restart(self) -> None:
        """Forget the average, as after a gap."""
        self._mean[:] = 0.0
        self._blocks = 0.0

    def __call__(self, force: AnyComplexes, speed_hz: float | None = None) -> Array | None:
        """(bins,) weights for the block with this force spectrum (places, bins); None if nothing is left out.

        speed_hz : of the shaft during the block, where a tacho gives it.
        """
        each = np.square(force.real, dtype=np.float64) + np.square(force.imag, dtype=np.float64)
        power = (1.0 / np.maximum(each.mean(axis=1), 1e-300)) @ each
        places = len(force)
        out = line_bins(line_ratio(power, places, 1.0))
        scale = 1.0
        if self._orders and speed_hz is not None and speed_hz > 0.0:
            self._speed_hz = self._speed_hz or speed_hz
            scale = speed_hz / self._speed_hz
        by_order = power if scale == 1.0 else np.interp(self._f_hz * scale, self._f_hz, power)
        keep = 1.0 - 1.0 / AVERAGED_BLOCKS
        self._mean = keep * self._mean + by_order
        self._blocks = keep * self._blocks + 1.0
        if self._blocks > 0.5 * AVERAGED_BLOCKS:
            averaged = line_bins(line_ratio(self._mean / self._blocks, places, 2.0 * self._blocks - 1.0))
            if averaged.any():
                out |= averaged if scale == 1.0 else np.interp(self._f_hz / scale, self._f_hz, averaged) > 0.0
        return bin_weights(out) if out.any() else None
