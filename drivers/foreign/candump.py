"""candump's logs: as `candump -L` and `-l` write them, or as on the screen; with times, dates, or differences."""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from datetime import datetime
from itertools import chain, islice
from pathlib import Path

from drivers.can.can_frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from drivers.contract.errors import LinkOpenError

from .capture_batches import BATCH_FRAMES, LATEST_NS, Batch, Collector, FrameTuple
from .text_lines import bounded, open_text

_LOG_LINE = re.compile(
    r"\s*+\((\d++)\.(\d{1,9}+)\)\s++(\S++)\s++([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})(?:#R(\d?)|##[0-9A-Fa-f]|#)"
    r"([0-9A-Fa-f.]*+)(?:_[0-9A-Fa-f])?(?:\s+([RT]))?\s*+"
)
_SCREEN_LINE = re.compile(
    r"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+(?:(RX|TX)\s+\S+\s+\S+\s+)?([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+\[\d+\]\s*"
    r"((?:remote request|ERRORFRAME|[0-9A-Fa-f]{2}(?:\s+[0-9A-Fa-f]{2})*)?)(?:\s+'.*')?(?:\s+ERRORFRAME.*)?"
)
_SCREEN_LOOK = re.compile(r"(?:\([^)]*\)\s+)?\S+\s+(?:(?:RX|TX)\s+\S+\s+\S+\s+)?[0-9A-Fa-f]{3,8}\s+\[\d+\]")
_DATE_STAMP = re.compile(r"\((\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d{1,9}\))")  # of candump -tA, local time
_XL_LINE = re.compile(r"\s*\(\d+\.\d+\)\s+\S+\s+[0-9A-Fa-f]{5}#[0-9A-Fa-f]{2}:[0-9A-Fa-f]{2}:[0-9A-Fa-f]{8}#")
_REMARK_SIGNS = ("#", "//", ";")  # beginnings of lines that are no frames; canplayer passes over them, too
_COLOUR_CODE = re.compile("\x1b\\[[0-9;]*m")  # of candump -c
_LOOK_LINES = 200  # lines by which the kind of file is recognised
_SHORTEST_FRAME_NS = 15_000  # on a bus: 47 bits at 5 Mbit/s, and the rest of a frame at 1 Mbit/s
_LARGEST_STEP_NS = 3_600_000_000_000
_BACK_SHARE = 0.15  # of the stamps that are smaller than the one before: times never go back so often


def candump_batches(file: Path) -> Generator[Batch, None, None]:
    """Batches of frames of a candump log. Raises LinkOpenError with the first batch for a file of another kind."""
    with open_text(file) as handle:
        lines = map(_in_seconds, bounded(handle))
        first = list(islice(lines, _LOOK_LINES))
        _refuse_other_kinds(file, first)
        stamps = [t for line in first if (t := _stamp(line)) is not None]
        differences = are_differences(stamps)
        out = Collector()
        if differences:
            out.warn("delta_times", "its time stamps are differences (candump -td): added up")
        yield from _read(_frame_lines(chain(first, lines), out), out, differences)


def _frame_lines(lines: Iterator[str], out: Collector) -> Iterator[str]:
    """The lines, those of remarks and of CAN XL frames made empty."""
    inside = xl = False  # of a line that is longer than a piece; of any frame
    for number, line in enumerate(lines, 1):
        if inside or line.startswith(_REMARK_SIGNS):
            inside = not line.endswith("\n")
            yield "\n"
        elif ":" in line and _XL_LINE.match(line):
            if not xl:
                out.warn("can_xl", f"CAN XL frames, the first in line {number}: left out")
            inside, xl = not line.endswith("\n"), True
            yield "\n"
        else:
            yield line


