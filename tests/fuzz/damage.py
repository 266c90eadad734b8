"""Damaged copies of good inputs, cheap enough for millions."""

from __future__ import annotations

import io
import random
import re
import struct
import zipfile
import zlib

ODD = (
    b"\0", b"\xff", b"\x7f", b"\x80", b"\r", b"\n", b",", b"0", b"-", b"\xff\xff\xff\xff", b"\0\0\0\x80", b"nan",
    b"9e9",
)  # fmt: skip
VALUES = (
    b"0", b"-1", b"1", b"nan", b"-inf", b"1e-320", b"1e308", b"9999999999999999999999", b"true", b'""', b'"x"', b"[]",
    b"{}", b"[[1]]", b'["bearing1.x"]', b'{ value = 1 }', b"2026-01-01", b'"\\u0000"', b"0x10", b'"../../etc/passwd"',
    b'"hertz"', b'"bearing1"', b'"y"', b'"force"', b'"m/s^2"', b'"can:socketcan:can0"', b'"k*x"', b'"a.py:B"',
)  # fmt: skip
_VALUE = re.compile(rb'"[^"\n]*"|(?<![\w"])-?\d[\w.+-]*|\btrue\b|\bfalse\b')
NPY_VALUES = (
    b"'<f8'", b"'|O'", b"'<M8[s]'", b"'<U2'", b"'|V9999999999'", b"'<f3'", b"[('a', '<f8')]", b"[('a', '<i4', (9, 9))]",
    b"True", b"False", b"None", b"()", b"(6,)", b"(-1,)", b"(0,)", b"(3, 2)", b"(2, -3)", b"(1, 1, 6)", b"(6.0,)",
    b"(99999999999,)", b"(4294967296, 4294967296)", b"(9223372036854775807,)", b"(0, 9999999999999999999999)", b"''",
)  # fmt: skip
_NPY_VALUE = re.compile(rb"'[<>|=][^']*'|\([^)]*\)|True|False")
JSON_VALUES = (
    b"null", b"true", b"[]", b"{}", b'[["b1x"]]', b'{"b1x": 1}', b'""', b'"b1x"', b'"b1y"', b'"time"', b'"m/s^2"',
    b"NaN", b'"\\u0000"', b'"\\ud800"', b"-1e999",
    b"9" * 5000, b"[" * 3000, b'"' + b"x" * 2000 + b'"', b'"\xff"', b'"a\nb"',
)  # fmt: skip
_BLOCK = re.compile(rb"##[A-Z]{2}")
_JSON_VALUE = re.compile(rb'"[^"]*"|\d+')
_LOCAL, _CENTRAL, _END = struct.Struct("<4s5H3I2H"), struct.Struct("<4s6H3I5H2I"), struct.Struct("<4s4H2IH")


def damaged(data: bytes, rng: random.Random) -> bytes:
    """One to four pieces overwritten, cut out, doubled or flipped."""
    out = bytearray(data)
    for _ in range(1 + int(rng.random() * rng.random() * 4)):
        at, how = int(rng.random() ** 2 * (len(out) + 1)), int(rng.random() * 8)  # heads more often
        if how < 3 and at < len(out):
            out[at] = int(rng.random() * 256)
        elif how == 3 and at < len(out):
            out[at] ^= 1 << int(rng.random() * 8)
        elif how == 4:
            del out[at : at + 1 + int(rng.random() * rng.random() * 16)]
        elif how == 5:
            out[at:at] = out[at : at + 1 + int(rng.random() * 16)]
        elif how == 6:
            odd = ODD[int(rng.random() * len(ODD))]
            out[at : at + len(odd)] = odd
        else:
            out[at:at] = ODD[int(rng.random() * len(ODD))]
    return bytes(out)


def damaged_evenly(data: bytes, rng: random.Random) -> bytes:
    """The same, anywhere alike: for texts without a head."""
    cut = int(rng.random() * len(data))
    return data[:cut] + damaged(data[cut:], rng)


