"""The look-ahead before a sample counts as missing: frames that were held up come late, and then faster than sent.

A loss makes later samples late for good. Samples that a host, an adapter or a gateway held up are late for a while
only, as later samples show. So a sample counts as missing only after a look-ahead in which no sample was held up.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

HELD_UP_SAMPLES = 1.0  # more than frames usually are, a frame is later than one behind it
MOST_LOOK_AHEADS = 32  # of one sample, so that a device that has become uneven is not waited for without end

F64Array = NDArray[np.float64]
I64Array = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def earliest_ahead(lag: F64Array, ahead: int) -> F64Array:
    """(n,) minimum of lag over each sample and the `ahead` - 1 behind it, as far as there are."""
    window, covers = lag.copy(), 1
    while 2 * covers <= ahead:
        _widen(window, covers)
        covers *= 2
    _widen(window, ahead - covers)
    return window


def even_ends(
    lag: F64Array, earliest: F64Array, ahead: int, usual: float, final: bool
) -> tuple[I64Array, BoolArray] | None:
    """Where the look-ahead of each sample ends, and whether it ends in an even one; None if none was held up.

    In an even look-ahead no sample was held up. usual : samples by which frames are late in one.
    final : nothing comes behind the last sample.
    """
    held_up = np.flatnonzero(lag - earliest > usual + HELD_UP_SAMPLES)
    if len(held_up) == 0:
        return None
    start = np.arange(len(lag))
    breaks = np.flatnonzero(np.append(np.diff(held_up) > ahead, True))
    last = held_up[breaks[np.searchsorted(breaks, np.arange(len(held_up)))]]  # of those that follow each other
    following = np.searchsorted(held_up, start)
    near = np.append(held_up, len(lag) + ahead)[following] < start + ahead
    ends = np.where(near, np.append(last, 0)[following] + 1, start) + ahead
    most = start + MOST_LOOK_AHEADS * ahead
    settled = ends <= most
    if final and held_up[-1] + ahead >= len(lag):
        first = int(held_up[breaks[-2] + 1 if len(breaks) > 1 else 0])
        settled[max(0, first - round(2.0 * (usual + HELD_UP_SAMPLES))) :] = False  # those just before may be late, too
    return np.minimum(ends, most), settled


def earliest_until(lag: F64Array, ends: I64Array) -> F64Array:
    """(n,) minimum of lag from each sample to before its end, by doubling the window."""
    width = np.minimum(ends, len(lag)) - np.arange(len(lag))
    most, covers = int(width.max()), 1
    result, window = lag.copy(), lag.copy()
    while True:
        own = np.flatnonzero((width >= covers) & (width < 2 * covers))
        result[own] = np.minimum(window[own], window[own + width[own] - covers])
        if 2 * covers > most:
            return result
        _widen(window, covers)
        covers *= 2


def _widen(window: F64Array, step: int) -> None:
    """In place: the minimum of each with the one `step` behind it."""
    if 0 < step < len(window):
        np.minimum(window[:-step], window[step:], out=window[:-step])
    elif step:
        window[:] = np.minimum.accumulate(window[::-1])[::-1]
