"""The low-rate picture of a stream: least and greatest count of every window, so that a peak is never hidden."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Extremes = tuple[int, NDArray[np.int32], NDArray[np.int32]]  # first index of the window, least, greatest (channels,)


class Envelope:
    """Windows of `rows` samples at multiples of `rows` of the absolute index; a window may be partly missing."""

    def __init__(self, rows: int) -> None:
        self.rows = rows
        self._open: Extremes | None = None

    def feed(self, index: int, counts: NDArray[np.int32]) -> list[Extremes]:
        """The windows that are complete or left behind after `counts` (n, channels) at `index`, in order."""
        if not len(counts):
            return []
        first = index // self.rows * self.rows
        starts = np.arange(first, index + len(counts), self.rows) - index
        at = np.maximum(starts, 0)
        low, high = np.minimum.reduceat(counts, at, axis=0), np.maximum.reduceat(counts, at, axis=0)
        done: list[Extremes] = []
        if self._open is not None:
            start, open_low, open_high = self._open
            if start == first:
                low[0], high[0] = np.minimum(low[0], open_low), np.maximum(high[0], open_high)
            else:
                done.append(self._open)
        windows = [(int(start) + index, low[i], high[i]) for i, start in enumerate(starts)]
        self._open = windows.pop() if (index + len(counts)) % self.rows else None
        return done + windows

    def rest(self) -> list[Extremes]:
        """The window under way, at the end of the stream."""
        out, self._open = [self._open] if self._open is not None else [], None
        return out
