"""A device on a serial line: bytes to packets, packets to samples by its DBC."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivers.contract.reading import Reading
from drivers.foreign import MappedDecoder

from .packets import Framer


class PacketDecoder:
    """Packets are stamped by when the host read them.

    The baud rate does not show when a packet was sent: an adapter hands bytes over in bursts, USB has no baud rate.
    """

    def __init__(self, inner: MappedDecoder, framer: Framer) -> None:
        self.stats = inner.stats
        self.notices = inner.notices
        self._inner, self._framer = inner, framer

    def cause(self, reason: str) -> None:
        """Why samples may be missing before the next packet (see Continuity)."""
        if reason == "reconnect":
            self._framer.reset()
        self._inner.cause(reason)

    def nothing(self) -> str:
        """Why no sample has come."""
        return self._inner.nothing()

    def finish(self, t_host_ns: int) -> list[Reading]:
        """Readings of the data that is held, at the end (see Decoder)."""
        return self._inner.finish(t_host_ns)

    def feed(self, chunk: bytes, t_host_ns: int) -> list[Reading]:
        """Readings of these bytes; t_host_ns is when the last was read."""
        self.stats.bytes += len(chunk)
        found = self._framer.feed(chunk)
        damaged = int(found.holes.sum())
        if damaged:
            self.stats.crc_errors += damaged
            self.stats.resyncs += int(np.count_nonzero(found.holes))
            self.notices.add(t_host_ns, "warning", "crc", "packets with a wrong check sum, or cut: dropped")
        if not len(found.frames) and not damaged:
            return list(self.notices.take())
        stamps = np.full(len(found.frames), t_host_ns, np.int64)
        return self._inner.feed(replace(found.frames, t_ns=stamps), t_host_ns, holes=found.holes)
