"""The base of every live driver: open, read, detect a lost link, reopen it, account for missing samples."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Protocol, TypeVar

from .errors import LinkError
from .notices import Notices
from .reading import Block, LinkStats, Reading

SLICE_S = 0.1  # longest wait inside a source: closing takes no longer
BACKOFF_S = (0.1, 0.2, 0.4, 0.8, 1.6)  # between attempts to reopen, the last for ever
SILENT_S = 1.0
MUTE_S = 2.0  # frames come, but no samples; a device has this long to describe itself
AWAY_S = 3.0  # after this time, a notice says why a lost link cannot be opened again

Data = TypeVar("Data")
Out = TypeVar("Out", covariant=True)
In = TypeVar("In", contravariant=True)


class LinkLost(Exception):
    """Raised by a source: the connection is gone; the text says how that was seen."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a source noticed besides its data.

    level, code, text : as of a Notice.
    cause : reason of a gap that may follow; "" if no samples are missing.
    """

    level: str
    code: str
    text: str
    cause: str = ""


class Source(Protocol[Out]):
    """Connects and receives; knows nothing of the protocol. `exhausted` is True when no more will ever come."""

    exhausted: bool

    def open(self) -> None: ...  # LinkUnavailable | LinkOpenError
    def close(self) -> None: ...  # idempotent, never raises

    def receive(self, timeout_s: float) -> Out | None:
        """The data that has arrived; None after `timeout_s` without data. Raises LinkLost."""
        ...

    def events(self) -> list[Event]: ...


class Decoder(Protocol[In]):
    """Pure: data in, readings out."""

    stats: LinkStats
    notices: Notices

    def feed(self, data: In, t_host_ns: int) -> list[Reading]: ...
    def cause(self, reason: str) -> None: ...

    def nothing(self) -> str:
        """Why frames gave no sample, with a remedy."""
        ...

    def finish(self, t_host_ns: int) -> list[Reading]:
        """Readings of the data that is held, at the end of the stream."""
        ...


class Link:
    """A driver made of a source and a decoder (see drivers.contract.reading.Driver).

    mute_s : time with frames but without samples before a notice says so, s.
    """

    def __init__(self, kind: str, target: str, source: Source[Data], decoder: Decoder[Data]) -> None:
        self.kind = kind
        self.target = target
        self.mute_s = MUTE_S
        self.stats = decoder.stats
        self._source = source
        self._decoder = decoder
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._closed.set()
        self._finished = True
        self._connected = False
        self._attempt = 0
        self._next_try_s = 0.0
        self._lost_s = 0.0
        self._away = ""  # why it cannot be opened again, as last reported
        self._last_data_s = 0.0
        self._silent = False
        self._last_samples_s = 0.0
        self._mute = False

    def open(self) -> None:
        with self._lock:
            if self._connected:
                return
            self._source.open()
            self._closed.clear()
            self._finished = False
            self._connected = True
            self._last_data_s = self._last_samples_s = time.monotonic()

    def close(self) -> None:
        self._closed.set()
        # A reader inside a slow reopen closes the source itself when it comes back.
        if self._lock.acquire(timeout=2 * SLICE_S):
            try:
                self._release()
            finally:
                self._lock.release()

    @property
    def exhausted(self) -> bool:
        return self._source.exhausted

    def read(self, timeout_s: float) -> list[Reading]:
        deadline = time.monotonic() + timeout_s
        with self._lock:
            while not self._closed.is_set():
                left = deadline - time.monotonic()
                out = self._step(max(0.0, left))
                if out or left <= 0 or self._source.exhausted:
                    return out
            self._release()
            if self._finished:
                return []
            self._finished = True
            return self._decoder.finish(time.monotonic_ns())

    def _step(self, wait_s: float) -> list[Reading]:
        if not self._connected:
            self._reopen(wait_s)
            return list(self._decoder.notices.take())
        try:
            data = self._source.receive(min(SLICE_S, wait_s))
        except LinkLost as lost:
            self._lose(str(lost))
            return list(self._decoder.notices.take())
        now_ns = time.monotonic_ns()
        for event in self._source.events():
            self._decoder.notices.add(now_ns, event.level, event.code, event.text)
            if event.cause:
                self._decoder.cause(event.cause)
        if data is not None:
            self._last_data_s, self._attempt, self._silent = time.monotonic(), 0, False
            out = self._decoder.feed(data, now_ns)
            self._watch_samples(out, now_ns)
            return out
        if not self._silent and time.monotonic() - self._last_data_s > SILENT_S:
            self._silent = True
            self._decoder.notices.add(now_ns, "warning", "silent", f"nothing from {self.target} for {SILENT_S:g} s")
            self._decoder.cause("silent")
        return list(self._decoder.notices.take())

    def _watch_samples(self, out: list[Reading], now_ns: int) -> None:
        """Report a device that sends frames but no samples: it describes itself, or others on its bus talk."""
        if any(isinstance(reading, Block) for reading in out):
            self._last_samples_s, self._mute = time.monotonic(), False
        elif not self._mute and time.monotonic() - self._last_samples_s > self.mute_s:
            self._mute = True
            text = f"{self.target} sends frames, but no samples for {self.mute_s:g} s: {self._decoder.nothing()}"
            self._decoder.notices.add(now_ns, "warning", "no_samples", text)
            self._decoder.cause("silent")

    def _lose(self, why: str) -> None:
        self._source.close()
        self._connected = False
        self._lost_s, self._away = time.monotonic(), ""
        self._decoder.cause("reconnect")
        self._decoder.notices.add(time.monotonic_ns(), "error", "link_lost", f"{self.target}: {why}; trying again")
        self._back_off()

    def _back_off(self) -> None:
        self._next_try_s = time.monotonic() + BACKOFF_S[min(self._attempt, len(BACKOFF_S) - 1)]
        self._attempt += 1

    def _reopen(self, wait_s: float) -> None:
        remaining = self._next_try_s - time.monotonic()
        if remaining > 0:
            self._closed.wait(min(remaining, wait_s))
            return
        try:
            self._source.open()
        except LinkError as error:
            self._back_off()
            if time.monotonic() - self._lost_s > AWAY_S and str(error) != self._away:
                self._away = str(error)
                text = f"{error}; it is tried again"
                self._decoder.notices.add(time.monotonic_ns(), "error", "link_missing", text)
            return
        self._connected = True
        self._last_data_s = self._last_samples_s = time.monotonic()
        self.stats.reconnects += 1
        self._decoder.notices.add(time.monotonic_ns(), "info", "link_back", f"{self.target} is open again")

    def _release(self) -> None:
        if self._connected:
            self._connected = False
            self._source.close()
