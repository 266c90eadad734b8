"""How far ahead to look before a sample counts as missing: what was held up comes late, and then faster than sent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BUNCHED_REL = 1.25  # times the rate: frames that come so fast were held up, and the look-ahead goes on behind them
LEAST_BUNCHED_SHARE = 0.25  # of the look-ahead; of fewer, it sees the end anyhow
MOST_BUNCHED = 32  # look-aheads: of one sample, so that a device that has become faster is not waited for without end

F64Array = NDArray[np.float64]
I64Array = NDArray[np.int64]


def look_ahead_ends(t_ns: I64Array, ahead: int, ahead_ns: float) -> I64Array:
    """(n,) where the look-ahead of each sample ends: `ahead` samples on; where more came in that time, behind these.

    What a host, an adapter or a gateway held up while it stood still comes faster than it was sent.
    """
    n = len(t_ns)
    start = np.arange(n)
    ends = start + ahead
    passed_ns = t_ns
    if n and (t_ns[1:] < t_ns[:-1]).any():  # a clock that is set back goes on
        passed_ns = np.concatenate([[0], np.cumsum(np.maximum(np.diff(t_ns), 0))])
    bunched = np.zeros(n, bool)
    bunched[: max(0, n - ahead)] = BUNCHED_REL * (passed_ns[ahead:] - passed_ns[:-ahead]) < ahead_ns
    end = slice(max(0, n - ahead), n)
    seen = n - 1 - start[end]
    took_ns = passed_ns[-1:] - passed_ns[end]
    bunched[end] = (BUNCHED_REL * took_ns < seen * (ahead_ns / ahead)) & (seen > LEAST_BUNCHED_SHARE * ahead)
    if not bunched.any():
        return ends
    in_time = np.searchsorted(passed_ns, passed_ns + round(ahead_ns))
    in_time += in_time == n  # not there yet
    ends = np.where(bunched, in_time, ends)
    while True:  # not into the midst of what was held up
        inside = np.minimum(ends, n - 1)
        farther = np.where(bunched[inside] & (ends < n), ends[inside], ends)
        if (farther == ends).all():
            break
        ends = farther
    return np.maximum.accumulate(np.minimum(ends, start + MOST_BUNCHED * ahead))


def earliest_ahead(lag: F64Array, ends: I64Array) -> F64Array:
    """(n,) minimum of lag from each sample to before its end, by doubling the window."""
    n = len(lag)
    ahead = ends - np.arange(n)
    same = bool((ahead == ahead[0]).all())
    width = np.minimum(ends, n) - np.arange(n)
    most, covers = int(ahead[0] if same else width.max()), 1
    result, window = lag.copy(), lag.copy()
    while True:
        if not same:
            own = np.flatnonzero((width >= covers) & (width < 2 * covers))
            result[own] = np.minimum(window[own], window[own + width[own] - covers])
        if 2 * covers > most:
            break
        _widen(window, covers)
        covers *= 2
    if same:
        _widen(window, most - covers)
        return window
    return result


def _widen(window: F64Array, step: int) -> None:
    """In place: the minimum of each with the one `step` behind it."""
    if 0 < step < len(window):
        window[:-step] = np.minimum(window[:-step], window[step:])
    elif step:
        window[:] = np.minimum.accumulate(window[::-1])[::-1]
