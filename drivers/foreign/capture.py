"""capture: recorded CAN traffic as a link, as fast as it is read; samples lie at their recorded times.

`open` checks the first frames: it refuses a file that would give wrong samples.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping

from drivers.can.can_decoder import CanDecoder
from drivers.can.can_frames import CanFrames
from drivers.contract.errors import LinkOpenError
from drivers.contract.link_config import CaptureConfig
from drivers.contract.reading import Block, LinkStats, Reading
from drivers.protocol.device_info import Expected

from .capture_batches import Batch, Batches
from .capture_files import open_capture
from .capture_senders import Senders
from .mapped import MappedDecoder
from .reorder import Reorder

SURVEY_FRAMES = 4096  # of the device, by which buses and senders are recognised


class Capture:
    """A driver of a capture: of any device with a DBC file and a signal map, else of a device with protocol v1."""

    kind = "capture"

    def __init__(
        self, config: CaptureConfig, stats: LinkStats, dbc: bytes | None, signals: Mapping[str, str] | None,
        *, expected: Expected | None,
    ) -> None:  # fmt: skip
        self.stats = stats
        self.target = config.target
        self._config = config
        self._mapped = None
        if dbc is not None and signals is not None:
            self._mapped = MappedDecoder(stats, dbc, signals, expected, rate_hz=config.rate_hz, recorded=True)
        self._direct = CanDecoder(stats, expected=expected)
        self._decoder = self._mapped or self._direct
        self._batches: Batches | None = None
        self._senders = Senders(self.target, config.bus, self._decoder.wanted)
        self._reorder = Reorder()
        self._ready: list[Reading] = []
        self._lock = threading.Lock()
        self._closed = False
        self._exhausted = False
        self._sampled = False
        self._last_ns = 0
        self._why = ""  # of the first record that cannot be read

    def open(self) -> None:
        with self._lock:
            self._closed = False
            if self._batches is not None or self._exhausted:
                return
            batches = open_capture(self._config.path, self._mapped.plan.names if self._mapped else None)
            self._batches = batches
            try:
                self._begin(batches)
            except BaseException:
                batches.close()
                self._batches = None
                raise

    def _begin(self, batches: Batches) -> None:
        """Check the first frames, and decode them. Raises LinkOpenError."""
        senders = self._senders
        first: list[Batch] = []
        while senders.seen < SURVEY_FRAMES and (batch := next(batches, None)) is not None:
            first.append(senders.survey(batch))
        ended = senders.seen < SURVEY_FRAMES
        senders.decide()
        for batch in first:
            self._ready += self._decode(batch, final=False)
        if ended:
            self._ready += self._end()
        elif self._mapped is not None:
            while not self._mapped.learned and (more := next(batches, None)) is not None:
                self._ready += self._decode(more, final=False)
        for found in self._mapped.findings if self._mapped is not None else ():
            if found.fatal:
                raise LinkOpenError(f"{self.target}: {found.text}")
        if ended and not self._sampled and self._mapped is not None:
            raise LinkOpenError(f"{self.target}: {self._nothing(self._mapped)}")

    def close(self) -> None:
        with self._lock:
            self._closed = True
            if self._batches is not None:
                self._batches.close()
            self._batches = None

    @property
    def exhausted(self) -> bool:
        return self._exhausted and not self._ready

    def read(self, timeout_s: float) -> list[Reading]:
        """The readings of the next batch of frames that has any. The file's own times are the host times."""
        deadline = time.monotonic() + timeout_s
        while True:
            with self._lock:
                if self._closed:
                    return []
                if self._ready:
                    ready, self._ready = self._ready, []
                    return ready
                if self._batches is None or self._exhausted:
                    return []
                batch = next(self._batches, None)
                out = self._end() if batch is None else self._decode(batch, final=False)
            if out or self._exhausted or time.monotonic() >= deadline:
                return out

    def _end(self) -> list[Reading]:
        self._exhausted, self._batches = True, None
        left = self._reorder.rest()
        t_ns = self._last_ns or time.monotonic_ns()
        if left is not None:
            out = self._feed(left, t_ns, final=True)
        else:
            out = [] if self._mapped is None else self._mapped.feed(CanFrames.build([]), t_ns, final=True)
        self._sampled = self._sampled or any(isinstance(each, Block) for each in out)
        if not self._sampled and self._mapped is not None:
            self._decoder.notices.add(t_ns, "error", "no_samples", f"{self.target}: {self._nothing(self._mapped)}")
            out += self._decoder.notices.take()
        return out

    def _nothing(self, mapped: MappedDecoder) -> str:
        if not self.stats.frames and self.stats.crc_errors:
            return f"{self.stats.crc_errors} records cannot be read ({self._why}), and it holds no others"
        return mapped.nothing()

    def _decode(self, batch: Batch, final: bool) -> list[Reading]:
        frames = batch.frames
        self._last_ns = t_ns = int(frames.t_ns[-1]) if len(frames) else self._last_ns or time.monotonic_ns()
        notices = self._decoder.notices
        for code, text in batch.said:
            notices.add(t_ns, "warning", code, f"{self.target}: {text}")
        if batch.damaged:
            self.stats.crc_errors += batch.damaged
            self._why = self._why or batch.why
            text = f"{self.target}: {batch.damaged} records cannot be read ({batch.why})"
            notices.add(t_ns, "error", "capture_damaged", text)
            if self._mapped is None:
                self._direct.cause("crc")
        self.stats.bytes += int(frames.lengths.sum())
        batch = self._senders.of_device(batch)
        for level, code, text in self._senders.take_said():
            notices.add(t_ns, level, code, f"{self.target}: {text}")
        batch = self._reorder.take(batch)
        if self._reorder.sorted and not self._reorder.reported:
            self._reorder.reported = True
            text = f"{self.target}: frames stand out of order by their time stamps: sorted"
            notices.add(t_ns, "warning", "unsorted", text)
        out = self._feed(batch, t_ns, final)
        self._sampled = self._sampled or any(isinstance(each, Block) for each in out)
        return out

    def _feed(self, batch: Batch, t_ns: int, final: bool) -> list[Reading]:
        if self._mapped is not None:
            return self._mapped.feed(batch.frames, t_ns, final, batch.holes)
        return self._direct.feed(batch.frames, t_ns) + self._direct.notices.take()