def damaged_text(data: bytes, rng: random.Random) -> bytes:
    """A rig file: bytes of it, or its values and lines, so that it is still a TOML file with something wrong in it."""
    if rng.random() < 0.3:
        return damaged_evenly(data, rng)
    lines = data.split(b"\n")
    for _ in range(1 + int(rng.random() * rng.random() * 4)):
        at, how = int(rng.random() * len(lines)), rng.random()
        if how < 0.7:
            found = list(_VALUE.finditer(lines[at]))
            if found:
                one = found[int(rng.random() * len(found))]
                new = VALUES[int(rng.random() * len(VALUES))]
                lines[at] = lines[at][: one.start()] + new + lines[at][one.end() :]
        elif how < 0.8:
            del lines[at : at + 1]
            lines = lines or [b""]
        elif how < 0.9:
            lines.insert(int(rng.random() * len(lines)), lines[at])
        else:
            lines[at] = damaged(lines[at], rng)
    return b"\n".join(lines)


def damaged_table(data: bytes, rng: random.Random) -> bytes:
    """A table of a rig file that is still one: a value or two replaced, a key renamed, a line gone."""
    lines = data.split(b"\n")
    for _ in range(1 + int(rng.random() * rng.random() * 3)):
        at, how = 1 + int(rng.random() * (len(lines) - 1)), rng.random()
        found = list(_VALUE.finditer(lines[at])) if at < len(lines) else []
        if not found:
            continue
        if how < 0.8:
            one = found[int(rng.random() * len(found))]
            new = VALUES[int(rng.random() * len(VALUES))]
            lines[at] = lines[at][: one.start()] + new + lines[at][one.end() :]
        elif how < 0.9:
            lines[at] = lines[at][: 1 + int(rng.random() * 3)] + lines[at]
        else:
            del lines[at]
    return b"\n".join(lines)


def damaged_npy(data: bytes, rng: random.Random) -> bytes:
    """An array: bytes of it, or its header with another type, shape or order, as long as it was."""
    at = 10 + int.from_bytes(data[8:10], "little")
    if rng.random() < 0.4:
        return damaged_evenly(data, rng)
    found = list(_NPY_VALUE.finditer(data, 10, at))
    one = found[int(rng.random() * len(found))]
    new = data[10 : one.start()] + NPY_VALUES[int(rng.random() * len(NPY_VALUES))] + data[one.end() : at]
    new = new.rstrip(b" \n")
    return data[:10] + new.ljust(max(at - 11, len(new))) + b"\n" + data[at:]


def damaged_answer_member(data: bytes, rng: random.Random) -> bytes:
    """Its place, its array, or the text that it is."""
    how = rng.random()
    if how < 0.1:
        return bytes((int(rng.random() * 256),)) + data[1:]
    if how < 0.4 and b"|u1" in data:  # names, units
        at = 11 + int.from_bytes(data[9:11], "little")
        text = damaged_json(data[at:], rng)
        head = re.sub(rb"\(\d+,\), } *", b"(%d,), }" % len(text), data[11 : at - 1])
        return data[:11] + head.ljust(at - 12) + b"\n" + text
    return data[:1] + damaged_npy(data[1:], rng)


INTS = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    8,
    9,
    10,
    12,
    14,
    15,
    16,
    17,
    24,
    64,
    104,
    255,
    256,
    0x7FFF,
    0xFFFF,
    0x40000,
    0x7FFFFFFF,
)
INTS += (0x80000000, 0xFFFFFFFF, 0xFFFFFFF8, 1 << 32, 0x7FFFFFFFFFFFFFFF, (1 << 64) - 1)


