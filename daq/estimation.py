"""The ring and the rolling estimator of one device: blocks cut at multiples of the absolute index, live or replayed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import log2

import numpy as np
from numpy.typing import NDArray

from estimator.estimate import Estimate, OnlineEstimator

from .ring import Ring

BLOCK_S = 0.04
PERIOD_S = 0.5  # an estimate at least this often, in time of the data
HELD_S = 4.0
LONGEST_GAP_S = 60.0  # the estimator is told of no more than this of a gap


def block_rows(rate_hz: float) -> int:
    """Rows of a block: the power of two nearest to 40 ms."""
    return int(2 ** max(0, round(log2(max(1.0, rate_hz * BLOCK_S)))))


class Estimation:
    """Rows in, estimates out. The blocks depend on the absolute index alone, so replay repeats them exactly.

    The first block is filled up with NaN before the first row; what is left at the end is not estimated from. An
    estimator that fails is dropped, and `failure` says why: acquisition matters more.
    """

    def __init__(self, estimator: OnlineEstimator | None, channels: int, rate_hz: float, first: int) -> None:
        self.rows = block_rows(rate_hz)
        self._every = max(1, int(PERIOD_S * rate_hz / self.rows))
        self._longest_gap = max(1, int(LONGEST_GAP_S * rate_hz / self.rows / self._every)) * self.rows * self._every
        self._fed = first // self.rows * self.rows
        self._zero = self._fed  # absolute index of the estimator's row 0
        held = max(8, int(HELD_S * rate_hz / self.rows)) * self.rows
        self.ring = Ring(held, channels, self._fed)
        self.ring.skip(first - self._fed)
        self._estimator = estimator
        self._told = -1
        self.failure: Exception | None = None

    def append(self, rows: NDArray[np.float64]) -> Iterator[Estimate]:
        """Take rows (n, channels), SI, NaN where clipped; the estimates that became due."""
        step = self.ring.capacity - self.rows
        for at in range(0, len(rows), step):
            self.ring.append(rows[at : at + step])
            yield from self._feed()

    def skip(self, count: int) -> Iterator[Estimate]:
        """`count` rows are missing. Of a gap longer than a minute, the estimator does not see whole periods."""
        period = self.rows * self._every
        if count > self._longest_gap + 2 * period:
            left_out = (count - self._longest_gap) // period * period
            count -= left_out
            yield from self._skip(count // 2)
            self.ring.skip(left_out)
            self._fed += left_out
            self._zero += left_out
            count -= count // 2
        yield from self._skip(count)

    def stop(self) -> bool:
        """Estimate no more; whether that changes anything."""
        running, self._estimator = self._estimator is not None, None
        return running

    def final(self) -> Iterator[Estimate]:
        """The estimate after the last whole block, unless it was given already."""
        estimate = self._snapshot() if self._fed != self._told and self._fed > self._zero else None
        if estimate is not None:
            yield estimate

    def _skip(self, count: int) -> Iterator[Estimate]:
        step = self.ring.capacity - self.rows
        while count > 0:
            self.ring.skip(min(step, count))
            count -= step
            yield from self._feed()

    def _feed(self) -> Iterator[Estimate]:
        while self.ring.stop - self._fed >= self.rows:
            if self._estimator is not None:
                block = self.ring.window(self._fed, self._fed + self.rows).copy()
                try:
                    self._estimator.update(block)
                except Exception as error:  # a defect there must not stop acquisition
                    self._estimator, self.failure = None, error
            self._fed += self.rows
            if self._fed // self.rows % self._every == 0:
                estimate = self._snapshot()
                if estimate is not None:
                    yield estimate

    def _snapshot(self) -> Estimate | None:
        if self._estimator is None:
            return None
        self._told = self._fed
        try:
            estimate = self._estimator.snapshot()
        except Exception as error:  # as above
            self._estimator, self.failure = None, error
            return None
        return replace(estimate, index=self._zero + estimate.index)
