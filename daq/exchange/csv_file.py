"""Tables as text: separators, decimal commas, unit rows and time stamps as recorders and spreadsheets write them."""

from __future__ import annotations

import contextlib
import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.errors import LogError
from daq.rig.units import canonical, is_unit

from .columns import SECONDS_OF_UNIT, Columns, date_ns, in_seconds, time_unit, titled
from .lvm_file import END_OF_HEAD, LVM_TITLE, read_lvm

CSV_ROWS = 200_000  # parsed at a time
LONGEST_LINE = 1 << 20  # bytes
HEAD_LINES = 200  # lines in which a header is looked for
MINUS_SIGN = "\u2212"  # of typesetting, for the hyphen
SAMPLE_ROWS = 2000  # rows by which the decimal sign is recognised
_DECIMAL_COMMA = re.compile(r"^[+-]?\d+,\d+(?:[eE][+-]?\d+)?$")
_IN_THOUSANDS = re.compile(r"^[+-]?[1-9]\d{0,2}(?:,\d{3})+$")
_WITH_BOTH_SIGNS = re.compile(r"^[+-]?\d{1,3}(?:[.,]\d{3})*[.,]\d+$")
_CALENDAR_DAY = re.compile(r"^(?:\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}\.\d{1,2}\.\d{4})$")
_OF_DAY = re.compile(r"^(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)$")
_RATE_LINE = re.compile(r"sampl\w*[\s_-]*(?:rate|freq\w*)\W+([\d.]+)\s*(k?)hz", re.IGNORECASE)
_DATE_LINE = re.compile(
    r"^\W*(?:started|start\s?time|start|date|datum|recorded|time|begin)\b[^0-9]*(\d.*)$", re.IGNORECASE
)


@dataclass(slots=True)
class _Table:
    """Format of a text. wanted : numbers of the columns that are read; line : that the next row stands in."""

    path: Path
    titles: list[str]
    units: list[str]
    delimiter: str
    _: KW_ONLY
    line: int
    wanted: list[int] = field(default_factory=list)
    time: int | None = None
    date: int | None = None
    decimal: str = "."
    thousands: str = ""
    quoted: bool = False
    rate_hz: float | None = None
    started_ns: int | None = None


def read_csv(path: Path, names: Sequence[str]) -> Columns:
    with path.open(encoding=_encoding(path), newline="") as file:
        first = list(islice(file, SAMPLE_ROWS))
        if first and first[0].startswith(LVM_TITLE) and sum(line.startswith(END_OF_HEAD) for line in first) > 1:
            return read_lvm(path, names)
        table = _header(path, first[:HEAD_LINES], names)
        first = _unit_row(table, first[table.line - 1 :])
        _columns(table, names)
        _signs(table, first)
        _stamped(table, first)
        parts: list[NDArray[np.float64]] = []
        stamps: list[NDArray[np.float64]] = []
        last, lines = "\n", first
        while lines:
            lines = _without_remarks(table, lines)
            numbers, times = _piece(table, lines)
            parts.append(numbers)
            stamps.append(times)
            table.line += len(lines)
            last = next((line for line in reversed(lines) if line.strip()), last)
            lines = list(islice(file, CSV_ROWS))
    return _found(table, names, parts, stamps, cut=not last.endswith(("\n", "\r")))


def _encoding(path: Path) -> str:
    """Encoding of the text, from its first megabyte. Raises LogError for one endless line."""
    with path.open("rb") as file:
        start = file.read(LONGEST_LINE)
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if len(start) == LONGEST_LINE and not {*b"\r\n"} & {*start}:
        raise LogError(f"{path}: its first line does not end within a megabyte; a table with a row a line is needed")
    if start[1:200:2].count(0) > 50:
        return "utf-16-le"
    if start[:200:2].count(0) > 50:
        return "utf-16-be"
    try:
        start[: start.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"  # a spreadsheet's, with its µ and ²
    return "utf-8-sig"


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    return [c.strip() for c in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter), [])]