def damaged_words(data: bytes, rng: random.Random, width: int, more: tuple[int, ...] = ()) -> bytes:
    """One to three aligned numbers of it by others, by what the file has elsewhere, or by some more."""
    out = bytearray(data)
    for _ in range(1 + int(rng.random() * rng.random() * 3)):
        at, how = width * int(rng.random() * (len(data) // width)), rng.random()
        if how < 0.2 and more:
            new = more[int(rng.random() * len(more))]
        elif how < 0.5:
            there = width * int(rng.random() * (len(data) // width))
            new = int.from_bytes(data[there : there + width], "little")
        elif how < 0.6:
            new = int.from_bytes(data[at : at + width], "little") + (1, -1, 8, -8)[int(rng.random() * 4)]
        else:
            new = INTS[int(rng.random() * len(INTS))]
        out[at : at + width] = (new % (1 << 8 * width)).to_bytes(width, "little")
    return bytes(out)


MI_MATRIX, MI_COMPRESSED = 14, 15


def damaged_variable(data: bytes, rng: random.Random) -> bytes:
    """Its place or format, bytes of it, or its sizes, types and flags; of a packed one those that are packed."""
    how = rng.random()
    if how < 0.05:
        return bytes((int(rng.random() * 256),)) + data[1:]
    packed = int.from_bytes(data[1:5], "little") == MI_COMPRESSED and how < 0.9
    body = zlib.decompress(data[9:]) if packed else data[1:]
    body = damaged(body, rng) if rng.random() < 0.4 else damaged_words(body, rng, 4 if rng.random() < 0.7 else 2)
    if packed:
        body = zlib.compress(body, 1)
        body = data[1:5] + len(body).to_bytes(4, "little") + body
    return data[:1] + body


def damaged_blocks(data: bytes, rng: random.Random) -> bytes:
    """An .mf4 file: bytes of it, or its links and numbers; most often what one block links to."""
    how = rng.random()
    if how < 0.25:
        return damaged_evenly(data, rng)
    blocks = tuple(found.start() for found in _BLOCK.finditer(data))
    at = blocks[int(rng.random() * len(blocks))] & ~7
    width = 8 if how < 0.7 else (4, 2, 1)[int(rng.random() * 3)]
    return data[:at] + damaged_words(data[at:], rng, width, (*blocks, 0, len(data), at))


def damaged_json(data: bytes, rng: random.Random) -> bytes:
    """Bytes of it, or one of its texts by another value."""
    found = list(_JSON_VALUE.finditer(data))
    if rng.random() < 0.5 or not found:
        return damaged_evenly(data, rng)
    one = found[int(rng.random() * len(found))]
    return data[: one.start()] + JSON_VALUES[int(rng.random() * len(JSON_VALUES))] + data[one.end() :]


def damaged_zip(data: bytes, rng: random.Random) -> bytes:
    """The archive itself, or one of its members behind a right check sum."""
    if rng.random() < 0.4:
        return damaged(data, rng)
    members = list(_members(data))
    at = int(rng.random() * len(members))
    members[at] = (members[at][0], damaged(members[at][1], rng))
    return zipped(members)


def damaged_answer(data: bytes, rng: random.Random) -> bytes:
    """A status byte, then an archive or a text."""
    if data[1:3] != b"PK" or rng.random() < 0.1:
        return damaged(data, rng)
    return data[:1] + damaged_zip(data[1:], rng)


_unzipped: dict[bytes, list[tuple[bytes, bytes]]] = {}


def _members(data: bytes) -> list[tuple[bytes, bytes]]:
    if data not in _unzipped:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            _unzipped[data] = [(name.encode(), file.read(name)) for name in file.namelist()]
    return _unzipped[data]


def zipped(members: list[tuple[bytes, bytes]]) -> bytes:
    """As zipfile would, at a tenth of the time."""
    out, index, at = [], [], 0
    for name, data in members:
        crc, size = zlib.crc32(data), len(data)
        head = _LOCAL.pack(b"PK\3\4", 20, 0, 0, 0, 33, crc, size, size, len(name), 0) + name
        out += [head, data]
        entry = _CENTRAL.pack(b"PK\1\2", 20, 20, 0, 0, 0, 33, crc, size, size, len(name), 0, 0, 0, 0, 0, at)
        index.append(entry + name)
        at += len(head) + size
    listed = b"".join(index)
    return b"".join(out) + listed + _END.pack(b"PK\5\6", 0, 0, len(index), len(index), len(listed), at, 0)
