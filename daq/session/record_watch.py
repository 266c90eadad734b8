"""Says while a session runs what makes its channels unfit to be judged: the record layer on the last seconds."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.sink import Session, SinkHealth, Status
from drivers.contract import Block, Info, Notice, Reading
from estimator import Model
from estimator.results import Estimate

from .ring import KeptSamples

WINDOW_S = 10.0  # that is looked at, one after the other
RECORD_FINDING = "record_finding"  # code of the notices
SAID_ELSEWHERE = frozenset({"gaps", "missing_samples", "empty_channel"})  # by the ledger and the watch of the link


class RecordWatch:
    """A sink. live : the look is taken in a thread, and `close` does not wait for it.

    The windows are multiples of the absolute index, so a replay says the same. What stands in two windows in a row is
    said once.
    """

    def __init__(self, model: Model, live: bool) -> None:
        self._model, self._live = model, live
        self._kept = KeptSamples(model, 2.0 * WINDOW_S)
        self._info: Info | None = None
        self._next: int | None = None  # first sample of the next window
        self._standing: set[tuple[str, tuple[str, ...]]] = set()
        self._notices: deque[Notice] = deque()
        self._thread: threading.Thread | None = None

    def start(self, session: Session) -> None:
        self._begin(session.info)

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Info) and reading != self._info:
                self._begin(reading)
            elif isinstance(reading, Block):
                self._kept.append(reading)
                self._look(reading.index)

    def estimate(self, estimate: Estimate) -> None: ...

    def status(self, status: Status) -> None: ...

    def close(self) -> None: ...

    def health(self) -> SinkHealth:
        pending = self._thread is not None and self._thread.is_alive()  # asked first: it speaks before it ends
        out = []
        while self._notices:
            out.append(self._notices.popleft())
        return SinkHealth(0.0, 0, tuple(out), pending)

    def _begin(self, info: Info) -> None:
        self._info, self._next = info, None
        self._kept.begin(info)

    def _look(self, index: int) -> None:
        """Look at the window that is complete, if there is one and the last look has ended. index : of the block."""
        rows = max(1, round(WINDOW_S * self._kept.rate_hz))
        if self._next is None:
            self._next = -(-index // rows) * rows
        if self._kept.stop < self._next + rows:
            return
        first = (self._kept.stop // rows - 1) * rows
        self._next = first + rows
        if self._thread is not None and self._thread.is_alive():
            return
        y = self._kept.samples(first, first + rows)
        if not self._live:
            self._survey(y, first / self._kept.rate_hz)
            return
        self._thread = threading.Thread(
            target=self._survey, args=(y, first / self._kept.rate_hz), name="record watch", daemon=True
        )
        self._thread.start()

    def _survey(self, y: NDArray[np.float64], since_s: float) -> None:
        """Say what is new in a window. since_s : its first second."""
        from estimator.identification.record import survey_record

        findings = survey_record(self._model, y, self._kept.rate_hz).findings
        now = {(f.code, f.channels): f.text for f in findings if f.code not in SAID_ELSEWHERE}
        for key in [k for k in now if k not in self._standing]:
            text = now[key] + (f" (times from {since_s:.0f} s on)" if since_s else "")
            self._notices.append(Notice(time.monotonic_ns(), "warning", RECORD_FINDING, text))
        self._standing = set(now)