def _header(path: Path, lines: list[str], names: Sequence[str]) -> _Table:
    """The last line before the numbers that has names of the rig's channels; else the first one, for messages."""
    found: _Table | None = None
    first: _Table | None = None
    head = _Head()
    for number, line in enumerate(lines, 1):
        if found is not None and _is_row(found, line, names):
            break
        if line.lower().startswith("sep="):
            head.delimiter = line[4:5]
            continue
        if not line.strip():
            continue
        head.take(line.lstrip("#").strip())
        marked = line.startswith("#")  # as numpy.savetxt writes a header
        table = _titles(path, line.lstrip("#"), number, head)
        if set(table.titles) & set(names):
            found = table
        first = first or (None if marked else table)
    if found is None and first is None:
        raise LogError(f"{path}: is empty; a header of channel names and rows of numbers are needed")
    if found is None and first is not None and all(_number(title) for title in first.titles if title):
        raise LogError(f"{path}: has no header: its first line is numbers; write the names of the channels above them")
    table = found or first or _titles(path, "", 0, head)
    table.rate_hz, table.started_ns = head.rate_hz, head.started_ns
    return table


@dataclass(slots=True)
class _Head:
    """Facts in the lines before the header."""

    delimiter: str = ""
    rate_hz: float | None = None
    started_ns: int | None = None
    day: str = ""

    def take(self, remark: str) -> None:
        if found := _RATE_LINE.search(remark):
            self.rate_hz = float(found[1]) * (1000.0 if found[2] else 1.0)
        if found := _DATE_LINE.match(remark):
            text = found[1].strip(' ";,\t')
            self.day = text if _CALENDAR_DAY.match(text) else self.day  # and in another line the time of day
            text = f"{self.day} {text}" if self.day and _OF_DAY.match(text) else text
            self.started_ns = date_ns(text) or self.started_ns


def _titles(path: Path, line: str, number: int, head: _Head) -> _Table:
    delimiter = head.delimiter or max(",;\t|", key=line.count)
    delimiter = delimiter if delimiter in line else " "
    cells = [titled(c) for c in _split(line, delimiter)]
    while len(cells) > 1 and not any(cells[-1]):
        cells.pop()
    return _Table(path, [c[0] for c in cells], [c[1] for c in cells], delimiter, line=number + 1)


def _is_row(table: _Table, line: str, names: Sequence[str]) -> bool:
    """Whether a line below a header is a row of numbers."""
    cells = _split(line, table.delimiter)
    there = [cells[k] for k, title in enumerate(table.titles) if title in names and k < len(cells)]
    return any(_number(c) for c in there)


def _unit_row(table: _Table, lines: list[str]) -> list[str]:
    """The lines without a row of units below the header, which sets the units of the table."""
    if not lines:
        return lines
    cells = [c.strip("[]() ") for c in _split(lines[0], table.delimiter)]
    given = [c for c in cells if c and c != "-"]
    known = any(_is_unit(c) for c in given) and len(cells) <= len(table.titles) + 1
    if not known or any(_number(c) for c in given):
        return lines
    table.units = [u or c for u, c in zip(table.units, cells, strict=False)] + table.units[len(cells) :]
    table.line += 1
    return lines[1:]


def _without_remarks(table: _Table, lines: list[str]) -> list[str]:
    """The lines with remarks made empty; a date in a remark (as Rotorscope exports have) is kept."""
    at = [k for k, line in enumerate(lines) if line.startswith("#")]
    if not at:
        return lines
    lines = list(lines)
    for k in at:
        if table.started_ns is None and (found := _DATE_LINE.match(lines[k])):
            table.started_ns = date_ns(found[1])
        lines[k] = "\n"
    return lines


def _is_unit(text: str) -> bool:
    return canonical(text).lower() in SECONDS_OF_UNIT or is_unit(text)


def _number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _columns(table: _Table, names: Sequence[str]) -> None:
    """Choose the columns to read. Raises LogError if a name is there twice, or the unit of time is not known."""
    titles = table.titles
    for k, title in enumerate(titles):
        if title in titles[:k] and title:
            raise LogError(f'{table.path}: the header names "{title}" twice; rename one column')
    table.wanted = [k for k, title in enumerate(titles) if title in names]
    for k, title in enumerate(titles):
        unit = time_unit(title, table.units[k]) if title not in names else None
        if unit is None or table.time is not None:
            continue
        if isinstance(unit, str):
            known = ", ".join(("s", "ms", "us", "ns", "min", "h"))
            raise LogError(f'{table.path}: the time is in "{unit}", which is no unit of time; write one of {known}')
        table.time = k
    table.date = next((k for k, title in enumerate(titles) if title.lower() in ("date", "datum")), None)


