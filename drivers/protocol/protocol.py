"""Protocol v1: the bytes of every frame, as pure functions between numpy arrays (docs/protocol.md is the reference).

All multi-byte fields are little endian. The device keeps one 64-bit sample index from 0 at its start; every frame
carries that index's low part, so that position, gaps and wraps all live on one axis.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.contract.reading import Signal

PROTOCOL_VERSION = 1
FD_LENGTH = 64  # bytes of payload of a CAN FD frame
TIME_MODULUS_US = 1 << 32
NO_MODULUS = 1 << 62  # of the serial frame's 64-bit fields
SYNC_MODULUS = 1 << 24
SYNC_HZ = 10.0
UNIT_OF_CODE = ("", "m/s^2", "m/s", "m", "N", "V", "rad/s", "pulse")  # wire code -> unit

U8Array = NDArray[np.uint8]
I32Array = NDArray[np.int32]
I64Array = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One way of packing samples.

    name, code : of the layout, in words and on the wire.
    bits : of a sample.
    header : bytes before the samples.
    counter : number of values of the frame counter.
    max_channels : that a frame can carry.
    """

    name: str
    code: int
    bits: int
    header: int
    counter: int
    max_channels: int

    def rows(self, channels: int) -> int:
        """Samples (rows of all channels) in one CAN frame."""
        if self.name == "classic":
            return 1
        return (FD_LENGTH - self.header) // (channels * self.bits // 8)

    def modulus(self, channels: int) -> int:
        """The sample index is known modulo this from one frame alone."""
        return self.counter * self.rows(channels)


FD16_LAYOUT = Layout(name="fd16", code=1, bits=16, header=8, counter=1 << 16, max_channels=8)
FD24_LAYOUT = Layout(name="fd24", code=2, bits=24, header=4, counter=1 << 16, max_channels=8)
CLASSIC_LAYOUT = Layout(name="classic", code=3, bits=15, header=0, counter=16, max_channels=4)
SERIAL16_LAYOUT = Layout(name="serial16", code=4, bits=16, header=24, counter=1, max_channels=64)
SERIAL24_LAYOUT = Layout(name="serial24", code=5, bits=24, header=24, counter=1, max_channels=64)
LAYOUT_OF_NAME = {
    layout.name: layout for layout in (FD16_LAYOUT, FD24_LAYOUT, CLASSIC_LAYOUT, SERIAL16_LAYOUT, SERIAL24_LAYOUT)
}

# CAN identifiers: base + offset, 11 bit; a second device on the bus takes another base, a multiple of 8.
BASE_ID = 0x300
ID_FD16, ID_FD24, ID_CLASSIC, ID_SYNC, ID_INFO, ID_SYNC_FD, ID_INFO_PART = range(7)
SAMPLE_ID = {"fd16": ID_FD16, "fd24": ID_FD24, "classic": ID_CLASSIC}

