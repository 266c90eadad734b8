"""slcan: a CAN adapter on a serial line or a socket, read by a block reader of our own."""

from __future__ import annotations

import numpy as np

from drivers.can.can_frames import CanFrames
from drivers.can.slcan_codec import SlcanCodec
from drivers.contract.errors import LinkOpenError
from drivers.contract.link import Decoder
from drivers.contract.link_config import SlcanConfig
from drivers.contract.reading import Reading
from drivers.serial.byte_port import PortSource

BITRATE_COMMANDS = {
    10_000: "S0", 20_000: "S1", 50_000: "S2", 100_000: "S3", 125_000: "S4", 250_000: "S5", 500_000: "S6",
    750_000: "S7", 800_000: "S7", 1_000_000: "S8", 83_300: "S9",
}  # fmt: skip
MOST_CAUSES = 1000  # damaged lines in a row that are counted one by one
DATA_BITRATES = {1_000_000: "Y1", 2_000_000: "Y2", 4_000_000: "Y4", 5_000_000: "Y5", 8_000_000: "Y8"}


def slcan_source(config: SlcanConfig) -> PortSource:
    """The port, with the commands that set the bit rates and open the channel."""
    if not config.setup:
        return PortSource(config.target, config.port, config.baud)
    if config.bitrate not in BITRATE_COMMANDS:
        known = ", ".join(str(rate) for rate in BITRATE_COMMANDS)
        raise LinkOpenError(f"{config.target}: slcan has no bitrate {config.bitrate}; it has {known}")
    commands = ["", "C", BITRATE_COMMANDS[config.bitrate]]
    if config.data_bitrate is not None:
        if config.data_bitrate not in DATA_BITRATES:
            known = ", ".join(str(rate) for rate in DATA_BITRATES)
            raise LinkOpenError(f"{config.target}: slcan has no data_bitrate {config.data_bitrate}; it has {known}")
        commands.append(DATA_BITRATES[config.data_bitrate])
    hello = "".join(command + "\r" for command in [*commands, "O"]).encode()
    return PortSource(config.target, config.port, config.baud, hello, goodbye=b"C\r")


class SlcanDecoder:
    """Lines to frames to readings; damaged lines are counted and blamed for the gap they leave."""

    def __init__(self, inner: Decoder[CanFrames]) -> None:
        self.stats = inner.stats
        self.notices = inner.notices
        self._inner = inner
        self._codec = SlcanCodec()
        self._codec.warm()

    def cause(self, reason: str) -> None:
        """Why samples may be missing before the next frame (see Continuity)."""
        if reason == "reconnect":
            self._codec.reset()
        self._inner.cause(reason)

    def nothing(self) -> str:
        """Why no sample has come."""
        return self._inner.nothing()

    def finish(self, t_host_ns: int) -> list[Reading]:
        """Readings of the data that is held, at the end (see Decoder)."""
        return self._inner.finish(t_host_ns)

    def feed(self, chunk: bytes, t_host_ns: int) -> list[Reading]:
        self.stats.bytes += len(chunk)
        lines = self._codec.feed(chunk, t_host_ns)
        if lines.refused:
            self.stats.count("refused_commands", lines.refused)
            text = "the adapter refused a command: check bitrate and data_bitrate"
            self.notices.add(t_host_ns, "warning", "adapter_refused", text)
        frames, out = lines.frames, list[Reading]()
        starts = sorted({0, *np.flatnonzero(lines.damaged).tolist()})
        for start, stop in zip(starts, [*starts[1:], len(frames)], strict=True):
            bad = int(lines.damaged[start])
            if bad:
                self.stats.crc_errors += bad
                self.stats.resyncs += 1
                self.notices.add(t_host_ns, "warning", "bad_line", "damaged slcan lines: dropped")
                for _ in range(min(bad, MOST_CAUSES)):  # each line was a frame, and may have been a sample
                    self._inner.cause("crc")
            if stop > start:
                part = frames.pick(slice(start, stop))
                out += self._inner.feed(part, t_host_ns)
        return out + self.notices.take()