def _signs(table: _Table, lines: list[str]) -> None:
    """Find decimal sign and thousands separator from the first rows."""
    table.quoted = any('"' in line for line in lines)
    if table.delimiter == "," and not table.quoted:
        return
    cells = [c for row in _rows(table, lines) for k, c in enumerate(row) if k in table.wanted or k == table.time]
    commas, both = (
        [c for c in cells if _DECIMAL_COMMA.match(c)],
        [c for c in cells if "." in c and "," in c and _WITH_BOTH_SIGNS.match(c)],
    )
    dots = [c for c in cells if "." in c and "," not in c and _number(c)]
    if both:
        table.decimal, table.thousands = (",", ".") if both[0].rfind(",") > both[0].rfind(".") else (".", ",")
    elif commas and all(_IN_THOUSANDS.match(c) for c in commas):
        if not dots:
            text = f'"{commas[0]}" may be {commas[0].replace(",", ".")} or {commas[0].replace(",", "")}'
            raise LogError(f"{table.path}: {text}; write its numbers with a decimal point and no thousands separator")
        table.thousands = ","
    elif commas:
        table.decimal = ","


def _stamped(table: _Table, lines: list[str]) -> None:
    """Find the time column by its increasing time stamps, where no column has a name of time."""
    rows = [row for row in _rows(table, lines) if row and not row[0].startswith("#")][:2]
    if table.time is not None or len(rows) < 2:
        return
    for k in range(min(map(len, rows))):
        cells = [row[k] for row in rows]
        if k in table.wanted or any(":" not in cell for cell in cells):
            continue
        ns = [date_ns(f"1970-01-02 {cell}" if _OF_DAY.match(cell) else cell) for cell in cells]
        if ns[0] is not None and ns[1] is not None and ns[0] < ns[1]:
            table.time = k
            return


def _rows(table: _Table, lines: list[str]) -> list[list[str]]:
    """The cells of each line; none for an empty line or a remark."""
    if table.quoted:
        return [[c.strip() for c in row] for row in csv.reader(lines, delimiter=table.delimiter)]
    strip, delimiter = str.strip, table.delimiter
    if delimiter == " ":
        return [line.split() for line in lines]
    return [[] if not line.strip() else list(map(strip, line.rstrip("\r\n").split(delimiter))) for line in lines]


def _plain(table: _Table, cell: str) -> str:
    if table.thousands:
        cell = cell.replace(table.thousands, "")
    return cell.replace(",", ".") if table.decimal == "," else cell


