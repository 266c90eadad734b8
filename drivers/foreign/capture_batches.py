"""Frames of a capture by the batch: on which bus, sent or received, and what could not be read."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, CanFrames

BATCH_FRAMES = 4096
LARGEST_ID = 0x1FFF_FFFF
LATEST_NS = 2**62  # the year 2116; later is damage, and would not fit
FrameTuple = tuple[int, bytes, int]  # identifier with flags, data, t_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """Some frames of a file.

    buses : (n,) which of `names` each frame was on. names : of the buses of the file so far, as its format counts them.
    sent : (n,) frames that the recorder itself sent. holes : (n + 1,) damaged lines or records before each frame, and
    behind the last. why : the first reason, "" if none. said : notices of the file, as code and text.
    """

    frames: CanFrames
    buses: NDArray[np.int16]
    names: tuple[str, ...]
    sent: NDArray[np.bool_]
    holes: NDArray[np.int64]
    why: str = ""
    said: tuple[tuple[str, str], ...] = ()

    @property
    def damaged(self) -> int:
        return int(self.holes.sum())

    def pick(self, which: NDArray[np.bool_]) -> Batch:
        """Some of the frames; damage before a frame that is left out counts before the next frame."""
        holes = np.zeros(int(which.sum()) + 1, np.int64)
        np.add.at(holes, np.concatenate([[0], np.cumsum(which)]), self.holes)
        return Batch(
            frames=self.frames.pick(which), buses=self.buses[which], names=self.names, sent=self.sent[which],
            holes=holes, why=self.why, said=self.said,
        )  # fmt: skip

    def cut(self, at: int) -> tuple[Batch, Batch]:
        """The first `at` frames, and the others."""
        parts = []
        for piece, holes in ((slice(at), np.append(self.holes[:at], 0)), (slice(at, None), self.holes[at:])):
            parts.append(
                Batch(
                    frames=self.frames.pick(piece),
                    buses=self.buses[piece],
                    names=self.names,
                    sent=self.sent[piece],
                    holes=holes,
                    why=self.why,
                    said=self.said,
                )  # fmt: skip
            )
        return parts[0], parts[1]


class Batches(Protocol):
    """An iterator that can be closed before its end."""

    def __iter__(self) -> Iterator[Batch]: ...
    def __next__(self) -> Batch: ...
    def close(self) -> None: ...


@dataclass(slots=True, kw_only=True)
class Collector:
    """Collects frames and damage, one after the other, into batches."""

    names: list[str] = field(default_factory=list)
    why: str = ""
    said: list[tuple[str, str]] = field(default_factory=list)
    _number: dict[str, int] = field(default_factory=dict)
    _frames: list[FrameTuple] = field(default_factory=list)
    _codes: list[int] = field(default_factory=list)  # twice the number of the bus, and one more if sent
    _holes: dict[int, int] = field(default_factory=dict)  # damaged lines before a frame
    _damaged: int = 0
    _since: int = 0

    def frame(self, frame: FrameTuple, bus: str, sent: bool) -> None:
        number = self._number.get(bus)
        if number is None:
            number = self._number[bus] = len(self.names)
            self.names.append(bus)
        self._frames.append(frame)
        self._codes.append(2 * number + sent)
        if self._since:
            self._holes[len(self._frames) - 1] = self._since
            self._since = 0

    def damage(self, why: str) -> None:
        self._since += 1
        self._damaged += 1
        self.why = self.why or why

    def warn(self, code: str, text: str) -> None:
        self.said.append((code, text))

    @property
    def full(self) -> bool:
        return len(self._frames) >= BATCH_FRAMES or self._damaged >= BATCH_FRAMES

    def take(self) -> Batch:
        """The batch of all that was added since the last call."""
        codes = np.array(self._codes, np.int64)
        holes = np.zeros(len(codes) + 1, np.int64)
        holes[[*self._holes, -1]] = [*self._holes.values(), self._since]
        batch = Batch(
            frames=CanFrames.build(self._frames), buses=(codes // 2).astype(np.int16), names=tuple(self.names),
            sent=codes % 2 == 1, holes=holes, why=self.why,
            said=tuple(self.said),
        )  # fmt: skip
        self._frames, self._codes, self._holes = [], [], {}
        self._damaged, self._since, self.why, self.said = 0, 0, "", []
        return batch


def batches_of(reader: Any, file: Path, first_bus: int = 0) -> Generator[Batch, None, None]:
    """Batches of one of python-can's readers. first_bus : number of its channel 0 as the file's format counts."""
    messages, out = iter(reader), Collector()
    ended = False
    try:
        while not ended:
            while not out.full and not ended:
                try:
                    message = next(messages, None)
                except Exception as error:  # noqa: BLE001 - a damaged file: python-can raises whatever it trips over
                    text = " ".join(str(error).split())
                    out.damage(text if text and isinstance(error, ValueError) else f"{type(error).__name__}: {text}")
                    ended = not getattr(reader, "goes_on", False)
                    messages = messages if ended else iter(reader)  # behind the damage
                    continue
                if message is None:
                    ended = True
                    continue
                frame = _frame(message)
                if isinstance(frame, str):
                    out.damage(frame)
                else:
                    out.frame(frame, _bus(message.channel, first_bus), not message.is_rx)
            if ended and not out.why and (why := _cut(reader, file)):
                out.damage(why)
            yield out.take()
    finally:
        reader.stop()


def _bus(channel: Any, first_bus: int) -> str:
    return str(channel + first_bus) if isinstance(channel, int) else str(channel or "")


def _frame(message: Any) -> FrameTuple | str:
    """Identifier, data and time; or the reason why the message is no frame."""
    flags = EXTENDED_FLAG if message.is_extended_id else 0
    flags |= (REMOTE_FLAG if message.is_remote_frame else 0) | (ERROR_FLAG if message.is_error_frame else 0)
    # seconds as a float carry microseconds for today's dates, no more
    t_ns = round(message.timestamp * 1e6) * 1000
    if abs(t_ns) > LATEST_NS:
        return f"a frame at {message.timestamp:g} s"
    if not 0 <= message.arbitration_id <= LARGEST_ID or len(message.data) > 64:
        return f"a frame of identifier {message.arbitration_id:X} with {len(message.data)} bytes"
    return message.arbitration_id | flags, bytes(message.data), t_ns


def _cut(reader: Any, file: Path) -> str:
    """Why a file that was read without an error is incomplete; "" if it is complete. (A cut MF4 file does not open.)"""
    size = file.stat().st_size
    end = getattr(reader, "file_size", 0) if file.suffix.lower() == ".blf" else 0
    return f"the file has {size} bytes, its header says {end}: it is cut" if end > size else ""
