"""Content of files of structs, groups and attributes by path: samples, and their units, rates and dates."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.rig.units import is_unit

from .columns import START_NAMES, plain, stated_rate, time_unit

SAME_TIME_SHARE = 1e-3  # of a sample: times that differ by less are the same
MOST_LEVELS = 8  # of structs in structs
OF_SAMPLES = frozenset(
    ("data", "values", "value", "signals")
)  # names of a channel's samples in a struct for one channel
UNIT_NAMES = ("unit", "units")
SCALE_NAMES = frozenset(
    ("gain", "scale", "scaling", "calibration", "calibrationfactor", "calfactor", "sensitivity", "multiplier", "slope")
    + ("conversion", "conversionfactor", "lsb", "factor")
)
_PART_OF = re.compile(r"^(.+)\((:|\d+),\s*(:|\d+)\)$")  # "data(:,2)" or "data(2,:)" of a matrix
_SINCE_DATE = re.compile(r"^\s*(\w+)\s+since\s+(\S.*)$", re.IGNORECASE)  # units of time of netCDF


class UnusableError(ValueError):
    """Why the file cannot be used, and what to do."""


@dataclass(frozen=True, slots=True)
class Found:
    """Content of a file.

    values : of the channels asked for; others are there by name only. rates : names and numbers of what says a rate.
    time : by the name `time_name`. started : Unix time in ns, or a date as text. twice : remark on each
    name that is there several times. odd : remarks for the user.
    """

    values: dict[str, NDArray[Any]]
    rates: list[tuple[str, float]] = field(default_factory=list)
    time: NDArray[Any] | None = None
    units: dict[str, str] = field(default_factory=dict)
    _: KW_ONLY
    time_name: str = "time"
    started: int | str | None = None
    twice: dict[str, str] = field(default_factory=dict)
    odd: str = ""


def fields_of(name: str, value: Any, level: int = 0) -> Iterator[tuple[str, Any]]:
    """Leaves of a struct: "data.x"."""
    fields = getattr(getattr(value, "dtype", None), "names", None)
    named = {plain(own): own for own in fields or ()}
    key = next((named[k] for k in ("name", "label") if k in named), None)
    data = next((named[k] for k in ("data", "values", "y") if k in named), None)
    if key and data and np.size(value) > 1 and isinstance(value, np.ndarray):  # channels as an array of structs
        for record in value.ravel():
            yield f"{name}.{record[key]}", record[data]
            for own in named.values():
                if own not in (key, data):
                    yield f"{name}.{record[key]}.{own}", record[own]
    elif fields and np.size(value) == 1 and level < MOST_LEVELS:
        record = value.item() if isinstance(value, np.ndarray) else value
        for k, own in enumerate(fields):
            yield from fields_of(f"{name}.{own}", record[k], level + 1)
    else:
        yield name, value


def of_leaves(leaves: Mapping[str, Any], names: Sequence[str], separator: str) -> Found:
    """Arrays and numbers by their paths. A name that is the end of one path only is enough."""
    picked, twice = _picked(leaves, names, separator)
    paths = {path for _, path in picked.values()}
    homes = {path.rpartition(separator)[0] for path in paths} | paths or {""}
    near = {
        p: v for p, v in leaves.items()
        if p not in paths and _beside(p.rpartition(separator)[0], homes, separator)
    }  # fmt: skip
    ends_of = {p: p.rpartition(separator)[2] for p in near}
    rates = [(p, rate) for p, v in near.items() if np.size(v) == 1 for _, rate in stated_rate([(ends_of[p], v)])]
    times = [p for p in near if time_unit(ends_of[p]) is not None and np.size(near[p]) > 1]
    starts = {p: t for p, v in near.items() if plain(ends_of[p]) in START_NAMES and (t := text_of(v))}
    started = next(iter(starts.values()), None)
    own_starts = [starts.get(_beneath(starts, path, separator) or "") for path in paths]
    if len(set(own_starts)) > 1:
        raise UnusableError(
            f"its channels begin at different times ({', '.join(map(str, own_starts[:4]))}); cut them to one"
        )
    others = {p: np.empty(0) for p, v in leaves.items() if p not in paths and p not in times and np.ndim(v) >= 1}
    values, units, odd = {}, {}, []
    for name, (value, path) in picked.items():
        about = _about(leaves, path, separator)
        values[name] = _scaled(np.asarray(value), about)
        if unit := text_of(about.get("unit", about.get("units"))) or _unit_of_all(leaves, path, separator):
            units[name] = unit
        for key in SCALE_NAMES & about.keys():
            number = np.ravel(about[key])
            if number.size == 1 and number.dtype.kind in "iuf" and number[0] != 1:
                odd.append(f"{name} has {key} = {number[0]:g} beside it, which is not applied: check that it is in it")
    time, time_name = None, "time"
    if times:
        of = {name: _beneath(times, path, separator) or times[0] for name, (_, path) in picked.items()}
        at = next(iter(of.values()), times[0])
        for name, other in of.items():
            if other != at and not same_times(np.asarray(near[other]), np.asarray(near[at])):
                raise UnusableError(
                    f"{name} has times of its own ({other}), others than {at}; resample them to one time first"
                )
        time, time_name = np.asarray(near[at]), ends_of[at]
        about = _about(leaves, at, separator)
        unit = text_of(about.get("unit", about.get("units"))) or ""
        if since := _SINCE_DATE.match(unit):
            unit, started = since[1], started or since[2]
        time_name = f"{time_name} [{unit}]" if unit else time_name
        if time.dtype.kind not in "iufM":
            time = None if rates else time
    return Found(
        values=values | others,
        rates=rates,
        time=time,
        units=units,
        time_name=time_name,
        started=started,
        twice=twice,
        odd="; ".join(odd),
    )


def _beneath(paths: Iterable[str], of: str, separator: str) -> str | None:
    """The one of `paths` that speaks of the samples at `of` alone: under their path, or in a struct of theirs."""
    home, _, end = of.rpartition(separator)
    homes = [of, home] if home and plain(end) in OF_SAMPLES else [of]
    return next((p for p in paths if p.rpartition(separator)[0] in homes), None)


def _picked(
    leaves: Mapping[str, Any], names: Sequence[str], separator: str
) -> tuple[dict[str, tuple[Any, str]], dict[str, str]]:
    """The samples of each name and their path; and what to say of names that are there several times."""
    picked: dict[str, tuple[Any, str]] = {}
    twice = {}
    for name in names:
        ends = [p for p in leaves if p == name] or [p for p in leaves if _end(p, separator) == name]
        if len(ends) > 1:
            text = f"{name} is there {len(ends)} times, as {', '.join(ends[:5])}"
            twice[name] = f'{text}; say which one by alias = "{ends[0]}" of its channel in the rig file'
        elif ends:
            picked[name] = leaves[ends[0]], ends[0]
        elif (part := part_of(leaves, name)) is not None:
            picked[name] = part
    return picked, twice


def part_of(leaves: Mapping[str, Any], name: str) -> tuple[NDArray[Any], str] | None:
    """A column "data(:,2)" or a row "data(2,:)" of a matrix, and the name of that."""
    part = _PART_OF.match(name)
    if part is None or part[1] not in leaves or np.ndim(leaves[part[1]]) != 2:
        return None
    table, number = np.asarray(leaves[part[1]]), part[3]
    if part[2] != ":":
        table, number = table.T, part[2]
    there = number.isdecimal() and 1 <= int(number) <= table.shape[1] and ":" in part.groups()
    return (table[:, int(number) - 1], part[1]) if there else None


def same_times(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether two vectors of times are equal but for rounding."""
    if one.shape != other.shape or one.dtype.kind not in "iuf" or other.dtype.kind not in "iuf" or one.ndim != 1:
        return bool(np.array_equal(one, other))
    step = float(np.median(np.diff(one))) if one.size > 1 else 0.0
    return one.size == 0 or bool(np.abs(one - other.astype(np.float64)).max() <= SAME_TIME_SHARE * abs(step))