def _piece(table: _Table, lines: list[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(rows, wanted) and (rows,) time of some lines."""
    columns = [*table.wanted, *([] if table.time is None else [table.time])]
    simple = not table.quoted and not table.thousands and table.delimiter != " "
    if table.wanted and simple and any(line.strip() for line in lines):
        commas = len(table.titles) - 1
        plain = [line.replace(",", ".") for line in lines] if table.decimal == "," else lines
        with contextlib.suppress(ValueError):  # said below, or written so that the library does not read it
            if all(line.count(table.delimiter) == commas for line in lines if line.strip()):
                read = np.loadtxt(plain, delimiter=table.delimiter, usecols=columns, ndmin=2, comments=None)
                return read[:, : len(table.wanted)], read[:, -1] if table.time is not None else np.empty(0)
    rows = _rows(table, [line.replace(MINUS_SIGN, "-") for line in lines])
    if table.time is not None:  # else an empty row may be a sample that is missing
        rows = [row if any(row) else [] for row in rows]
    numbers = _numbers(table, rows)
    return numbers, np.empty(0) if table.time is None or not table.wanted else _times(table, rows)


def _numbers(table: _Table, rows: list[list[str]]) -> NDArray[np.float64]:
    """(rows, wanted) of one piece of the text."""
    wanted, width = table.wanted, len(table.titles)
    good = [row for row in rows if row]
    if not wanted or not good:
        return np.empty((len(good) if not wanted else 0, len(wanted)))
    odd = bool(table.thousands) or table.decimal == ","
    try:
        if any(len(row) != width and not (len(row) == width + 1 and not row[-1]) for row in good):
            raise ValueError("a line has more or fewer cells than the header")
        good = [row if any(row[k] for k in wanted) else ["nan"] * len(row) for row in good]  # rows without a value
        columns = [[_plain(table, row[k]) for row in good] if odd else [row[k] for row in good] for k in wanted]
        return np.array([np.array(column).astype(np.float64) for column in columns]).T
    except ValueError as error:
        raise _mistake(table, rows) or error from error


def _mistake(table: _Table, rows: list[list[str]]) -> LogError | None:
    """Error about the first line that is no row of numbers, with a remedy."""
    width = len(table.titles)
    for k, row in enumerate(rows):
        if not row:
            continue
        if len(row) != width and not (len(row) == width + 1 and not row[-1]):
            text = f"{len(row)} cells where the header has {width}"
            if table.delimiter == "," and len(row) == 2 * width:
                text += ": these may be decimal commas; export it with semicolons between the columns"
                return LogError(f"{table.path}:{table.line + k}: {text}")
            return LogError(f"{table.path}:{table.line + k}: {text}; repair or cut that line")
        for column in table.wanted:
            try:
                float(_plain(table, row[column]))
            except ValueError:
                what = f'"{row[column]}" is not a number' if row[column] else "the cell is empty"
                where = f"{table.path}:{table.line + k}: {table.titles[column]}"
                return LogError(f"{where}: {what}; repair or cut that line")
    return None


def _times(table: _Table, rows: list[list[str]]) -> NDArray[np.float64]:
    """The time column: s from the first row on if it has stamps, else in its own unit."""
    at = table.time or 0
    cells = [row[at] for row in rows if row]
    try:
        return np.array([_plain(table, c) for c in cells]).astype(np.float64) if cells else np.empty(0)
    except ValueError:
        if _number(_plain(table, cells[0])):
            row, cell = next((k, r[at]) for k, r in enumerate(rows) if r and not _number(_plain(table, r[at])))
            what = f'"{cell}" is not a number' if cell else "the cell is empty"
            text = f"{table.titles[at]}: {what}; repair or cut that line"
            raise LogError(f"{table.path}:{table.line + row}: {text}") from None
        first = next(row for row in rows if row)
        if table.date is not None and table.started_ns is None and _OF_DAY.match(first[at]):
            table.started_ns = date_ns(f"{first[table.date]} {first[at]}")
        return np.fromiter(_stamps(table, [(k, row[at]) for k, row in enumerate(rows) if row]), np.float64, len(cells))


def _stamps(table: _Table, cells: list[tuple[int, str]]) -> Iterator[float]:
    """Dates and times of day, in s: from the first one on, or from midnight before the first."""
    days, before = 0.0, -math.inf
    for row, cell in cells:
        if found := _OF_DAY.match(cell):
            second = 3600.0 * int(found[1]) + 60.0 * int(found[2]) + float(found[3].replace(",", "."))
            days += 86400.0 if second < before - 43200.0 else 0.0  # past midnight
            before = second
            yield second + days
            continue
        ns = date_ns(cell)
        if ns is None:
            text = f'"{cell}" is neither a number nor a time stamp' if cell else "the cell is empty"
            example = "write seconds, or stamps such as 2024-05-31T13:05:00.250"
            raise LogError(f"{table.path}:{table.line + row}: {table.titles[table.time or 0]}: {text}; {example}")
        if table.started_ns is None or table.units[table.time or 0] != "stamps":
            table.started_ns = ns
            table.units[table.time or 0] = "stamps"
        yield (ns - table.started_ns) * 1e-9


def _found(
    table: _Table, names: Sequence[str], parts: list[NDArray[np.float64]], stamps: list[NDArray[np.float64]], cut: bool
) -> Columns:
    numbers = np.concatenate(parts) if parts else np.empty((0, len(table.wanted)))
    columns = {table.titles[i]: numbers[:, k] for k, i in enumerate(table.wanted)}
    others = {t: np.empty(0) for t in table.titles if t and t not in names}  # for messages only
    units = {t: u for t, u in zip(table.titles, table.units, strict=True) if u}
    odd = "the last line has no end; if the file was cut, its last number is wrong" if cut else ""
    out = Columns(columns | others, table.rate_hz, None, units, odd=odd, started_ns=table.started_ns)
    if table.time is None or not stamps:
        return out
    others.pop(table.titles[table.time], None)
    said = units.pop(table.titles[table.time], "")
    time = np.concatenate(stamps)
    if said == "stamps":
        return replace(out, values=columns | others, time=time)
    unit = time_unit(table.titles[table.time], said)
    seconds, started_ns = in_seconds(time, unit if isinstance(unit, float) else 1.0)
    known = started_ns is not None or not math.isnan(unit if isinstance(unit, float) else 1.0)
    return replace(
        out, values=columns | others, time=seconds, started_ns=started_ns or table.started_ns, time_unit_said=known
    )