_FD16_HEAD = np.dtype([("seq", "<u2"), ("lost", "u1"), ("flags", "u1"), ("time", "<u4")])
_FD24_HEAD = np.dtype([("seq", "<u2"), ("lost", "u1"), ("flags", "u1")])
_INFO_DTYPE = np.dtype(
    [
        ("version", "u1"), ("layout", "u1"), ("channels", "u1"), ("channel", "u1"),
        ("count_bits", "u1"), ("unit", "u1"), ("flags", "u1"), ("reserved", "u1"),
        ("serial_number", "<u4"), ("firmware", "<u4"), ("rate_hz", "<f8"), ("scale", "<f8"),
        ("offset", "<f8"), ("range", "<f8"), ("name", "S16"),
    ]
)  # fmt: skip
PART_BYTES = 6
INFO_PARTS = -(-_INFO_DTYPE.itemsize // PART_BYTES)  # CAN classic frames that carry one info record


def make_flags(clipped: NDArray[np.bool_] | bool, epoch: int, version: int = PROTOCOL_VERSION) -> U8Array:
    """Flags byte: bit 0 some sample clipped, bits 2-3 protocol version, bits 4-7 number of the start (epoch)."""
    return (np.asarray(clipped).astype(np.uint8) | ((version & 3) << 2) | ((epoch & 15) << 4)).astype(np.uint8)


def flags_version(flags: U8Array) -> U8Array:
    return np.asarray((flags >> 2) & 3, np.uint8)


def flags_epoch(flags: U8Array) -> U8Array:
    return np.asarray(flags >> 4, np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleFrames:
    """Frames of one layout, in the order of arrival, decoded but not yet placed on the index axis.

    position : (n,) index of row 0 modulo `modulus`. lost : (n,) frames the device itself dropped since its start,
    modulo 256. epoch : (n,) number of the device's start modulo 16. time_us : (n,) device clock at row 0 modulo
    `time_modulus`, or None. counts : (n, rows, channels).
    """

    position: I64Array
    modulus: int
    lost: U8Array
    epoch: U8Array
    time_us: I64Array | None
    time_modulus: int
    counts: I32Array

    def __len__(self) -> int:
        return len(self.position)


def pack_fd16(seq: I64Array, lost: U8Array, flags: U8Array, time_us: I64Array, counts: I32Array) -> U8Array:
    """(n, rows, channels) counts -> (n, 64) payloads; rows and channels as the layout has them."""
    n = len(seq)
    head = np.zeros(n, _FD16_HEAD)
    head["seq"], head["lost"], head["flags"], head["time"] = seq & 0xFFFF, lost, flags, time_us & 0xFFFFFFFF
    out = np.zeros((n, FD_LENGTH), np.uint8)
    out[:, :8] = head.view(np.uint8).reshape(n, 8)
    body = np.ascontiguousarray(counts.reshape(n, -1), "<i2").view(np.uint8).reshape(n, -1)
    out[:, 8 : 8 + body.shape[1]] = body
    return out


def unpack_fd16(payload: U8Array, channels: int) -> SampleFrames:
    """(n, 64) payloads -> frames. Reads any bytes; the caller checks length and version."""
    n, rows = len(payload), FD16_LAYOUT.rows(channels)
    head = np.ascontiguousarray(payload[:, :8]).view(_FD16_HEAD)[:, 0]
    body = payload[:, 8 : 8 + 2 * rows * channels]
    counts = np.ascontiguousarray(body).view("<i2").astype(np.int32).reshape(n, rows, channels)
    return SampleFrames(
        position=head["seq"].astype(np.int64) * rows, modulus=FD16_LAYOUT.modulus(channels), lost=head["lost"],
        epoch=flags_epoch(head["flags"]),
        time_us=head["time"].astype(np.int64), time_modulus=TIME_MODULUS_US, counts=counts,
    )  # fmt: skip


def pack_int24(counts: I32Array) -> U8Array:
    """(n, ...) counts -> (n, 3 * values) bytes, little endian two's complement."""
    n = len(counts)
    wide = np.ascontiguousarray(counts.reshape(n, -1), "<i4").view(np.uint8).reshape(n, -1, 4)
    return np.ascontiguousarray(wide[:, :, :3]).reshape(n, -1)


def unpack_int24(body: U8Array) -> I32Array:
    """(n, 3 * values) bytes -> (n, values) int32."""
    n = len(body)
    wide = np.zeros((n, body.shape[1] // 3, 4), np.uint8)
    wide[:, :, 1:] = body.reshape(n, -1, 3)
    return (wide.view("<i4")[:, :, 0] >> 8).astype(np.int32)


def pack_fd24(seq: I64Array, lost: U8Array, flags: U8Array, counts: I32Array) -> U8Array:
    n = len(seq)
    head = np.zeros(n, _FD24_HEAD)
    head["seq"], head["lost"], head["flags"] = seq & 0xFFFF, lost, flags
    out = np.zeros((n, FD_LENGTH), np.uint8)
    out[:, :4] = head.view(np.uint8).reshape(n, 4)
    body = pack_int24(counts)
    out[:, 4 : 4 + body.shape[1]] = body
    return out


def unpack_fd24(payload: U8Array, channels: int) -> SampleFrames:
    n, rows = len(payload), FD24_LAYOUT.rows(channels)
    head = np.ascontiguousarray(payload[:, :4]).view(_FD24_HEAD)[:, 0]
    counts = unpack_int24(payload[:, 4 : 4 + 3 * rows * channels]).reshape(n, rows, channels)
    return SampleFrames(
        position=head["seq"].astype(np.int64) * rows, modulus=FD24_LAYOUT.modulus(channels), lost=head["lost"],
        epoch=flags_epoch(head["flags"]),
        time_us=None, time_modulus=TIME_MODULUS_US, counts=counts,
    )  # fmt: skip


def pack_classic(seq: I64Array, counts: I32Array) -> U8Array:
    """(n, channels <= 4) counts -> (n, 8): bits 0-3 the counter, then four 15-bit two's complement samples."""
    word = (seq & 15).astype(np.uint64)
    for channel in range(counts.shape[1]):
        value = (counts[:, channel].astype(np.int64) & 0x7FFF).astype(np.uint64)
        word |= value << np.uint64(4 + 15 * channel)
    return np.ascontiguousarray(word, "<u8").view(np.uint8).reshape(-1, 8)


def unpack_classic(payload: U8Array, channels: int) -> tuple[I64Array, I32Array]:
    """(n, >=8) payloads -> counter (n,), counts (n, channels)."""
    word = np.ascontiguousarray(payload[:, :8]).view("<u8")[:, 0]
    raw = np.stack([(word >> np.uint64(4 + 15 * c)) & np.uint64(0x7FFF) for c in range(channels)], axis=1)
    counts = ((raw.astype(np.int32) << 17) >> 17).astype(np.int32)
    return (word & np.uint64(15)).astype(np.int64), counts


def pack_sync(index: int, flags: int, time_us: int) -> bytes:
    """8 bytes: sample index (24 bit), flags, device time (us) of that sample."""
    word = (index % SYNC_MODULUS) | (flags << 24)
    return word.to_bytes(4, "little") + (time_us % TIME_MODULUS_US).to_bytes(4, "little")


def pack_sync_fd(index: int, flags: int, time_us: int) -> bytes:
    """12 bytes: sample index (56 bit), flags, device time (us) of that sample."""
    return index.to_bytes(7, "little") + bytes((flags,)) + (time_us % TIME_MODULUS_US).to_bytes(4, "little")


def unpack_sync_fd(payload: bytes) -> tuple[int, int, int]:
    return int.from_bytes(payload[:7], "little"), payload[7], int.from_bytes(payload[8:12], "little")


def unpack_sync(payload: bytes) -> tuple[int, int, int]:
    word = int.from_bytes(payload[:4], "little")
    return word & 0xFFFFFF, word >> 24, int.from_bytes(payload[4:8], "little")


@dataclass(frozen=True, slots=True)
class InfoRecord:
    """One channel of the device's description; 64 bytes on the wire, the same on every link.

    layout : code of the layout of the sample frames.
    channels, channel : number of channels, and which one this record describes.
    count_bits : of a sample, as of `Info`.
    serial_number : of the device.
    rate_hz : sampling rate, Hz.
    signal : name, unit, scale and offset of the channel.
    full_scale : value of the largest count, in the unit of the channel.
    epoch : number of the device's start, modulo 16.
    firmware, version : of the device's program, and of the protocol.
    """

    layout: int
    channels: int
    channel: int
    count_bits: int
    _: KW_ONLY
    serial_number: int
    rate_hz: float
    signal: Signal
    full_scale: float
    epoch: int = 0
    firmware: int = 0
    version: int = PROTOCOL_VERSION


def pack_info(record: InfoRecord) -> bytes:
    row = np.zeros(1, _INFO_DTYPE)
    row["version"], row["layout"], row["channels"], row["channel"] = (
        record.version, record.layout, record.channels, record.channel)  # fmt: skip
    row["count_bits"], row["unit"] = record.count_bits, UNIT_OF_CODE.index(record.signal.unit)
    row["flags"] = make_flags(False, record.epoch, record.version)
    row["serial_number"], row["firmware"], row["rate_hz"] = record.serial_number, record.firmware, record.rate_hz
    row["scale"], row["offset"], row["range"] = record.signal.scale, record.signal.offset, record.full_scale
    row["name"] = record.signal.name.encode("ascii", "replace")[:16]
    return row.tobytes()


def unpack_info(data: bytes) -> InfoRecord | None:
    """The record, or None if these bytes cannot be one. The version is in byte 0 of every version's record."""
    if len(data) != _INFO_DTYPE.itemsize:
        return None
    row = np.frombuffer(data, _INFO_DTYPE)[0]
    unit = UNIT_OF_CODE[row["unit"]] if row["unit"] < len(UNIT_OF_CODE) else ""
    record = InfoRecord(
        layout=int(row["layout"]), channels=int(row["channels"]), channel=int(row["channel"]),
        count_bits=int(row["count_bits"]), serial_number=int(row["serial_number"]), rate_hz=float(row["rate_hz"]),
        signal=Signal(
            bytes(row["name"]).decode("ascii", "replace"), unit, float(row["scale"]), float(row["offset"]),
        ),
        full_scale=float(row["range"]), epoch=int(row["flags"]) >> 4, firmware=int(row["firmware"]),
        version=int(row["version"]),
    )  # fmt: skip
    if record.version != PROTOCOL_VERSION:
        return record  # only the version means anything
    layout = next((each for each in LAYOUT_OF_NAME.values() if each.code == record.layout), None)
    finite = np.isfinite([record.rate_hz, record.signal.scale, record.signal.offset, record.full_scale]).all()
    if layout is None or not finite or record.rate_hz <= 0 or record.signal.scale == 0:
        return None
    if not 1 <= record.channels <= layout.max_channels or record.channel >= record.channels:
        return None
    if not 2 <= record.count_bits <= 32:
        return None
    return record


def pack_info_parts(record: InfoRecord) -> list[bytes]:
    """The record as classic CAN payloads: channel, part number, six bytes of the record."""
    data = pack_info(record).ljust(INFO_PARTS * PART_BYTES, b"\0")
    return [bytes((record.channel, k)) + data[k * PART_BYTES : (k + 1) * PART_BYTES] for k in range(INFO_PARTS)]
