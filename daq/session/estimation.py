"""The ring and the rolling estimator of one device: blocks cut at multiples of the absolute index, live or replayed."""

from __future__ import annotations

from math import log2

import numpy as np
from numpy.typing import NDArray

from .estimator_runner import Ask, EstimatorRunner
from .ring import Ring

BLOCK_S = 0.04
PERIOD_S = 0.5  # an estimate at least this often, in time of the data
HELD_S = 4.0
LONGEST_GAP_S = 60.0  # the estimator receives at most this much of a gap


def block_rows(rate_hz: float) -> int:
    """Rows of a block: the power of two nearest to 40 ms."""
    return int(2 ** max(0, round(log2(max(1.0, rate_hz * BLOCK_S)))))


class Estimation:
    """Rows in, blocks to the runner. The blocks depend on the absolute index alone, so replay repeats them exactly.

    The first block is padded with NaN before the first row. Rows after the last whole block are not used.
    """

    def __init__(self, runner: EstimatorRunner, channels: int, rate_hz: float, first: int) -> None:
        self.runner = runner
        self.rows = block_rows(rate_hz)
        self._every = max(1, int(PERIOD_S * rate_hz / self.rows))
        self._longest_gap = max(1, int(LONGEST_GAP_S * rate_hz / self.rows / self._every)) * self.rows * self._every
        self._fed = first // self.rows * self.rows
        self._zero = self._fed  # absolute index of the estimator's row 0
        held = max(8, int(HELD_S * rate_hz / self.rows)) * self.rows
        self.ring = Ring(held, channels, self._fed)
        self.ring.skip(first - self._fed)
        self._asked_at = self._fed

    def append(self, rows: NDArray[np.float64], stamp: int = 0) -> None:
        """Take rows (n, channels), SI, NaN where clipped. stamp comes back with the estimates that became due."""
        step = self.ring.capacity - self.rows
        for at in range(0, len(rows), step):
            self.ring.append(rows[at : at + step])
            self._feed(stamp)

    def skip(self, count: int) -> None:
        """Pass over `count` missing rows. Of a gap longer than a minute, whole periods are left out."""
        period = self.rows * self._every
        if count > self._longest_gap + 2 * period:
            left_out = (count - self._longest_gap) // period * period
            count -= left_out
            self._skip(count // 2)
            self.ring.skip(left_out)
            self._fed += left_out
            self._zero += left_out
            count -= count // 2
        self._skip(count)

    def finish(self, timeout_s: float) -> bool:
        """Request the estimate after the last whole block, if still due; False if the runner ran out of time."""
        if self._fed != self._asked_at:
            self.runner.put(None, Ask(self._zero, 0))
        return self.runner.close(timeout_s)

    def _skip(self, count: int) -> None:
        step = self.ring.capacity - self.rows
        while count > 0:
            self.ring.skip(min(step, count))
            count -= step
            self._feed(0)

    def _feed(self, stamp: int) -> None:
        while self.ring.stop - self._fed >= self.rows:
            block = self.ring.window(self._fed, self._fed + self.rows).copy()
            self._fed += self.rows
            due = self._fed // self.rows % self._every == 0
            self.runner.put(block, Ask(self._zero, stamp) if due else None)
            self._asked_at = self._fed if due else self._asked_at
