"""Protocol v1 on a serial line: bytes in, readings out. Pure; never raises on wire data."""

from __future__ import annotations

import struct

import numpy as np

from drivers.contract.notices import Notices
from drivers.contract.reading import LinkStats, Reading
from drivers.protocol import protocol
from drivers.protocol.continuity import Continuity
from drivers.protocol.device_info import DeviceInfo, Expected
from drivers.protocol.protocol import NO_MODULUS, PROTOCOL_VERSION, SERIAL16_LAYOUT, SERIAL24_LAYOUT, SampleFrames
from drivers.protocol.stated_rate import StatedRate

from .cobs import Bodies, Deframer

KIND_SAMPLES16, KIND_SAMPLES24, KIND_INFO = 1, 2, 3
INFO_BODY = 8 + 64
_HEAD_DTYPE = np.dtype(
    [
        ("version", "u1"), ("kind", "u1"), ("channels", "u1"), ("rows", "u1"),
        ("flags", "u1"), ("lost", "u1"), ("reserved", "<u2"), ("index", "<u8"), ("time", "<u8"),
    ]
)  # fmt: skip


def pack_samples(index: int, lost: int, flags: int, time_us: int, counts: protocol.I32Array, bits: int = 16) -> bytes:
    """(rows, channels) counts -> the body of one frame, before CRC and COBS."""
    rows, channels = counts.shape
    kind = KIND_SAMPLES16 if bits == 16 else KIND_SAMPLES24
    head = struct.pack("<6BHQQ", PROTOCOL_VERSION, kind, channels, rows, flags, lost, 0, index, time_us)
    if bits == 16:
        return head + np.ascontiguousarray(counts, "<i2").tobytes()
    return head + protocol.pack_int24(counts.reshape(1, -1)).tobytes()


def pack_info_body(record: protocol.InfoRecord) -> bytes:
    flags = (record.version & 3) << 2 | record.epoch << 4
    return bytes((record.version, KIND_INFO, record.channels, 0, flags, 0, 0, 0)) + protocol.pack_info(record)


class SerialDecoder:
    """One device on one line."""

    def __init__(self, stats: LinkStats, expected: Expected | None = None) -> None:
        self.stats = stats
        self.notices = Notices()
        self._deframer = Deframer()
        self._deframer.warm()
        self._device = DeviceInfo(self.notices, expected)
        self._axis = Continuity(stats, self.notices, self._device.starts)
        self._rate = StatedRate(self.notices, expected.rate_hz if expected else None)

    def cause(self, reason: str) -> None:
        """Why samples may be missing before the next frame (see Continuity)."""
        self._axis.cause(reason)
        if reason == "reconnect":
            self._deframer.reset()

    def nothing(self) -> str:
        """Why no sample has come."""
        return "check the device"

    def finish(self, t_host_ns: int) -> list[Reading]:
        """Nothing is held: the device counts its samples."""
        return list(self.notices.take())

    def feed(self, chunk: bytes, t_host_ns: int) -> list[Reading]:
        """Readings of these bytes; t_host_ns is when the last was read."""
        out: list[Reading] = []
        self.stats.bytes += len(chunk)
        bodies = self._deframer.feed(chunk)
        for start, stop in _alike(bodies):
            if bodies.stops[start] < 0:
                self.stats.crc_errors += stop - start
                self.stats.resyncs += 1
                self.notices.add(t_host_ns, "warning", "crc", "frames with a wrong check sum: dropped")
                self._axis.cause("crc")
            else:
                length = int(bodies.stops[start] - bodies.starts[start])
                first = int(bodies.starts[start])
                frames = bodies.data[first : first + length * (stop - start)].reshape(stop - start, length)
                self._frames(frames, t_host_ns, out)
        return out + self.notices.take()

    def _frames(self, bodies: protocol.U8Array, t_host_ns: int, out: list[Reading]) -> None:
        """(n, length) bodies with the same first four bytes."""
        n, length = bodies.shape
        version, kind = int(bodies[0, 0]), int(bodies[0, 1]) if length > 1 else 0
        if version != PROTOCOL_VERSION:
            self._device.other_version(version, t_host_ns)
            self.stats.count("other_version", n)
            self._axis.cause("version")
        elif kind == KIND_INFO and length == INFO_BODY:
            for body in bodies:
                info = self._device.record(body[8:].tobytes(), t_host_ns)
                if info is not None:
                    self._rate.begin(info, t_host_ns, timed=True)
        elif self._device.mixed(t_host_ns):
            self.stats.count("mixed_frames", n)
        elif kind in (KIND_SAMPLES16, KIND_SAMPLES24) and length >= _HEAD_DTYPE.itemsize:
            self._samples(bodies, SERIAL16_LAYOUT if kind == KIND_SAMPLES16 else SERIAL24_LAYOUT, t_host_ns, out)
        else:
            self._unknown(n, t_host_ns)

    def _samples(self, bodies: protocol.U8Array, layout: protocol.Layout, t_host_ns: int, out: list[Reading]) -> None:
        n, length = bodies.shape
        channels, rows = int(bodies[0, 2]), int(bodies[0, 3])
        info = self._device.info
        if info is None:
            return  # the record begins with the first description
        if channels != len(info.signals) or rows == 0 or length != layout.header + rows * channels * layout.bits // 8:
            self._unknown(n, t_host_ns)
            return
        head = np.ascontiguousarray(bodies[:, : _HEAD_DTYPE.itemsize]).view(_HEAD_DTYPE)[:, 0]
        if int(head["index"].max()) >= NO_MODULUS // 2 or int(head["time"].max()) >= NO_MODULUS // 2:
            self._unknown(n, t_host_ns)
            return
        self.stats.frames += n
        body = bodies[:, layout.header :]
        if layout is SERIAL16_LAYOUT:
            counts = np.ascontiguousarray(body).view("<i2").astype(np.int32)
        else:
            counts = protocol.unpack_int24(body)
        frames = SampleFrames(
            position=head["index"].astype(np.int64), modulus=NO_MODULUS, lost=head["lost"],
            epoch=protocol.flags_epoch(head["flags"]),
            time_us=head["time"].astype(np.int64), time_modulus=NO_MODULUS, counts=counts.reshape(n, rows, channels),
        )  # fmt: skip
        decided, held = self._rate.admit(frames, t_host_ns)
        if decided is not None:
            self._device.use(decided)
            self._axis.describe(decided.rate_hz)
            out.append(decided)
        for part in held:
            out.extend(self._axis.feed(part, t_host_ns))

    def _unknown(self, n: int, t_host_ns: int) -> None:
        self.stats.count("unknown_frames", n)
        self.notices.add(t_host_ns, "warning", "unknown_frame", "frames of an unknown kind or shape: dropped")


def _alike(bodies: Bodies) -> list[tuple[int, int]]:
    """(start, stop) of runs of bodies with one length and one kind; a run of damaged ones is a run too."""
    n = len(bodies.starts)
    if n == 0:
        return []
    length = bodies.stops - bodies.starts
    good = bodies.stops >= 0
    key = np.where(good, length, -1)
    long = good & (length >= 4)
    for k in range(4):  # version, kind, channels, rows
        key = key * 256
        key[long] += bodies.data[bodies.starts[long] + k]
    cuts = (np.flatnonzero(np.diff(key)) + 1).tolist()
    return list(zip([0, *cuts], [*cuts, n], strict=True))
