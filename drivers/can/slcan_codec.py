"""slcan (LAWICEL, with CAN FD lines): bytes in, CAN frames out, a whole buffer at once. Pure; never raises.

A line must be exact: a digit missing anywhere makes a damaged line, because a frame one byte short would otherwise
pass. Where only the end of a line is lost, both of its frames are whole. Adapters that append time stamps append them
to every line, so the first good lines decide whether lines end with a stamp.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .can_frames import EXTENDED_FLAG, REMOTE_FLAG, CanFrames

MINUTE_MS, WORD_MS = 60_000, 65_536  # stamps count to either
QUIET_MS = 2000  # by which the host's clock decides between the two: reads are never so late
MAX_LINE = 160  # the longest is 1 + 8 + 1 + 128 + 8
Bytes = NDArray[np.uint8]
Integers = NDArray[np.int64]
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_LENGTH_OF_CODE = np.array(FD_LENGTHS, np.int64)  # bytes, by data length code
_HEX_VALUES = np.full(256, 255, np.uint8)  # by ASCII code; 255 where the character is no hexadecimal digit
for _digit, _character in enumerate("0123456789ABCDEF"):
    _HEX_VALUES[ord(_character)] = _HEX_VALUES[ord(_character.lower())] = _digit
_DATA_FORM = b"|".join(b"%d[0-9A-Fa-f]{%d}" % (size, 2 * size) for size in range(9))
_LOST_END = re.compile(  # after a whole frame, with or without a stamp: a letter that stands in no payload
    b"((?:t[0-9A-Fa-f]{3}|T[0-9A-Fa-f]{8})(?:%s)(?:[0-9A-Fa-f]{4}){0,2})(?=[tTrR])" % _DATA_FORM
)


@nb.njit(cache=True)
def _number(data: Bytes, start: int, digits: int, hexadecimal: Bytes) -> int:
    """Value of a run of hexadecimal digits, -1 if one is none."""
    value = 0
    for i in range(start, start + digits):
        digit = hexadecimal[data[i]]
        if digit > 15:
            return -1
        value = value * 16 + int(digit)
    return value


@nb.njit(cache=True)
def _is_extended(kind: int) -> bool:
    """Whether a line of this letter is a frame of a 29-bit identifier: T R D B."""
    return kind == 84 or kind == 82 or kind == 68 or kind == 66


@nb.njit(cache=True)
def _is_standard(kind: int) -> bool:
    """Whether a line of this letter is a frame of an 11-bit identifier: t r d b."""
    return kind == 116 or kind == 114 or kind == 100 or kind == 98


@nb.njit(cache=True)
def _is_reply(kind: int, length: int) -> bool:
    """Whether a line answers a command; z Z: sent; V N F: version, number, status."""
    sent = length == 1 and (kind == 122 or kind == 90)
    return sent or (length <= 5 and (kind == 86 or kind == 78 or kind == 70))


@nb.njit(cache=True)
def _is_remote(kind: int) -> bool:
    """Whether a line of this letter is a remote request: R r."""
    return kind == 82 or kind == 114


@nb.njit(cache=True)
def _is_valid(identifier: int, code: int, kind: int) -> bool:
    """Whether identifier and data length code are possible in a frame of this letter; D d B b are CAN FD."""
    fd = kind == 68 or kind == 100 or kind == 66 or kind == 98
    largest = 0x1FFFFFFF if _is_extended(kind) else 0x7FF
    return 0 <= identifier <= largest and code >= 0 and (fd or code <= 8)


@nb.njit(cache=True)
def _is_stamp(digits: int, stamp_digits: int) -> bool:
    """Whether what follows the payload is a time stamp, or none, as in the lines before (-1: not known yet)."""
    return (digits == 0 or digits == 4 or digits == 8) and (stamp_digits < 0 or digits == stamp_digits)


@nb.njit(cache=True)
def _payload(data: Bytes, start: int, size: int, hexadecimal: Bytes, payload: Bytes, row: int) -> bool:
    """Write `size` bytes from pairs of hexadecimal digits into `row` of the payload; False if a digit is none."""
    for k in range(size):
        high = hexadecimal[data[start + 2 * k]]
        low = hexadecimal[data[start + 2 * k + 1]]
        if high > 15 or low > 15:
            return False
        payload[row, k] = high * 16 + low
    return True


@nb.njit(cache=True)
def _parse(
    data: Bytes, stamp_digits: int, damaged_run: int, hexadecimal: Bytes, lengths_of: Integers, ids: NDArray[np.uint32],
    lengths: Bytes, payload: Bytes, stamps: Integers, damaged: Integers, first_bad: int,
) -> tuple[int, int, int, int, int, int]:  # fmt: skip
    """Returns frames, bytes consumed, refusals (BEL), other replies, stamp digits, damaged lines in a row.

    damaged[k] : damaged lines just before frame k (k = frames: after the last).
    """
    frames, consumed, refused, replies = 0, 0, 0, 0
    damaged[0] = 0
    for end in range(data.size):
        byte = data[end]
        if byte == 7:
            refused += 1
            damaged[frames] += end > consumed
            consumed = end + 1
            continue
        if byte != 13:
            continue
        begin = consumed
        consumed = end + 1
        length = end - begin
        if length == 0:
            continue
        kind = data[begin]
        extended = _is_extended(kind)
        good = first_bad == 0 or begin > 0
        if good and not extended and not _is_standard(kind):
            if _is_reply(kind, length):
                replies += 1
                continue
            good = False
        head = 10 if extended else 5
        identifier, code, size, tail, stamp = -1, 0, 0, 0, -1
        if good and length >= head:
            identifier = _number(data, begin + 1, head - 2, hexadecimal)
            code = _number(data, begin + head - 1, 1, hexadecimal)
        good = _is_valid(identifier, code, kind)
        if good:
            size = 0 if _is_remote(kind) else lengths_of[code]
            tail = length - head - 2 * size
            good = _is_stamp(tail, stamp_digits)
        good = good and _payload(data, begin + head, size, hexadecimal, payload, frames)
        if good and tail > 0:
            stamp = _number(data, end - tail, tail, hexadecimal)
            good = stamp >= 0
        if not good:
            payload[frames, :] = 0
            damaged[frames] += 1
            damaged_run += 1
            stamp_digits = -1 if damaged_run >= 8 else stamp_digits
            continue
        damaged_run = 0
        stamp_digits = tail
        ids[frames] = identifier | (0x80000000 if extended else 0) | (0x40000000 if _is_remote(kind) else 0)
        lengths[frames] = size
        stamps[frames] = stamp
        frames += 1
        damaged[frames] = 0
    return frames, consumed, refused, replies, stamp_digits, damaged_run


@dataclass(frozen=True, slots=True)
class Lines:
    """Frames of one feed. damaged[k] : damaged lines before frame k; the last entry: after all frames."""

    frames: CanFrames
    damaged: NDArray[np.int64]
    refused: int
    replies: int


class SlcanCodec:
    """Keeps at most MAX_LINE bytes of an unfinished line."""

    def __init__(self) -> None:
        self._tail = b""
        self._overlong = False
        self._stamp_digits = -1
        self._damaged_run = 0
        self._stamp_ms: int | None = None
        self._stamp_ns = 0
        self._wraps_at_ms: int | None = None  # once it is certain

    def reset(self) -> None:
        self._tail, self._overlong, self._stamp_digits, self._damaged_run = b"", False, -1, 0
        self._stamp_ms = self._wraps_at_ms = None

    def warm(self) -> None:
        """Compile now (or load the compiled code), not when the first bytes wait."""
        SlcanCodec().feed(b"\r", 0)

    def feed(self, chunk: bytes, t_host_ns: int) -> Lines:
        if b"\n" in chunk:  # some adapters end lines with CR LF, or LF
            chunk = chunk.replace(b"\n", b"\r")
        raw = self._tail + chunk
        if raw.count(b"t") + raw.count(b"T") > raw.count(b"\r"):
            raw = _LOST_END.sub(rb"\1\r", raw)
        n = raw.count(b"\r")
        ids, lengths = np.empty(n + 1, np.uint32), np.empty(n + 1, np.uint8)
        payload, stamps = np.zeros((n + 1, 64), np.uint8), np.empty(n + 1, np.int64)
        damaged = np.empty(n + 2, np.int64)
        frames, consumed, refused, replies, self._stamp_digits, self._damaged_run = _parse(
            np.frombuffer(raw, np.uint8), self._stamp_digits, self._damaged_run, _HEX_VALUES, _LENGTH_OF_CODE,
            ids, lengths, payload, stamps, damaged, int(self._overlong),
        )  # fmt: skip
        if consumed:
            self._overlong = False
        self._tail = raw[consumed:]
        if len(self._tail) > MAX_LINE:
            self._tail, self._overlong = b"?", True
        times = self._times(stamps[:frames], t_host_ns)
        found = CanFrames(ids[:frames], lengths[:frames], payload[:frames], times)
        return Lines(found, damaged[: frames + 1], refused, replies)

    def _times(self, stamps: NDArray[np.int64], t_host_ns: int) -> NDArray[np.int64]:
        """The adapter's milliseconds, modulo one minute or 16 bit, on the host's clock; or the host's own."""
        if len(stamps) == 0 or self._stamp_digits != 4:
            return np.full(len(stamps), t_host_ns, np.int64)
        if self._stamp_ms is None:
            self._stamp_ms, self._stamp_ns = int(stamps[0]), t_host_ns
        modulus = self._modulus_of(stamps, t_host_ns)
        steps = np.diff(stamps, prepend=self._stamp_ms) % modulus
        missed_ms = (t_host_ns - self._stamp_ns) / 1e6 - float(steps.sum())
        steps[0] += modulus * max(0, round(missed_ms / modulus))  # silent for minutes
        times = self._stamp_ns + np.cumsum(steps) * 1_000_000
        self._stamp_ms, self._stamp_ns = int(stamps[-1]), int(times[-1])
        return np.asarray(times)

    def _modulus_of(self, stamps: NDArray[np.int64], t_host_ns: int) -> int:
        """The modulus of the stamps: a minute (LAWICEL), or 16 bit, which a stamp beyond a minute shows.

        Until then the stamps may have wrapped in a pause: the modulus that fits the host's clock is used.
        """
        if self._wraps_at_ms is None and int(stamps.max()) >= MINUTE_MS:
            self._wraps_at_ms = WORD_MS
        if self._wraps_at_ms is not None or self._stamp_ms is None or int(stamps[0]) >= self._stamp_ms:
            return self._wraps_at_ms or MINUTE_MS
        step_ms, host_ms = int(stamps[0]) - self._stamp_ms, (t_host_ns - self._stamp_ns) / 1e6
        off_ms = {m: abs((host_ms - step_ms + m / 2) % m - m / 2) for m in (MINUTE_MS, WORD_MS)}
        if self._stamp_ms < MINUTE_MS - QUIET_MS and off_ms[WORD_MS] < off_ms[MINUTE_MS] - QUIET_MS:
            return WORD_MS
        return MINUTE_MS


def encode_line(identifier: int, data: bytes, fd: bool, brs: bool = True, stamp_ms: int | None = None) -> bytes:
    """One frame as a line; EXTENDED_FLAG and REMOTE_FLAG may be set in the identifier.

    >>> encode_line(0x300, bytes(8), fd=False)
    b't30080000000000000000\\r'
    """
    extended, remote = bool(identifier & EXTENDED_FLAG), bool(identifier & REMOTE_FLAG)
    kind = "r" if remote else "t" if not fd else "b" if brs else "d"
    code = FD_LENGTHS.index(len(data))
    number = f"{identifier & 0x1FFFFFFF:08X}" if extended else f"{identifier & 0x7FF:03X}"
    stamp = "" if stamp_ms is None else f"{stamp_ms % 60_000:04X}"
    return f"{kind.upper() if extended else kind}{number}{code:X}{data.hex().upper()}{stamp}\r".encode()