def _about(leaves: Mapping[str, Any], path: str, separator: str) -> dict[str, Any]:
    """Attributes of samples, by plain names: those under their path, or beside them in a struct for one channel."""
    home, _, end = path.rpartition(separator)
    homes = [path, home] if home and plain(end) in OF_SAMPLES else [path]
    return {plain(p.rpartition(separator)[2]): v for p, v in leaves.items() if p.rpartition(separator)[0] in homes}


def _unit_of_all(leaves: Mapping[str, Any], path: str, separator: str) -> str | None:
    """The unit that stands beside several samples, in the same struct or file; None if it is none that is known."""
    home = path.rpartition(separator)[0]
    parts = ((p.rpartition(separator), value) for p, value in leaves.items())
    beside = [text_of(value) or "" for (of, _, end), value in parts if of == home and plain(end) in UNIT_NAMES]
    return beside[0] if len(beside) == 1 and is_unit(beside[0]) else None


def _scaled(value: NDArray[Any], about: Mapping[str, Any]) -> NDArray[Any]:
    """With scale_factor, add_offset and the fill value of netCDF, of which every reader of such files knows."""
    if value.dtype.kind not in "iuf":
        return value
    fills = [np.ravel(about[key])[0] for key in ("fillvalue", "missingvalue") if np.size(about.get(key, ())) == 1]
    gone = np.isin(value, fills) if fills else np.zeros(value.shape, np.bool_)
    scale, offset = (about.get(key, usual) for key, usual in (("scalefactor", 1.0), ("addoffset", 0.0)))
    if "scalefactor" in about or "addoffset" in about:
        value = value * float(np.ravel(scale)[0]) + float(np.ravel(offset)[0])
    return np.where(gone, np.nan, value) if gone.any() else value


def _end(path: str, separator: str) -> str:
    """The name at the end of a path; the samples of "b1x.data" are those of b1x."""
    home, _, end = path.rpartition(separator)
    while home and plain(end) in OF_SAMPLES:
        home, _, end = home.rpartition(separator)
    return end


def _beside(home: str, homes: set[str], separator: str) -> bool:
    """Whether an entry applies to the channels: it lies in the same place, or above."""
    return not home or any(h == home or h.startswith(home + separator) for h in homes)


def text_of(value: Any) -> str | None:
    """A text in whatever a file keeps it."""
    value = np.ravel(value)[0] if np.size(value) == 1 else value
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, np.ndarray) and value.dtype == np.uint16:  # of MATLAB 7.3
        return "".join(map(chr, value.ravel().tolist()))
    return value if isinstance(value, str) else None
