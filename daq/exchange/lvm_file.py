"""LabVIEW measurement files (.lvm): text with a head for the file, and one for each segment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.errors import LogError

from .columns import Column, Columns, date_ns

LVM_TITLE = "LabVIEW Measurement"
END_OF_HEAD = "***End_of_Header***"
HEAD_LINES = 200  # at most
SAME_STEP_REL = 1e-9  # between the channels of a segment


@dataclass(slots=True)
class _Segment:
    """head : key -> a cell for each channel. titles : of the columns. first : number of the first row's line."""

    head: dict[str, list[str]] = field(default_factory=dict)
    titles: list[str] = field(default_factory=list)
    rows: list[str] = field(default_factory=list)
    first: int = 0


def read_lvm(path: Path, names: Sequence[str]) -> Columns:
    """The one segment of a file. Raises LogError for several, and for what is none."""
    with path.open("rb") as stream:
        lines = stream.read().decode("utf-8-sig", "replace").splitlines()
    if not lines or not lines[0].startswith(LVM_TITLE):
        raise LogError(f'{path}: no LabVIEW measurement file: its first line is not "{LVM_TITLE}"')
    sign = "," if "Separator,Comma" in "\n".join(lines[:HEAD_LINES]).replace("\t", ",") else "\t"
    about, at = _head(lines, 0, sign)
    segments = []
    while at < len(lines):
        head, start = _head(lines, at, sign)
        if start >= len(lines):
            break
        stop = next((k for k in range(start + 1, len(lines)) if not lines[k].strip(sign + " ")), len(lines))
        segments.append(
            _Segment(head, [c.strip() for c in lines[start].split(sign)], lines[start + 1 : stop], start + 2)
        )
        at = stop
        while at < len(lines) and not lines[at].strip(sign + " "):
            at += 1
    if len(segments) != 1:
        text = f"{len(segments)} segments" if segments else "no segment of samples"
        raise LogError(f"{path}: holds {text}; write it with one header only, or export each segment to .csv")
    return _columns(path, segments[0], about, names, sign)


def _head(lines: Sequence[str], at: int, sign: str) -> tuple[dict[str, list[str]], int]:
    """The keys up to the end of a head, and the number of the line behind it."""
    head: dict[str, list[str]] = {}
    for k in range(at, min(len(lines), at + HEAD_LINES)):
        key, *cells = (c.strip() for c in lines[k].split(sign))
        if key == END_OF_HEAD:
            k += 1
            while k < len(lines) and not lines[k].strip(sign + " "):
                k += 1
            return head, k
        head.setdefault(key, cells)
    return head, len(lines)


def _columns(
    path: Path, segment: _Segment, about: Mapping[str, list[str]], names: Sequence[str], sign: str
) -> Columns:  # fmt: skip
    kind = (about.get("X_Columns") or ["One"])[0].lower()
    titles = segment.titles[:-1] if segment.titles[-1] == "Comment" else segment.titles
    at = {t: k for k, t in enumerate(titles) if t and t != "X_Value"}
    number = {t: k for k, t in enumerate(at)}  # of the channel, as in the head
    wanted = [name for name in names if name in at]
    others: dict[str, Column] = dict.fromkeys((t for t in at if t not in wanted), np.empty(0))
    comma = (about.get("Decimal_Separator") or ["."])[0] == "," and sign != ","
    values = {name: _numbers(path, segment, at[name], sign, comma) for name in wanted}
    head, units = segment.head, {}
    for name in wanted:
        label = _cell(head, "Y_Unit_Label", number[name])
        if label:
            units[name] = label
    steps = [float(s.replace(",", ".")) for name in wanted if (s := _cell(head, "Delta_X", number[name]))]
    if steps and not all(math.isclose(s, steps[0], rel_tol=SAME_STEP_REL) for s in steps):
        raise LogError(f"{path}: channels of different Delta_X ({min(steps):g} to {max(steps):g}); export one rate")
    time = None
    if kind in ("one", "multi") and wanted:
        times = [_numbers(path, segment, 0 if kind == "one" else at[name] - 1, sign, comma) for name in wanted]
        time = times[0]
        if any(not np.array_equal(t, time) for t in times):
            raise LogError(f"{path}: its channels were not sampled at the same times; resample them to one time first")
    of = number[wanted[0]] if wanted else 0
    for key in ("Date", "Time", "X0"):
        said = {_cell(head, key, number[name]) for name in wanted}
        if len(said) > 1:
            raise LogError(f"{path}: its channels begin at different times ({key} {', '.join(sorted(said))}); cut them")
    started_ns = date_ns(f"{_cell(head, 'Date', of).replace('/', '-')} {_cell(head, 'Time', of)}")
    if started_ns is not None:
        started_ns += round(1e9 * (time[0] if time is not None and len(time) else _first(head, of)))
    rate_hz = 1.0 / steps[0] if steps and steps[0] > 0 else None
    return Columns(values | others, rate_hz, time, units, started_ns=started_ns)


def _cell(head: Mapping[str, list[str]], key: str, channel: int) -> str:
    cells = head.get(key, [])
    return cells[channel] if channel < len(cells) else ""


def _first(head: Mapping[str, list[str]], channel: int) -> float:
    try:
        return float(_cell(head, "X0", channel).replace(",", "."))
    except ValueError:
        return 0.0


def _numbers(path: Path, segment: _Segment, column: int, sign: str, comma: bool) -> NDArray[np.float64]:
    out = np.empty(len(segment.rows))
    for k, row in enumerate(segment.rows):
        cells = row.split(sign)
        cell = cells[column].strip() if column < len(cells) else ""
        try:
            out[k] = float(cell.replace(",", ".") if comma else cell)
        except ValueError as error:
            what = f'"{cell}" is not a number' if cell else "the cell is empty"
            where = f"{path}:{segment.first + k}: {segment.titles[column]}"
            raise LogError(f"{where}: {what}; repair or cut that line") from error
    return out
