"""Frames of a capture by the batch, as python-can's readers give them one by one."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from drivers.can.can_frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, CanFrames

BATCH_FRAMES = 4096
LARGEST_ID = 0x1FFF_FFFF
LATEST_NS = 2**62  # the year 2116; later is damage, and would not fit


@dataclass(frozen=True, slots=True)
class Batch:
    """damaged : lines or records that could not be read; why: the first reason, "" if none."""

    frames: CanFrames
    damaged: int = 0
    why: str = ""


class Batches(Protocol):
    """An iterator that can be closed before its end."""

    def __iter__(self) -> Iterator[Batch]: ...
    def __next__(self) -> Batch: ...
    def close(self) -> None: ...


def batches_of(reader: Any, bus: str | None, file: Path) -> Generator[Batch, None, None]:
    messages = iter(reader)
    ended = False
    try:
        while not ended:
            frames: list[tuple[int, bytes, int]] = []
            damaged, why = 0, ""
            while len(frames) < BATCH_FRAMES and damaged < BATCH_FRAMES and not ended:
                try:
                    message = next(messages, None)
                except Exception as error:  # noqa: BLE001 - a damaged file: python-can raises whatever it trips over
                    text = " ".join(str(error).split())
                    text = text if text and isinstance(error, ValueError) else f"{type(error).__name__}: {text}"
                    damaged, why = damaged + 1, why or text
                    ended = not getattr(reader, "goes_on", False)
                    messages = messages if ended else iter(reader)  # behind the damage
                    continue
                if message is None:
                    ended = True
                elif bus is None or str(message.channel) == bus:
                    frame = _frame(message)
                    if isinstance(frame, str):
                        damaged, why = damaged + 1, why or frame
                    else:
                        frames.append(frame)
            if ended and not damaged:
                why = _cut(reader, file)
                damaged = 1 if why else 0
            yield Batch(CanFrames.build(frames), damaged, why)
    finally:
        reader.stop()


def _frame(message: Any) -> tuple[int, bytes, int] | str:
    """Identifier, data and time; or why it is none."""
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
    """Why a file that was read without an error is not whole; "" if it is. (A cut MF4 file does not even open.)"""
    size = file.stat().st_size
    end = getattr(reader, "file_size", 0) if file.suffix.lower() == ".blf" else 0
    return f"the file has {size} bytes, its header says {end}: it is cut" if end > size else ""
