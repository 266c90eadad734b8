"""Between the reader thread of a link and the core loop."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

from drivers.contract import Block, Gap, Reading

SMALL_READING_BYTES = 256  # bytes that a reading without samples is counted as
QUEUE_BYTES = 32 << 20
OVERFLOW_REASON = "overflow"


class ReadingQueue:
    """Readings in order, at most `limit_bytes` of them.

    live : `put` never waits; when full, the oldest blocks go and a Gap of reason "overflow" with their exact indices
        takes their place. Gaps, notices and infos are never dropped. False: `put` waits (a file can).
    """

    def __init__(self, limit_bytes: int = QUEUE_BYTES, live: bool = True) -> None:
        self._limit = limit_bytes
        self._live = live
        self._changed = threading.Condition()
        self._items: deque[Reading] = deque()
        self._bytes = 0
        self.open = True
        self._failure: BaseException | None = None
        self._woken = False
        self.dropped = 0  # samples

    def put(self, readings: Sequence[Reading]) -> None:
        """From the reader thread."""
        with self._changed:
            if not self._live:
                self._changed.wait_for(lambda: self._bytes < self._limit or not self.open)
            self._items.extend(readings)
            self._bytes += sum(map(_size, readings))
            if self._live and self._bytes > self._limit:
                self._drop_oldest()
            self._changed.notify_all()

    def end(self, failure: BaseException | None = None) -> None:
        """Nothing more will come; `failure` is raised by the `take` that finds the queue empty."""
        with self._changed:
            self.open, self._failure = False, failure or self._failure
            self._changed.notify_all()

    def wake(self) -> None:
        """From any thread: a `take` that waits returns now."""
        with self._changed:
            self._woken = True
            self._changed.notify_all()

    def close(self) -> None:
        """The core loop wants nothing more: a `put` that waits goes on, and the reader sees `open` False."""
        with self._changed:
            self.open = False
            self._changed.notify_all()

    def take(self, timeout_s: float, limit_bytes: int = 128 << 10) -> list[Reading]:
        """Up to about `limit_bytes` of what waits, at once if something does, else within the time; [] if nothing.

        Little at a time, so that a core loop with a backlog still hears of a stop.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._woken or not self.open, timeout_s)
            self._woken = False
            if not self._items and self._failure is not None:
                failure, self._failure = self._failure, None
                raise failure
            out: list[Reading] = []
            taken = 0
            while self._items and taken < limit_bytes:
                out.append(self._items.popleft())
                taken += _size(out[-1])
            self._bytes -= taken
            self._changed.notify_all()
            return out

    @property
    def waiting_bytes(self) -> int:
        return self._bytes

    @property
    def ended(self) -> bool:
        """Nothing waits and nothing will come."""
        with self._changed:
            return not self.open and not self._items and self._failure is None

    def _drop_oldest(self) -> None:
        """Make room: to three quarters, so that a consumer that is just too slow does not cost a gap for each block."""
        kept: list[Reading] = []
        while self._items and self._bytes > self._limit * 3 // 4:
            item = self._items.popleft()
            if isinstance(item, Block):
                self.dropped += len(item.counts)
                self._bytes -= _size(item)
                item = Gap(item.index, len(item.counts), OVERFLOW_REASON)
                self._bytes += SMALL_READING_BYTES
            last = kept[-1] if kept else None
            joins = isinstance(last, Gap) and isinstance(item, Gap) and last.reason == item.reason == OVERFLOW_REASON
            if joins and isinstance(last, Gap) and isinstance(item, Gap) and last.index + last.count == item.index:
                kept[-1] = Gap(last.index, last.count + item.count, OVERFLOW_REASON)
                self._bytes -= SMALL_READING_BYTES
            else:
                kept.append(item)
        self._items.extendleft(reversed(kept))


def _size(reading: Reading) -> int:
    return SMALL_READING_BYTES + (reading.counts.nbytes if isinstance(reading, Block) else 0)
