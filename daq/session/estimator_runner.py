"""Runs a rolling estimator over blocks in their order: at once, or in a separate thread that no caller waits for."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.results import Estimate, OnlineEstimator

BUSY_BLOCKS = 250  # of 40 ms: ten seconds
BUSY_BYTES = 32 << 20


@dataclass(frozen=True, slots=True)
class Ask:
    """A snapshot is due after a block. zero : absolute index of the estimator's row 0; stamp : for the asker."""

    zero: int
    stamp: int


@dataclass(frozen=True, slots=True)
class Answer:
    estimate: Estimate
    stamp: int


class EstimatorRunner:
    """`put` blocks, `take` answers. The same blocks give the same answers, in a thread or not.

    wake : None to run within `put`; else a thread runs, and calls it when there is an answer. Nothing is dropped here:
    `busy` asks the core loop to put no more (ten seconds wait by then); the reader's queue has the overflow policy.
    An estimator that raises is dropped; `failure` says why.
    """

    def __init__(
        self, estimator: OnlineEstimator | None, wake: Callable[[], None] | None = None, busy_blocks: int = BUSY_BLOCKS
    ) -> None:
        self._estimator = estimator
        self._wake = wake
        self._busy_blocks = busy_blocks
        self._changed = threading.Condition()
        self._work: deque[tuple[NDArray[np.float64] | None, Ask | None]] = deque()
        self._bytes = 0
        self._answers: deque[Answer] = deque()
        self._working = False
        self._closed = False
        self.failure: Exception | None = None
        if wake is not None and estimator is not None:
            threading.Thread(target=self._run, name="estimator", daemon=True).start()

    @property
    def busy(self) -> bool:
        return len(self._work) >= self._busy_blocks or self._bytes >= BUSY_BYTES

    def put(self, block: NDArray[np.float64] | None, ask: Ask | None) -> None:
        """The next block (None: no more rows, only a question)."""
        if self._estimator is None:
            return
        if self._wake is None:
            self._do(block, ask)
            return
        with self._changed:
            self._work.append((block, ask))
            self._bytes += 0 if block is None else block.nbytes
            self._changed.notify_all()

    def take(self) -> list[Answer]:
        """Answers since the last call."""
        out = []
        while self._answers:
            out.append(self._answers.popleft())
        return out

    def close(self, timeout_s: float) -> bool:
        """Wait at most `timeout_s` for the queued blocks; False if time ran out, which leaves the rest undone."""
        if self._wake is None:
            return True
        with self._changed:
            self._changed.wait_for(lambda: not self._work and not self._working, timeout_s)
            finished = not self._work and not self._working
            self._work.clear()
            self._bytes = 0
            self._closed = True
            self._changed.notify_all()
        return finished

    def _run(self) -> None:
        while True:
            with self._changed:
                self._working = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._work or self._closed)
                if self._closed:
                    return
                block, ask = self._work.popleft()
                self._bytes -= 0 if block is None else block.nbytes
                self._working = True
            if self._do(block, ask) and self._wake is not None:
                self._wake()

    def _do(self, block: NDArray[np.float64] | None, ask: Ask | None) -> bool:
        """One block and perhaps a snapshot; whether there is an answer."""
        estimator = self._estimator
        if estimator is None or self._closed:
            return False
        try:
            if block is not None:
                estimator.update(block)
            estimate = estimator.snapshot() if ask is not None else None
        except Exception as error:  # a defect there must not stop acquisition
            self._estimator, self.failure = None, error
            return True
        if estimate is None or ask is None or self._closed:
            return False
        self._answers.append(Answer(replace(estimate, index=ask.zero + estimate.index), ask.stamp))
        return True
