"""Columns of a file of others, and the words by which files name time, rate and date."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.errors import ConfigError
from daq.base.contract.part import ROW_ROUNDING, Part, beyond

Column = NDArray[Any]
TITLE_WITH_UNIT = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*(?:\([^)]*\))?[^\])]*)\s*[\])]\s*$")  # "b1x [g]", "b1x (m/s^2)"
DAY_S = 86400.0
SECONDS_OF_UNIT = MappingProxyType(
    {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "sekunden": 1.0, "ms": 1e-3, "msec": 1e-3,
     "milliseconds": 1e-3, "us": 1e-6, "usec": 1e-6, "microseconds": 1e-6, "ns": 1e-9, "nsec": 1e-9,
     "nanoseconds": 1e-9, "min": 60.0, "minutes": 60.0, "h": 3600.0, "hours": 3600.0, "d": DAY_S, "days": DAY_S}
)  # fmt: skip
TIME_NAMES = frozenset(
    ("time", "t", "timestamp", "timestamps", "zeit", "zeitstempel", "uhrzeit", "datetime", "date/time", "xvalue")
    + ("elapsed", "elapsedtime", "relativetime", "reltime")
)
RATE_NAMES = frozenset(
    ("rate_hz", "fs", "fs_hz", "rate", "samplerate", "samplingrate", "samplefrequency", "samplingfrequency", "fsamp")
)
STEP_NAMES = frozenset(("dt", "ts", "timestep", "sampleinterval", "samplinginterval", "sampletime", "sampleperiod"))
START_NAMES = frozenset(
    ("started", "start", "starttime", "startdate", "wfstarttime", "recordingstart", "measurementstart")
)
# Unix times: a record of 30 years is none. Largest value of a time column, and seconds of its unit
EPOCH_RANGES = ((1e9, 4e9, 1.0), (1e12, 4e12, 1e-3), (1e15, 4e15, 1e-6), (1e18, 4e18, 1e-9))
# Days of a calendar, from 1954 on: smallest, largest, and 1970-01-01 in it. Spreadsheets; datenum of MATLAB
DAY_CALENDARS = ((20_000.0, 80_000.0, 25_569.0), (713_000.0, 760_000.0, 719_529.0))
MOST_DAY_STEP = 4e-6  # days of a sample at 3 Hz; as seconds it would be 250 kHz


@dataclass(frozen=True, slots=True)
class Columns:
    """Contents of a file.

    time : s, if the file has one. units : of those columns whose unit the file says. units_of_kind : of the others, by
    kind of channel. full_scale_counts : the value at full scale if the columns are bare counts (PCM audio, 1 for floats
    within +-1), else None. odd : what the user should know of a file that was read all the same. started_ns : Unix time
    of the first row, ns. time_unit_said : the file says the unit of its time. twice : of names that are there several
    times, the remark for the user.
    """

    values: Mapping[str, Column]
    rate_hz: float | None = None
    time: Column | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    _: KW_ONLY
    full_scale_counts: int | None = None
    odd: str = ""
    started_ns: int | None = None
    units_of_kind: Mapping[str, str] = field(default_factory=dict)
    time_unit_said: bool = True
    twice: Mapping[str, str] = field(default_factory=dict)


def plain(name: str) -> str:
    """A name without case, blanks, "_" and "-": "Sample Rate" as "samplerate"."""
    return re.sub(r"[\s_-]", "", name).lower()


def titled(title: str) -> tuple[str, str]:
    """ "b1x [g]" and "b1x/(g)" as ("b1x", "g"); the unit is "" where there is none."""
    found = TITLE_WITH_UNIT.match(title)
    return (found[1].rstrip("/ ") or title, found[2].strip()) if found and found[1] else (title, "")


def time_unit(name: str, unit: str = "") -> float | str | None:
    """Seconds of one unit of a column of this name; None if it is no time, the unit itself if it is unknown.

    nan : it is a time that says no unit. "Time" with unit "ms", "time_ms", "t/ms" and "t in s" are known.
    """
    word = name.strip().lower().replace("µ", "u").replace("μ", "u")
    found = re.match(r"^(.*?)(?:\s*[/,]\s*|_|\s+in\s+|\s+)([a-z]+)$", word)
    if not unit and found and plain(found[1]) in TIME_NAMES and found[2] in SECONDS_OF_UNIT:
        word, unit = found[1], found[2]
    if plain(word) not in TIME_NAMES:
        return None
    text = unit.strip().lower().replace("µ", "u").replace("μ", "u").rstrip(".")
    return float("nan") if not text else SECONDS_OF_UNIT.get(text, unit)


def in_seconds(time: NDArray[np.float64], unit: float) -> tuple[NDArray[np.float64], int | None]:
    """A time column in s from its first row on, and the Unix time of that row in ns; unit : s, nan if not said."""
    first = float(time[0]) if len(time) else 0.0
    for low, high, of_range in EPOCH_RANGES:
        if low <= first <= high and (np.isnan(unit) or unit == of_range):
            return (time - time[0]) * of_range, round(first) * round(of_range * 1e9) + round(first % 1 * of_range * 1e9)
    if len(time) > 1 and (np.isnan(unit) or unit == DAY_S):
        step = float(np.median(np.diff(time)))
        for low, high, of_1970 in DAY_CALENDARS:
            if low <= first <= high and 0 < step < MOST_DAY_STEP:
                return (time - time[0]) * DAY_S, _day_ns(first - of_1970)
    return time * (1.0 if np.isnan(unit) else unit), None


def _day_ns(days: float) -> int | None:
    """Unix time of a day since 1970 with its part, on this computer's clock, to the ms that such numbers hold."""
    local = datetime(1970, 1, 1) + timedelta(milliseconds=round(days * DAY_S * 1e3))
    return round(local.timestamp() * 1e3) * 10**6


