"""Places samples that carry no counter: arrival times give the index, at the nominal rate.

A frame can come late (queues, bursts) but never early. So the earliest arrivals within a short look-ahead tell how
many samples have gone by, and a sample is missing only if nothing catches up. The axis follows a clock error of a few
hundred ppm; a faster slip is missing samples.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LOOK_AHEAD_S = 1.0  # a real logger was seen to catch up for 0.7 s after a stall
MAX_LOOK_AHEAD = 4096  # samples
MAX_DRIFT_REL = 5e-4  # relative rate error that is followed
RATE_SAMPLES = 32  # samples needed to estimate a rate

F64Array = NDArray[np.float64]
I64Array = NDArray[np.int64]


class TimeAxis:
    """`place` takes the times of new samples; indices of those that can be placed come out, the rest is held."""

    def __init__(self, rate_hz: float | None) -> None:
        self.rate_hz = rate_hz
        self.stepped_back = 0  # times the clock went back
        self._held = np.empty(0, np.int64)
        self._origin_ns = 0
        self._placed = 0  # samples so far
        self._missing = 0
        self._base: float | None = None
        self._late = 0.0  # samples by which frames have lately been late

    @property
    def held(self) -> int:
        return len(self._held)

    def place(self, t_ns: I64Array, final: bool = False) -> I64Array:
        """Indices of the oldest held samples, as many as are certain; with `final`, of all."""
        times = np.concatenate([self._held, t_ns])
        self._held = times
        self.stepped_back += int((np.diff(t_ns) < -1_000_000).sum())
        if len(times) == 0 or not self._learn(times, final) or self.rate_hz is None:
            return np.empty(0, np.int64)
        if self._base is None:
            self._origin_ns = int(times[0])
        lag = (times - self._origin_ns) * (self.rate_hz / 1e9) - np.arange(self._placed, self._placed + len(times))
        ahead = max(4, min(MAX_LOOK_AHEAD, round(LOOK_AHEAD_S * self.rate_hz)))
        earliest = _earliest(lag, ahead)
        if self._base is None:
            self._base = float(earliest[0])
        missing, sure = self._levels(np.rint(earliest - self._base), len(times) - ahead, ahead, final)
        if sure == 0:
            return np.empty(0, np.int64)
        index = np.arange(self._placed, self._placed + sure) + missing[:sure]
        self._follow(earliest[:sure] - missing[:sure], sure)
        late = float(np.quantile(lag[:sure] - missing[:sure] - self._base, 0.98))
        self._late = max(late, 0.9 * self._late)
        self._held = times[sure:]
        self._placed += sure
        self._missing = int(missing[sure - 1])
        return index

    def _levels(self, behind: F64Array, whole: int, ahead: int, final: bool) -> tuple[I64Array, int]:
        """(n,) samples missing before each, and how many of these are certain.

        A step up counts if it is more than frames have lately been late, or if it lasts for the whole look-ahead.
        """
        n, level = len(behind), self._missing
        raw = np.maximum.accumulate(np.maximum(behind, level)).astype(np.int64)
        result = np.full(n, level, np.int64)
        sure = n
        steps = [*np.flatnonzero(np.diff(raw, prepend=level) > 0).tolist(), n]
        for start, stop in zip(steps[:-1], steps[1:], strict=True):
            if start >= whole and not final:
                sure = min(sure, start)  # a later frame may still catch up
                break
            if raw[start] - level > self._late + 0.5 or stop - start >= ahead:
                level = int(raw[start])
            elif stop == n and not final:
                sure = min(sure, start)
                break
            result[start:] = level
        return result, sure

    def _learn(self, times: I64Array, final: bool) -> bool:
        """Estimate the rate from the first samples, if it was not given."""
        if self.rate_hz is not None:
            return True
        if len(times) < RATE_SAMPLES and not (final and len(times) > 1):
            return False
        steps = np.diff(times)
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        if step == 0.0:
            return False
        even = steps[np.abs(steps - step) < 0.02 * step]
        if len(even) < len(steps) // 2:  # stamps too coarse for that
            even = steps[np.abs(steps - step) <= 0.5 * step]
        self.rate_hz = _round_rate(1e9 / float(np.mean(even if len(even) else step)))
        return True

    def _follow(self, lag: F64Array, n: int) -> None:
        """Move the base line with the device's clock, slowly."""
        base = self._base or 0.0
        error = float(np.median(lag)) - base
        if error < -0.5:  # frames cannot be early: those before were late, or the clock was set back
            self._base = base + error
        else:
            self._base = base + float(np.clip(error, -MAX_DRIFT_REL * n, MAX_DRIFT_REL * n))


def _earliest(lag: F64Array, ahead: int) -> F64Array:
    """(n,) minimum of lag over each sample and the `ahead - 1` after it, by doubling the window."""
    result, width = lag.copy(), 1
    while width < ahead:
        step = min(width, ahead - width)
        if step < len(result):
            result[:-step] = np.minimum(result[:-step], result[step:])
        else:
            result[:] = np.minimum.accumulate(result[::-1])[::-1]
        width += step
    return result


def _round_rate(rate_hz: float) -> float:
    """A rate within 0.1 % of a number of two digits is that number."""
    nice = float(f"{rate_hz:.1e}")
    return nice if abs(nice - rate_hz) < 1e-3 * rate_hz else float(f"{rate_hz:.6g}")
