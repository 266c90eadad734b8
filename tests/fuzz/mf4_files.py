"""Small .mf4 files of version 4, block by block: a channel and its times, and the forms that its blocks may have."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

N = 6
TIME, VALUES = np.arange(N) / 25_600, np.arange(float(N))
FLOAT, INT, MASTER, FIXED = 4, 2, 2, 0  # data types; channel types


@dataclass(frozen=True, slots=True)
class Block:
    """links : of the names of others, "" for none."""

    kind: bytes
    links: Sequence[str]
    data: bytes

    def sized(self) -> int:
        return -(-(24 + 8 * len(self.links) + len(self.data)) // 8) * 8


def mf4(blocks: dict[str, Block]) -> bytes:
    """The first is the header."""
    head = struct.pack("<8s8s8s4xH30xHH", b"MDF     ", b"4.10    ", b"fuzz", 410, 0, 0)
    at, places = len(head), {"": 0}
    for name, block in blocks.items():
        places[name] = at
        at += block.sized()
    out = [head]
    for block in blocks.values():
        links = [places[link] for link in block.links]
        text = struct.pack("<4s4xQQ", b"##" + block.kind, 24 + 8 * len(links) + len(block.data), len(links))
        out.append((text + struct.pack(f"<{len(links)}Q", *links) + block.data).ljust(block.sized(), b"\0"))
    return b"".join(out)


def _text(text: bytes) -> Block:
    return Block(b"TX", (), text + b"\0")


def _channel(
    follows: str, name: str, kind: int, data_type: int, at: int, bits: int, law: str = "", data: str = ""
) -> Block:
    links = (follows, "", name, "", law, data, "", "")
    numbers = struct.pack("<4B4I2BH6d", kind, kind == MASTER, data_type, 0, at, bits, 0, 0, 0, 0, 0, *[0.0] * 6)
    return Block(b"CN", links, numbers)


def _whole(records: bytes, data: dict[str, Block], value: Block, record_id: int = 0, **more: Block) -> bytes:
    group = struct.pack("<QQHH4xII", int(record_id > 0), N, 0, 0, len(records) // N - record_id, 0)
    return mf4({
        "hd": Block(b"HD", ("dg", "", "", "", "", ""), bytes(32)),
        "dg": Block(b"DG", ("", "cg", next(iter(data)), ""), struct.pack("<B7x", record_id)),
        "cg": Block(b"CG", ("", "t", "", "", "", ""), group),
        "t": _channel("v", "t name", MASTER, FLOAT, 0, 64),
        "v": value,
        "t name": _text(b"t"), "v name": _text(b"b1x"), **more, **data,
    })  # fmt: skip


def small_mf4s() -> list[bytes]:
    rows = b"".join(struct.pack("<dd", *row) for row in zip(TIME, VALUES, strict=True))
    counts = b"".join(struct.pack("<dh", t, int(v)) for t, v in zip(TIME, VALUES, strict=True))
    plain = {"dt": Block(b"DT", (), rows)}
    value = _channel("", "v name", FIXED, FLOAT, 8, 64)
    count = _channel("", "v name", FIXED, INT, 8, 16, "law")
    law = {
        k: _law(k, p) for k, p in ((1, (0.5, 2.0)), (2, (0, 1, 2, 0, 0, 1)), (4, (0, 0.0, 5, 9.0)), (5, (0, 1, 5, 2)))
    }
    with_unit = Block(b"CN", ("", "", "v name", "source", "", "", "unit", "odd"), value.data)
    source = Block(b"SI", ("unit", "", ""), struct.pack("<BBB5x", 1, 2, 0))
    packed, turned = zlib.compress(rows, 1), zlib.compress(np.frombuffer(rows, "u1").reshape(N, -1).T.tobytes(), 1)
    marked = b"".join(b"\1" + rows[k : k + 16] for k in range(0, len(rows), 16))
    listed = {
        "hl": Block(b"HL", ("dl",), struct.pack("<HB5x", 1, 0)),
        "dl": Block(b"DL", ("", "one", "two"), struct.pack("<B3xIQ", 1, 2, 48)),
        "one": Block(b"DT", (), rows[:48]), "two": Block(b"DT", (), rows[48:]),
    }  # fmt: skip
    out = [
        _whole(rows, plain, value),
        _whole(rows, plain, with_unit, unit=_text(b"g"), source=source, odd=_text(b"\xb0")),
    ]
    out += [_whole(counts, {"dt": Block(b"DT", (), counts)}, count, law=one) for one in law.values()]
    for kind, data, width in ((0, packed, 0), (1, turned, 16)):
        head = struct.pack("<2sBxIQQ", b"DT", kind, width, len(rows), len(data))
        out.append(_whole(rows, {"dz": Block(b"DZ", (), head + data)}, value))
    out += [_whole(rows, listed, value), _whole(marked, {"dt": Block(b"DT", (), marked)}, value, 1)]
    out.append(_texts())
    return out


def _law(kind: int, parameters: Sequence[float]) -> Block:
    numbers = struct.pack("<BBHHHdd", kind, 0, 0, 0, len(parameters), 0.0, 0.0)
    return Block(b"CC", ("", "", "", ""), numbers + struct.pack(f"<{len(parameters)}d", *parameters))


def _texts() -> bytes:
    """A channel whose values lie elsewhere, of any length each."""
    words = b"".join(struct.pack("<I3s", 3, b"%03d" % k) for k in range(N))
    rows = b"".join(struct.pack("<dQ", t, 7 * k) for k, t in enumerate(TIME))
    value = _channel("", "v name", 1, 6, 8, 64, data="sd")
    return _whole(rows, {"dt": Block(b"DT", (), rows)}, value, sd=Block(b"SD", (), words))
