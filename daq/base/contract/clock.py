"""Time: the one clock of the service, and the device's clock seen through it."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .sink import ClockState


class Clock(Protocol):
    """Source of every time in the service; tests use their own."""

    def now_ns(self) -> int:
        """Host monotonic time."""
        ...

    def wall_offset_ns(self) -> int:
        """Unix time minus host monotonic time."""
        ...


class SystemClock:
    """The clocks of the operating system."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def wall_offset_ns(self) -> int:
        try:
            wall_ns = time.time_ns()
        except OverflowError:  # a clock beyond the year 2262
            wall_ns = LATEST_NS
        return wall_ns - time.monotonic_ns()


LATEST_NS = 2**63 - 1
WINDOW_S = 0.25
MAX_WINDOWS = 240  # one minute of them
MIN_WINDOWS = 8  # two seconds of them
TRANSIT_S = 1e-3  # the least time from a frame's last sample to the stamp, beyond the frame's length on the wire
SLOPE_Z = 3.3  # 99.9 % of the slope's interval
REAL_TIME = 0.2  # a device whose seconds last longer or shorter by more does not run in real time
MAX_CRYSTAL_ERROR_REL = 1e-3  # a rate that differs by more is no crystal's error
RATE_WINDOWS = 80  # windows: 20 s
MAX_SCATTER_SHARE = 0.05  # of the whole drift: samples that were held up or buffered do not lie on one line


class DeviceClock:
    """Host time of a device's sample index, from arrival stamps that are always late, often by milliseconds.

    Only the earliest arrival of each 0.25 s counts. The slope is the Theil-Sen estimate through these minima of the
    last minute, with Sen's rank interval; the line is shifted down to the earliest of them. No arrival shows how late
    the earliest was: between zero and the length of one block on the wire plus 1 ms. The line goes through the middle
    of that range. `bound_ns` is the sum of half the range, the scatter of the minima, and the effect of the slope's
    interval at either end of the minute. The mapping holds from the oldest minimum until a second after the newest.

    Reference: P. K. Sen, J. Am. Stat. Assoc. 63 (1968) 1379, section 3, for slope and interval.
    """

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.restart()

    def restart(self) -> None:
        """Restart: the device or the link began anew, and the mapping from index to time changed."""
        self._origin: tuple[int, int] | None = None
        self._minima: deque[tuple[float, float, int]] = deque(maxlen=MAX_WINDOWS)  # s on the index axis, s late, rows
        self._window = -1
        self._best = (0.0, 0.0)
        self._rows = 0

    def feed(self, stop: int, t_host_ns: int, rows: int) -> None:
        """A block of `rows` whose last sample is `stop - 1` arrived at `t_host_ns`."""
        if self._origin is None:
            self._origin = (stop, t_host_ns)
        index0, host0 = self._origin
        device_s = (stop - index0) / self.rate_hz
        late_s = (t_host_ns - host0) * 1e-9 - device_s
        window = int(device_s / WINDOW_S)
        if window != self._window:
            self._close_window()
            self._window, self._best, self._rows = window, (device_s, late_s), rows
        if late_s < self._best[1]:
            self._best = (device_s, late_s)
        self._rows = min(self._rows, rows)

    def _close_window(self) -> None:
        if self._window >= 0:
            self._minima.append((*self._best, self._rows))

    def state(self) -> ClockState | None:
        """The mapping now; None in the first two seconds, and of a source that does not run in real time."""
        n = len(self._minima)
        if n < MIN_WINDOWS or self._origin is None:
            return None
        s, late, rows = np.array(self._minima).T
        slope, low, high = theil_sen(s, late)
        if abs(slope) > REAL_TIME:
            return None
        residual = late - slope * s
        floor = float(residual.min())
        scatter = float(np.median(residual)) - floor
        reach = float(s[-1] - s[0]) + 1.0
        unseen = TRANSIT_S + float(np.median(rows)) / self.rate_hz
        bound = unseen / 2 + scatter + max(high - slope, slope - low) * reach
        rate_hz = self.rate_hz / (1.0 + slope)
        index0, host0 = self._origin
        at_zero_ns = host0 + round((floor - unseen / 2) * 1e9) - round((index0 - 1) * 1e9 / rate_hz)
        return ClockState(at_zero_ns, rate_hz, (rate_hz / self.rate_hz - 1.0) * 1e6, round(bound * 1e9))

    def true_rate_hz(self) -> float | None:
        """The rate on the host's clock, if it certainly differs from the rate that the device states; else None.

        Known after 20 s. None for samples that come faster than real time by more than a fifth, out of a buffer.
        """
        if len(self._minima) < RATE_WINDOWS:
            return None
        s, late, _ = np.array(self._minima).T
        slope, low, high = theil_sen(s, late)
        off = np.ptp(np.quantile(late - slope * s, (0.05, 0.95)))
        straight = off < MAX_SCATTER_SHARE * abs(slope) * (s[-1] - s[0])
        certain = (low > MAX_CRYSTAL_ERROR_REL or high < -MAX_CRYSTAL_ERROR_REL) and slope > -REAL_TIME
        return self.rate_hz / (1.0 + slope) if straight and certain else None


def theil_sen(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float, float]:
    """Median of the slopes of all pairs of points, and Sen's interval of it."""
    i, j = np.triu_indices(len(x), 1)
    slopes = np.sort((y[j] - y[i]) / (x[j] - x[i]))
    n, pairs = len(x), len(slopes)
    half = SLOPE_Z * math.sqrt(n * (n - 1) * (2 * n + 5) / 18.0) / 2
    low, high = max(0, math.floor(pairs / 2 - half)), min(pairs - 1, math.ceil(pairs / 2 + half))
    return float(np.median(slopes)), float(slopes[low]), float(slopes[high])
