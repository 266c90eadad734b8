"""COBS framing with a CRC-32 at the end of each frame, over whole buffers at once.

On the wire: COBS(body + CRC-32 of the body, little endian) + 0x00. The CRC is IEEE 802.3's (zlib.crc32). Compiled,
because small samples are full of zero bytes, and each is a step of the COBS chain.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

MAX_FRAME = 4096  # encoded bytes between two zeros; more is garbage and is dropped unseen

U8Array = NDArray[np.uint8]


def _crc_tables() -> NDArray[np.uint32]:
    """Eight tables (8, 256): a CRC of eight bytes a step (slicing by eight)."""
    table = np.zeros((8, 256), np.uint32)
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = (crc >> 1) ^ (0xEDB88320 if crc & 1 else 0)
        table[0, value] = crc
    for k in range(1, 8):
        table[k] = table[0][table[k - 1] & 0xFF] ^ (table[k - 1] >> np.uint32(8))
    return table


_CRC_TABLES = _crc_tables()


@nb.njit(cache=True)
def _crc32(data: U8Array, start: int, stop: int, tables: NDArray[np.uint32]) -> np.uint32:
    crc = np.uint32(0xFFFFFFFF)
    i = start
    while i + 8 <= stop:
        crc ^= (
            np.uint32(data[i]) | (np.uint32(data[i + 1]) << np.uint32(8))
            | (np.uint32(data[i + 2]) << np.uint32(16)) | (np.uint32(data[i + 3]) << np.uint32(24))
        )  # fmt: skip
        crc = np.uint32(
            tables[7, crc & np.uint32(0xFF)] ^ tables[6, (crc >> np.uint32(8)) & np.uint32(0xFF)]
            ^ tables[5, (crc >> np.uint32(16)) & np.uint32(0xFF)] ^ tables[4, crc >> np.uint32(24)]
            ^ tables[3, data[i + 4]] ^ tables[2, data[i + 5]] ^ tables[1, data[i + 6]] ^ tables[0, data[i + 7]]
        )  # fmt: skip
        i += 8
    while i < stop:
        crc = np.uint32(tables[0, (crc ^ np.uint32(data[i])) & np.uint32(0xFF)] ^ (crc >> np.uint32(8)))
        i += 1
    return np.uint32(crc ^ np.uint32(0xFFFFFFFF))


@nb.njit(cache=True)
def _deframe(
    data: U8Array, tables: NDArray[np.uint32], out: U8Array, starts: NDArray[np.int64], stops: NDArray[np.int64]
) -> tuple[int, int]:
    """Decode every zero-terminated frame. stops[k] = -1 marks a damaged one. Returns (frames, bytes consumed)."""
    n, frames, consumed, write = data.size, 0, 0, 0
    i = 0
    while i < n:
        if data[i] != 0:
            i += 1
            continue
        begin, end = consumed, i
        consumed = i + 1
        i += 1
        if end == begin:
            continue  # zeros between frames are idle filling
        first, read, good = write, begin, end - begin <= 4096
        while good and read < end:
            code = int(data[read])
            if read + code > end:
                good = False
                break
            for k in range(read + 1, read + code):
                out[write] = data[k]
                write += 1
            read += code
            if code < 255 and read < end:
                out[write] = 0
                write += 1
        length = write - first - 4
        if good and length > 0:
            want = (
                np.uint32(out[write - 4]) | (np.uint32(out[write - 3]) << np.uint32(8))
                | (np.uint32(out[write - 2]) << np.uint32(16)) | (np.uint32(out[write - 1]) << np.uint32(24))
            )  # fmt: skip
            good = _crc32(out, first, write - 4, tables) == want
        else:
            good = False
        starts[frames] = first
        if good:
            write -= 4  # the next body follows at once: equal bodies lie in one array
            stops[frames] = write
        else:
            write = first
            stops[frames] = -1
        frames += 1
    return frames, consumed


@dataclass(frozen=True, slots=True)
class Bodies:
    """Bodies of one feed: body k is data[starts[k]:stops[k]], damaged if stops[k] < 0; good bodies are adjacent."""

    data: U8Array
    starts: NDArray[np.int64]
    stops: NDArray[np.int64]


class Deframer:
    """Bytes in, bodies out; keeps at most MAX_FRAME bytes of an unfinished frame."""

    def __init__(self) -> None:
        self._tail = b""
        self._skipping = False  # in a run of more than MAX_FRAME bytes without a zero
        self._synchronised = False

    def reset(self) -> None:
        """Start anew after a lost link: the next bytes may begin in the middle of a frame."""
        self._tail, self._skipping, self._synchronised = b"", False, False

    def warm(self) -> None:
        """Compile now (or load the compiled code), not when the first bytes wait."""
        Deframer().feed(b"\0")

    def feed(self, chunk: bytes) -> Bodies:
        raw = self._tail + chunk
        data = np.frombuffer(raw, np.uint8)
        zeros = raw.count(0)
        starts, stops = np.empty(zeros, np.int64), np.empty(zeros, np.int64)
        out = np.empty(len(raw) + 1, np.uint8)
        frames, consumed = _deframe(data, _CRC_TABLES, out, starts, stops)
        starts, stops = starts[:frames], stops[:frames]
        self._tail = raw[consumed:]
        if frames and self._skipping:
            self._skipping = False
            stops[0] = -1
        if frames and not self._synchronised:
            self._synchronised = True
            if stops[0] < 0:  # the first piece of a running stream is not an error
                starts, stops = starts[1:], stops[1:]
        if len(self._tail) > MAX_FRAME:
            self._tail, self._skipping = b"\xff", True
        return Bodies(out, starts, stops)


def encode(body: bytes) -> bytes:
    """One frame as it goes on the wire, delimiter included.

    >>> encode(bytes.fromhex("0100")).hex()
    '020105be23c25800'
    """
    return stuff(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0"


def stuff(data: bytes) -> bytes:
    """COBS (Cheshire and Baker 1999) without the delimiter."""
    out = np.empty(len(data) + len(data) // 254 + 2, np.uint8)
    return out[: _stuff(np.frombuffer(data, np.uint8), out)].tobytes()


@nb.njit(cache=True)
def _stuff(data: U8Array, out: U8Array) -> int:
    """Returns the bytes written."""
    code_at, write, open_block = 0, 1, True
    for k in range(data.size):
        if not open_block:
            code_at, write, open_block = write, write + 1, True
        if data[k] == 0:
            out[code_at] = write - code_at
            code_at, write = write, write + 1
        else:
            out[write] = data[k]
            write += 1
            if write - code_at == 255:
                out[code_at] = 255
                open_block = False
    if open_block:
        out[code_at] = write - code_at
    return write