_DATE_FORMS = (
    "%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%Y/%m/%d %H:%M:%S.%f",
    "%Y/%m/%d %H:%M:%S", "%d.%m.%Y %H:%M", "%m/%d/%Y %I:%M:%S.%f %p", "%m/%d/%Y %I:%M:%S %p",
)  # fmt: skip


def date_ns(text: str) -> int | None:
    """Unix time of a date as files write it, ns; None if it is none. Without a zone it is of this computer's."""
    text = text.strip().replace(",", ".").rstrip(".")
    text = re.sub(r"\s*(?:UTC|GMT)$", "+00:00", text)
    text = re.sub(r"(\.\d{6})\d+", r"\1", text)
    time: datetime | None = None
    try:
        time = datetime.fromisoformat(text) if len(text) >= 16 else None
    except ValueError:
        for form in _DATE_FORMS:
            try:
                time = datetime.strptime(text, form)
                break
            except ValueError:
                continue
    if time is None or time.year < 1980:  # what clocks say that were never set
        return None
    whole = time.replace(microsecond=0)
    try:
        return round(whole.timestamp()) * 10**9 + time.microsecond * 1000
    except (OverflowError, OSError):
        return None


def scalar(value: Any) -> float | None:
    """The single number in a value of any shape; None if the value is no single number."""
    numbers = np.ravel(value)
    return float(numbers[0]) if numbers.size == 1 and numbers.dtype.kind in "iuf" else None


def stated_rate(values: Iterable[tuple[str, Any]]) -> list[tuple[str, float]]:
    """Names and rates in Hz of those variables that say one."""
    out = []
    for name, value in values:
        word, number = plain(name), scalar(value)
        if number is None:
            continue
        if word in {plain(n) for n in RATE_NAMES}:
            out.append((name, number))
        elif word in STEP_NAMES and number > 0:
            out.append((name, 1.0 / number))
    return out


def in_part(
    path: Path, columns: Columns, names: Sequence[str], rate_hz: float | None, part: Part
) -> tuple[Columns, float | None]:  # fmt: skip
    """The rows of a part of a file, by its time or else by its rate, and where they begin, s.

    What is no record of one length with a time or a rate comes back whole, to be refused. rate_hz : if the file says
    none. Raises ConfigError if the part is empty.
    """
    values = [np.squeeze(np.asarray(columns.values[name])) for name in names if name in columns.values]
    lengths = {v.shape for v in values}
    if len(values) < len(names) or len(lengths) != 1 or len(values[0].shape) != 1 or not len(values[0]):
        return columns, None
    count, time = len(values[0]), None if columns.time is None else np.squeeze(np.asarray(columns.time))
    rate = columns.rate_hz or rate_hz
    if time is not None and time.shape == (count,) and time.dtype.kind in "iuf":
        passed = time.astype(np.float64) - float(time[0])
    elif rate is not None and np.isfinite(rate) and rate > 0:
        passed = np.arange(count) / rate
    else:
        return columns, None
    start, stop = part.span(path, columns.started_ns)
    margin = ROW_ROUNDING * float(np.nanmedian(np.diff(passed))) if count > 1 else 0.0
    rows = np.flatnonzero((passed >= start - margin) & (passed < stop - margin))
    if not rows.size and passed[-1] < start:
        raise beyond(path, float(passed[-1]) + margin / ROW_ROUNDING)
    if not rows.size:
        raise ConfigError(f"{path}: no sample lies from {start:.9g} s to {stop:.9g} s")
    here = slice(int(rows[0]), int(rows[-1]) + 1)
    chosen = {name: np.squeeze(np.asarray(columns.values[name]))[here] for name in names}
    started_ns = None if columns.started_ns is None else columns.started_ns + round(passed[here.start] * 1e9)
    time = None if columns.time is None else time[here] if time is not None and time.shape == (count,) else time
    cut = replace(columns, values={**columns.values, **chosen}, time=time, started_ns=started_ns)
    return cut, float(passed[here.start])
