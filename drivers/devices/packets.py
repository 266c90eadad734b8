"""Packets that begin with fixed bytes and end with a check sum, in a stream of bytes that may be damaged anywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import CanFrames

U8Array = NDArray[np.uint8]
I64Array = NDArray[np.int64]
MAX_PAYLOAD = 64  # bytes of a frame that are kept, as of CAN FD


@dataclass(frozen=True, slots=True, kw_only=True)
class Packets:
    """The sound packets of a piece of the stream.

    frames : a packet each, or a field of one; their times are not set. holes : (n + 1,) damaged packets before each,
    and behind the last.
    """

    frames: CanFrames
    holes: I64Array


class Framer(Protocol):
    """Bytes in, packets out. Never raises on wire data; what it keeps is bounded."""

    def feed(self, chunk: bytes) -> Packets: ...

    def reset(self) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """How packets of a device are recognised.

    sync : the bytes that each begins with. head : bytes after which its length is known.
    lengths : data and starts (n,) -> length of the packet that may begin there. sound : data, starts and ends (n,) ->
    whether the check sum is right. split : data, starts and ends (n,) of sound packets -> frames, and the packet (m,)
    that each is of.
    """

    sync: bytes
    head: int
    lengths: Callable[[U8Array, I64Array], I64Array]
    sound: Callable[[U8Array, I64Array, I64Array], NDArray[np.bool_]]
    split: Callable[[U8Array, I64Array, I64Array], tuple[CanFrames, I64Array]]


class PacketFramer:
    """Finds sound packets at every place of the stream, so that it recovers after damage."""

    def __init__(self, form: Format) -> None:
        self._form = form
        self._tail = b""
        self._junk = 0  # bytes since the last sound packet that belong to none
        self._typical = 0  # length of a sound packet; 0 before the first
        self._synchronised = False

    def reset(self) -> None:
        """Forget a packet that is half read, because the line was closed."""
        self._tail, self._junk = b"", 0

    def feed(self, chunk: bytes) -> Packets:
        """The sound packets of the stream up to here."""
        form = self._form
        data = np.frombuffer(self._tail + chunk, np.uint8)
        size = len(data)
        starts = _found(data, form.sync)
        starts = starts[starts + form.head <= size]
        ends = starts + form.lengths(data, starts)
        whole = ends <= size
        good = np.zeros(len(starts), np.bool_)
        good[whole] = form.sound(data, starts[whole], ends[whole])
        first, last = _apart(starts[good], ends[good])
        stop = int(last[-1]) if len(last) else 0
        open_ = starts[~whole & (starts >= stop)]
        rest = int(open_[0]) if len(open_) else max(stop, size - form.head + 1)
        self._tail = data[rest:].tobytes()
        before = np.diff(np.concatenate([[0], last]))[: len(first)] - (last - first)
        if len(first):
            before[0] += self._junk
            self._typical = self._typical or int(last[0] - first[0])
        self._junk = rest - stop + (0 if len(first) else self._junk)
        damaged = self._damaged(before)
        frames, of = form.split(data, first, last)
        holes = np.zeros(len(frames) + 1, np.int64)
        if len(of):
            new = np.flatnonzero(np.diff(of, prepend=-1))
            np.add.at(holes, new, damaged[of[new]])
        return Packets(frames=frames, holes=holes)

    def _damaged(self, junk: I64Array) -> I64Array:
        """Estimated number of packets in damaged bytes. Bytes before the first sound packet count as none."""
        if not len(junk):
            return junk
        out = np.where(junk > 0, np.maximum(1, np.rint(junk / max(self._typical, 1))), 0).astype(np.int64)
        if not self._synchronised:
            out[0], self._synchronised = 0, True
        return out


def _found(data: U8Array, sync: bytes) -> I64Array:
    """Where the bytes of `sync` stand."""
    n = len(data) - len(sync) + 1
    if n <= 0:
        return np.zeros(0, np.int64)
    hit = data[:n] == sync[0]
    for k, byte in enumerate(sync[1:], 1):
        hit &= data[k : k + n] == byte
    return np.flatnonzero(hit).astype(np.int64)


def _apart(starts: I64Array, ends: I64Array) -> tuple[I64Array, I64Array]:
    """Packets that do not overlap, the earlier one of two that do."""
    if len(starts) > 1 and (starts[1:] < ends[:-1]).any():
        kept, stop = [], 0
        for k, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            if start >= stop:
                kept.append(k)
                stop = end
        return starts[kept], ends[kept]
    return starts, ends


def sums(data: U8Array) -> I64Array:
    """(n + 1,) sum of the bytes before each place."""
    return np.concatenate([[0], np.cumsum(data, dtype=np.int64)])


def frames_of(ids: NDArray[np.uint32], data: U8Array, starts: I64Array, length: int) -> CanFrames:
    """Frames of one length whose payloads begin at `starts`."""
    kept = min(length, MAX_PAYLOAD)
    payload = np.zeros((len(starts), MAX_PAYLOAD), np.uint8)
    if len(starts):
        payload[:, :kept] = data[starts[:, None] + np.arange(kept)]
    return CanFrames(ids, np.full(len(starts), kept, np.uint8), payload, np.zeros(len(starts), np.int64))
