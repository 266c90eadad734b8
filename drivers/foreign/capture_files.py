"""Recorded CAN traffic as batches of frames: candump .log by a tolerant reader, .blf, .asc and .mf4 by python-can."""

from __future__ import annotations

import logging
import re
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

from drivers.can.can_frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, CanFrames
from drivers.contract.errors import LinkOpenError, LinkUnavailable

from .capture_batches import BATCH_FRAMES, LATEST_NS, Batch, Batches, batches_of

CAPTURE_SUFFIXES = (".log", ".blf", ".asc", ".mf4")  # of recorded CAN traffic
_CANDUMP_LINE = re.compile(
    r"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})(?:#R(\d?)|##([0-9A-Fa-f])|#)([0-9A-Fa-f.]*)(?:\s+[RT])?"
)


def open_capture(path: str, bus: str | None) -> Batches:
    """Batches of a file, in the order of time. Raises LinkOpenError | LinkUnavailable before the first batch only."""
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in CAPTURE_SUFFIXES:
        what = suffix or "a file without ending"
        raise LinkOpenError(f"capture:{path}: cannot read {what}: use {', '.join(CAPTURE_SUFFIXES)}")
    try:
        if file.exists() and not file.is_file():  # a pipe would hold us until somebody writes
            raise LinkOpenError(f"capture:{path}: is not a file that can be read to its end: save the traffic first")
        with file.open("rb") as handle:
            handle.read(1)
    except OSError as error:
        raise LinkOpenError(f"capture:{path}: {error.strerror}: check the path") from error
    if suffix == ".log":
        return _candump(file, bus)
    if suffix == ".mf4":
        from .mf4_capture import Mf4Batches

        return Mf4Batches(file, bus)
    try:
        reader = _open_reader(file, suffix)
    except ImportError as error:
        raise LinkUnavailable(f"capture:{path}: {error}: install the missing library") from error
    except Exception as error:
        text = " ".join(str(error).split())
        raise LinkOpenError(f"capture:{path}: not a {suffix} file ({text}): check the file") from error
    return batches_of(reader, bus, file)


def _open_reader(file: Path, suffix: str) -> Any:
    """python-can's reader, on a handle of ours: its own stays open when a file is not what it seems."""
    log = logging.getLogger("can")  # what it says about each frame would fill the terminal: damage is counted
    if not log.handlers:
        log.addHandler(logging.NullHandler())
    handle = file.open("rb") if suffix == ".blf" else file.open("r", encoding="utf-8", errors="replace")
    try:
        return _open_blf(handle) if suffix == ".blf" else _open_asc(handle)
    except Exception:
        handle.close()
        raise


def _open_blf(handle: Any) -> Any:
    from .blf import BlfReader

    return BlfReader(handle)


def _open_asc(handle: Any) -> Any:
    from .asc import AscReader

    return AscReader(handle, _bounded(handle))


def _candump(file: Path, bus: str | None) -> Generator[Batch, None, None]:
    frames: list[tuple[int, bytes, int]] = []
    damaged, why = 0, ""
    with file.open("r", encoding="ascii", errors="replace") as lines:
        for number, line in enumerate(_bounded(lines), 1):
            match = _CANDUMP_LINE.fullmatch(line.strip())
            if match is None:
                if line.strip():
                    damaged += 1
                    why = why or f"line {number} is no candump line"
            elif bus is None or match[3] == bus:
                frame = _parse(match)
                if frame is None:
                    damaged += 1
                    why = why or f"line {number} has a wrong length or time"
                else:
                    frames.append(frame)
            if len(frames) >= BATCH_FRAMES or damaged >= BATCH_FRAMES:
                yield Batch(CanFrames.build(frames), damaged, why)
                frames, damaged, why = [], 0, ""
    yield Batch(CanFrames.build(frames), damaged, why)


def _bounded(lines: Any) -> Iterator[str]:
    """Lines of at most 1000 characters: a file without line ends must not fill the memory."""
    while line := lines.readline(1000):
        yield line


def _parse(match: re.Match[str]) -> tuple[int, bytes, int] | None:
    number, digits = int(match[4], 16), match[7].replace(".", "")
    if len(digits) % 2 or len(digits) > 128:
        return None
    identifier = number
    if len(match[4]) == 8:
        identifier = number & 0x1FFF_FFFF | (ERROR_FLAG if number & ERROR_FLAG else EXTENDED_FLAG)
    if match[5] is not None:
        identifier |= REMOTE_FLAG
        digits = ""
    t_ns = int(match[1]) * 1_000_000_000 + int(match[2].ljust(9, "0"))
    if t_ns > LATEST_NS:
        return None
    return identifier, bytes.fromhex(digits), t_ns
