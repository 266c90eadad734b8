"""capture: recorded CAN traffic as a link, as fast as it is read; samples lie at their recorded times."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping

from drivers.can.can_decoder import CanDecoder
from drivers.can.can_frames import CanFrames
from drivers.contract.link_config import CaptureConfig
from drivers.contract.reading import LinkStats, Reading
from drivers.protocol.device_info import Expected

from .capture_batches import Batch, Batches
from .capture_files import open_capture
from .mapped import MappedDecoder


class Capture:
    """With a DBC file and a signal map: the frames of any device. Without: of one that speaks protocol v1."""

    kind = "capture"

    def __init__(
        self, config: CaptureConfig, stats: LinkStats, dbc: bytes | None, signals: Mapping[str, str] | None,
        expected: Expected | None,
    ) -> None:  # fmt: skip
        self.stats = stats
        self.target = config.target
        self._config = config
        self._mapped = None
        if dbc is not None and signals is not None:
            self._mapped = MappedDecoder(stats, dbc, signals, expected, config.rate_hz, recorded=True)
        self._direct = CanDecoder(stats, expected=expected)
        self._batches: Batches | None = None
        self._lock = threading.Lock()
        self._closed = False
        self._exhausted = False

    def open(self) -> None:
        with self._lock:
            if self._batches is None and not self._exhausted:
                self._batches = open_capture(self._config.path, self._config.bus)
            self._closed = False

    def close(self) -> None:
        with self._lock:
            self._closed = True
            if self._batches is not None:
                self._batches.close()
            self._batches = None

    @property
    def exhausted(self) -> bool:
        return self._exhausted

    def read(self, timeout_s: float) -> list[Reading]:
        """The readings of the next batch of frames that has any. The file's own times are the host times."""
        deadline = time.monotonic() + timeout_s
        while True:
            with self._lock:
                if self._batches is None or self._exhausted or self._closed:
                    return []
                batch = next(self._batches, None)
                if batch is None:
                    self._exhausted, self._batches = True, None
                    return self._decode(Batch(_none()), final=True)
                out = self._decode(batch, final=False)
            if out or time.monotonic() >= deadline:
                return out

    def _decode(self, batch: Batch, final: bool) -> list[Reading]:
        frames = batch.frames
        t_ns = int(frames.t_ns[-1]) if len(frames) else time.monotonic_ns()
        decoder = self._mapped or self._direct
        if batch.damaged:
            self.stats.crc_errors += batch.damaged
            decoder.cause("crc")
            text = f"{self.target}: {batch.damaged} records cannot be read ({batch.why})"
            decoder.notices.add(t_ns, "error", "capture_damaged", text)
        self.stats.bytes += int(frames.lengths.sum())
        if self._mapped is not None:
            return self._mapped.feed(frames, t_ns, final)
        return self._direct.feed(frames, t_ns) + self._direct.notices.take()


def _none() -> CanFrames:
    return CanFrames.build([])
