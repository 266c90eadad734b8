"""The DBC text of protocol v1: configs/rotorscope.dbc is this for four channels and the usual identifiers.

`python -m drivers.protocol.protocol_dbc > configs/rotorscope.dbc` writes it; a test holds the two together.
"""

from __future__ import annotations

import sys

from . import protocol
from .protocol import FD16_LAYOUT, FD24_LAYOUT, INFO_PARTS

_COMMENT_OF_LAYOUT = {
    "fd16": "CAN FD, int16 samples. sequence = (sample index / rows) mod 65536; time of row 0. docs/protocol.md",
    "fd24": "CAN FD, int24 samples. Stamped by sync_fd ten times a second",
    "classic": "Classic CAN, 15-bit samples, one row a frame; counter = sample index mod 16. Placed by sync",
    "sync": "Ten times a second on classic CAN, before the sample it names",
    "sync_fd": "Ten times a second with fd24, before the frame it names",
    "info": "Once a second and at the start, one frame for each channel",
    "info_part": f"The info frame in {INFO_PARTS} parts of six bytes, for classic CAN",
}


def dbc_text(channels: int = 4, base_id: int = protocol.BASE_ID) -> str:
    """A DBC file for a device with this many channels (at most 8; classic CAN is described up to 4)."""
    messages = [_fd16(channels), _fd24(channels)]
    if channels <= 4:
        messages.append(_classic(channels))
    messages += [_sync(), _info(), _sync_fd(), _info_part()]
    lines = ['VERSION "rotorscope protocol 1"', "", "NS_ :", "", "BS_:", "", "BU_: device host", ""]
    for name, offset, length, signals in messages:
        lines.append(f"BO_ {base_id + offset} {name}: {length} device")
        for signal, start, bits, sign, scale, low, high, unit, _ in signals:
            lines.append(f' SG_ {signal} : {start}|{bits}@1{sign} ({scale},0) [{low}|{high}] "{unit}" host')
        lines.append("")
    for name, offset, _, _ in messages:
        lines.append(f'CM_ BO_ {base_id + offset} "{_COMMENT_OF_LAYOUT[name]}";')
    formats = ",".join(f'"{name}"' for name in _FRAME_FORMATS)
    lines += [f'BA_DEF_ BO_ "VFrameFormat" ENUM {formats};', 'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";']
    for _, offset, length, _ in messages:
        if length > 8:
            lines.append(f'BA_ "VFrameFormat" BO_ {base_id + offset} 14;')
    for _, offset, _, signals in messages:
        for signal, *_, floating in signals:
            if floating:
                lines.append(f"SIG_VALTYPE_ {base_id + offset} {signal} : 2;")
    return "\n".join(lines) + "\n"


# What tools expect of this attribute: 14 is a standard CAN FD frame.
_FRAME_FORMATS = ("StandardCAN", "ExtendedCAN", "reserved", "J1939PG", *(f"reserved{k}" for k in range(4, 14)),
            "StandardCAN_FD", "ExtendedCAN_FD")  # fmt: skip
_Row = tuple[str, int, int, str, str, str, str, str, bool]
_Message = tuple[str, int, int, list[_Row]]


def _unsigned(name: str, start: int, bits: int, unit: str = "") -> _Row:
    return name, start, bits, "+", "1", "0", str(2**bits - 1), unit, False


def _signed(name: str, start: int, bits: int) -> _Row:
    return name, start, bits, "-", "1", str(-(2 ** (bits - 1))), str(2 ** (bits - 1) - 1), "count", False


def _double(name: str, start: int, unit: str = "") -> _Row:
    return name, start, 64, "-", "1", "0", "0", unit, True


def _head() -> list[_Row]:
    return [_unsigned("sequence", 0, 16), _unsigned("device_lost", 16, 8, "frame"), *_flags(24)]


def _flags(start: int) -> list[_Row]:
    return [_unsigned("clipped", start, 1), _unsigned("version", start + 2, 2), _unsigned("epoch", start + 4, 4)]


def _samples(first_bit: int, bits: int, rows: int, channels: int) -> list[_Row]:
    return [
        _signed(f"s{row}_c{channel}", first_bit + bits * (row * channels + channel), bits)
        for row in range(rows)
        for channel in range(channels)
    ]


def _fd16(channels: int) -> _Message:
    head = [*_head(), _unsigned("time", 32, 32, "us")]
    return "fd16", protocol.ID_FD16, 64, head + _samples(64, 16, FD16_LAYOUT.rows(channels), channels)


def _fd24(channels: int) -> _Message:
    return "fd24", protocol.ID_FD24, 64, _head() + _samples(32, 24, FD24_LAYOUT.rows(channels), channels)


def _classic(channels: int) -> _Message:
    return "classic", protocol.ID_CLASSIC, 8, [_unsigned("counter", 0, 4), *_samples(4, 15, 1, channels)]


def _sync() -> _Message:
    return "sync", protocol.ID_SYNC, 8, [_unsigned("index", 0, 24), *_flags(24), _unsigned("time", 32, 32, "us")]


def _sync_fd() -> _Message:
    return "sync_fd", protocol.ID_SYNC_FD, 12, [
        _unsigned("index", 0, 56), *_flags(56), _unsigned("time", 64, 32, "us")]  # fmt: skip


def _info() -> _Message:
    names = ("protocol_version", "layout", "channels", "channel", "count_bits", "unit_code")
    rows = [_unsigned(name, 8 * k, 8) for k, name in enumerate(names)]
    rows += [*_flags(48), _unsigned("serial_number", 64, 32), _unsigned("firmware", 96, 32)]
    rows += [_double("rate", 128, "Hz"), _double("scale", 192), _double("offset", 256), _double("range", 320)]
    rows += [_unsigned("name_low", 384, 64), _unsigned("name_high", 448, 64)]
    return "info", protocol.ID_INFO, 64, rows


def _info_part() -> _Message:
    return "info_part", protocol.ID_INFO_PART, 8, [
        _unsigned("channel", 0, 8), _unsigned("part", 8, 8), _unsigned("bytes", 16, 48)]  # fmt: skip


if __name__ == "__main__":
    sys.stdout.write(dbc_text())
