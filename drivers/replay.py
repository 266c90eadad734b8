"""replay: recorded readings as a link, at their own pace, faster, slower, or as fast as they are taken."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence

from drivers.reading import Block, Gap, LinkStats, Reading

Batches = Callable[[], Iterable[tuple[Sequence[Reading], int]]]


class Replay:
    """`batches()` gives (readings, host time in ns when they were read), in order; it is called at the first `open`.

    speed : recorded seconds per second, None for as fast as possible. Readings come out as they were recorded, host
    times included: what follows computes the same numbers at any speed.
    """

    kind = "replay"

    def __init__(self, batches: Batches, speed: float | None = 1.0) -> None:
        self.stats = LinkStats()
        self._batches = batches
        self._speed = speed
        self._source: Iterator[tuple[Sequence[Reading], int]] | None = None
        self._next: tuple[Sequence[Reading], int] | None = None
        self._start: tuple[int, float] | None = None  # recorded ns and monotonic s that belong together
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._exhausted = False

    def open(self) -> None:
        with self._lock:
            self._closed.clear()
            if self._source is None and not self._exhausted:
                self._source = iter(self._batches())
                self._advance()

    def close(self) -> None:
        self._closed.set()

    @property
    def exhausted(self) -> bool:
        return self._exhausted

    def read(self, timeout_s: float) -> list[Reading]:
        with self._lock:
            if self._next is None or self._closed.is_set():
                return []
            readings, t_ns = self._next
            if not self._wait(t_ns, timeout_s):
                return []
            self._advance()
        for reading in readings:
            if isinstance(reading, Block):
                self.stats.frames += 1
                self.stats.bytes += reading.counts.nbytes
            elif isinstance(reading, Gap):
                self.stats.lost_samples += reading.count
        return list(readings)

    def _wait(self, t_ns: int, timeout_s: float) -> bool:
        """Sleep until t_ns is due; False if that is later than the timeout, or the link is closed meanwhile."""
        if self._speed is None:
            return True
        now_s = time.monotonic()
        if self._start is None:
            self._start = (t_ns, now_s)
        due_s = self._start[1] + (t_ns - self._start[0]) / 1e9 / self._speed
        if due_s > now_s and self._closed.wait(min(due_s - now_s, timeout_s)):
            return False
        return due_s <= now_s + timeout_s

    def _advance(self) -> None:
        self._next = next(self._source, None) if self._source is not None else None
        if self._next is None:
            self._exhausted = True