def _read(lines: Iterator[str], out: Collector, differences: bool) -> Generator[Batch, None, None]:
    now_ns, left, match_of, add = 0, BATCH_FRAMES, _LOG_LINE.fullmatch, out.frame
    for number, line in enumerate(lines, 1):
        match, found = match_of(line), None
        if match is not None:
            seconds, part, bus, name, remote, digits, way = match.groups()
            identifier = int(name, 16) if len(name) == 3 else _identifier(name)
            digits = digits.replace(".", "") if remote is None else ""
            identifier |= 0 if remote is None else REMOTE_FLAG
            t_ns = int(seconds + part.ljust(9, "0"))
            if len(digits) % 2 == 0 and len(digits) <= 128 and t_ns <= LATEST_NS:
                found = (identifier, bytes.fromhex(digits), t_ns), bus, way == "T"
        else:
            found = _screen_frame(line.strip())
        if found is not None:
            if differences:
                (identifier, data, t_ns), bus, sent = found
                now_ns += t_ns
                found = (identifier, data, now_ns), bus, sent
            add(*found)
        elif match is not None or not line.isspace():
            out.damage(f"line {number} has a wrong length or time" if match else f"line {number} is no candump line")
        else:
            continue
        left -= 1
        if not left:
            left = BATCH_FRAMES
            yield out.take()
    yield out.take()


def _in_seconds(line: str) -> str:
    """The line with Unix time in place of a date, and without colours."""
    line = _COLOUR_CODE.sub("", line) if "\x1b" in line else line
    if "-" not in line[:8] or (match := _DATE_STAMP.match(line.lstrip())) is None:
        return line
    try:
        return f"({int(datetime.fromisoformat(match[1]).timestamp())}{match[2]}{line.lstrip()[match.end() :]}"
    except (ValueError, OverflowError, OSError):  # no date, or one outside the range of this system
        return line


def _screen_frame(text: str) -> tuple[FrameTuple, str, bool] | None:
    match = _SCREEN_LINE.fullmatch(text)
    if match is None:
        return None
    identifier, data = _identifier(match[5]), b""
    if match[6].startswith("remote"):
        identifier |= REMOTE_FLAG
    elif match[6] != "ERRORFRAME":
        data = bytes.fromhex("".join(match[6].split()))
    t_ns = int(match[1]) * 1_000_000_000 + int(match[2].ljust(9, "0"))
    return None if t_ns > LATEST_NS or len(data) > 64 else ((identifier, data, t_ns), match[3], match[4] == "TX")


def _identifier(text: str) -> int:
    number = int(text, 16)
    if len(text) == 8:
        return number & 0x1FFF_FFFF | (ERROR_FLAG if number & ERROR_FLAG else EXTENDED_FLAG)
    return number


def _stamp(line: str) -> int | None:
    match = re.match(r"\s*\((\d+)\.(\d{1,9})\)", line)
    return None if match is None else int(match[1]) * 1_000_000_000 + int(match[2].ljust(9, "0"))


def are_differences(stamps: list[int]) -> bool:
    """Whether stamps are differences: they go up and down, or are shorter than the shortest frame."""
    if len(stamps) < 4 or max(stamps) > _LARGEST_STEP_NS or stamps[0] > stamps[1]:
        return False
    back = sum(b < a for a, b in zip(stamps[1:-1], stamps[2:], strict=True))
    return back > _BACK_SHARE * len(stamps) or stamps[-1] - stamps[1] < _SHORTEST_FRAME_NS * (len(stamps) - 2)


def _refuse_other_kinds(file: Path, first: list[str]) -> None:
    """Raise LinkOpenError, with a remedy, for a file that is known to be no candump log."""
    text = [line.strip() for line in first if line.strip()]
    if any(_LOG_LINE.fullmatch(line) or _SCREEN_LINE.fullmatch(line) for line in text):
        return
    where = f"capture:{file}"
    if any("BUSMASTER" in line.upper() for line in text[:5]):
        raise LinkOpenError(f"{where}: a BusMaster log, which cannot be read: convert it to .asc in BusMaster")
    if any(_SCREEN_LOOK.match(line) for line in text):
        raise LinkOpenError(f"{where}: candump as on the screen, without times in seconds: record with candump -L")
    if any(line.startswith(";$FILEVERSION") for line in text):
        raise LinkOpenError(f"{where}: a PCAN trace (.trc), which cannot be read: convert it to .asc or .blf")
    if any(re.match(r"(date|base)\s", line) for line in text[:3]):
        raise LinkOpenError(f"{where}: a Vector ASC file by its first lines: name it .asc")
