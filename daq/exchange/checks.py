"""Columns of a file against the rig: everything that would otherwise be filled silently is refused, in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.errors import LogError
from daq.rig.problems import did_you_mean
from daq.rig.rig import Rig
from daq.rig.units import canonical, factor

from .formats import Columns

MAX_LATE_SAMPLES = 0.25  # of a sample: how far a time stamp may be from uniform sampling
RATE_TOLERANCE = 2e-3  # between two statements of the rate


@dataclass(frozen=True, slots=True)
class Record:
    """Checked columns in the rig's order, as the file holds them; SI = value * factors[channel]."""

    names: tuple[str, ...]
    values: tuple[NDArray[Any], ...]
    factors: tuple[float, ...]
    rate_hz: float
    missing: NDArray[np.bool_] | None = None  # rows that are not there, if the caller allows gaps

    @property
    def samples(self) -> int:
        return len(self.values[0])

    def si(self) -> NDArray[np.float64]:
        """(samples, channels) in SI; NaN in rows that are not there."""
        return np.column_stack([v * f for v, f in zip(self.values, self.factors, strict=True)]).astype(np.float64)


def checked(
    path: Path, columns: Columns, rig: Rig, rate_hz: float | None, note: Callable[[str], None], gaps: bool = False
) -> Record:
    """The record, or LogError: what is wrong, where, and what to do. note : told what is odd but sound."""
    names = tuple(c.name for c in rig.model.channels)
    values = tuple(_column(path, columns, name, rig) for name in names)
    lengths = {name: len(v) for name, v in zip(names, values, strict=True)}
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise LogError(f"{path}: channels of unequal length: {text}; cut them to the same samples")
    if lengths[names[0]] < 2:
        raise LogError(f"{path}: {lengths[names[0]]} samples; there is nothing to import")
    rate = _rate(path, columns, rate_hz, lengths[names[0]])
    if rig.model.band[1] >= rate / 2:
        text = f"band.high = {rig.model.band[1]:g} Hz of the rig is not below half the sampling rate, {rate:g} Hz"
        raise LogError(f"{path}: {text}; lower band.high, or check the rate")
    if columns.odd:
        note(columns.odd)
    missing = _finite(path, names, values, rate, gaps)
    factors = tuple(_factor(path, columns, rig, c.name) for c in rig.file.channel)
    if rig.acquisition is not None and abs(rate / rig.acquisition.rate_hz - 1) > RATE_TOLERANCE:
        note(f"{rate:g} Hz, where the rig file expects {rig.acquisition.rate_hz:g} Hz; the file's rate is used")
    return Record(names=names, values=values, factors=factors, rate_hz=rate, missing=missing)


def _column(path: Path, columns: Columns, name: str, rig: Rig) -> NDArray[Any]:
    if name not in columns.values:
        held = [k for k in columns.values if k not in rig.units] or list(columns.values)
        raise LogError(f'{path}: has no channel "{name}" of the rig; {did_you_mean(name, held, "it has")}')
    value = np.squeeze(np.asarray(columns.values[name]))
    if value.ndim != 1:
        raise LogError(f"{path}: {name} is an array of shape {np.shape(columns.values[name])}; one column is needed")
    if value.dtype.kind not in "iuf":
        raise LogError(f"{path}: {name} holds {value.dtype}, not real numbers; write it as float or int")
    return value


def _rate(path: Path, columns: Columns, given: float | None, samples: int) -> float:
    said = columns.rate_hz
    if said is None and columns.time is not None:
        time = np.squeeze(np.asarray(columns.time))
        if time.dtype.kind not in "iuf":
            raise LogError(f"{path}: the time column holds {time.dtype}, not real numbers; give seconds")
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # times at the end of the floats
            said = _uniform(path, time.astype(np.float64), samples)
    if said is not None and not (np.isfinite(said) and said > 0):
        raise LogError(f"{path}: a rate of {said:g} Hz; correct rate_hz")
    if said is not None and given is not None and abs(given / said - 1) > RATE_TOLERANCE:
        raise LogError(f"{path}: the file says {said:.9g} Hz, --rate says {given:g} Hz; leave --rate out or correct it")
    if said is None and given is None:
        raise LogError(f"{path}: does not say its sampling rate; give --rate HZ")
    return float(said if said is not None else given or 0.0)


def _uniform(path: Path, time: NDArray[np.float64], samples: int) -> float:
    """The rate of a time column, which must be uniform."""
    if time.shape != (samples,):
        raise LogError(f"{path}: the time column has {time.size} rows, the channels {samples}; cut both to one length")
    if not np.isfinite(time).all():
        raise LogError(f"{path}: time at row {int(np.argmin(np.isfinite(time)))} is not a number; repair or cut it")
    steps = np.diff(time)
    step = float(np.median(steps))
    if step <= 0 or (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        raise LogError(f"{path}: time does not increase at row {row} ({time[row]:g} s); sort or repair the time column")
    jumps = np.flatnonzero(steps > (1 + MAX_LATE_SAMPLES * 2) * step)
    if jumps.size:
        row, lost = int(jumps[0]) + 1, float(steps[jumps[0]]) / step - 1
        more = f", and there are {jumps.size - 1} more gaps" if jumps.size > 1 else ""
        text = f"about {lost:.0f} samples are missing before row {row} (t = {time[row]:g} s){more}"
        raise LogError(f"{path}: {text}; import the parts by themselves")
    slope = (time[-1] - time[0]) / (samples - 1)
    late = np.abs(time - time[0] - slope * np.arange(samples)) / slope
    if late.max() > MAX_LATE_SAMPLES:
        row = int(late.argmax())
        text = f"not sampled uniformly: row {row} is {late[row]:.2f} samples off its place"
        raise LogError(f"{path}: {text}; resample it, or leave the time column out and give --rate")
    rate = float(1.0 / slope)
    whole = float(np.rint(rate))
    return whole if abs(rate - whole) < 1e-6 * rate else rate  # printed times are rounded


def _factor(path: Path, columns: Columns, rig: Rig, name: str) -> float:
    table = next(c for c in rig.file.channel if c.name == name)
    unit = columns.units.get(name)
    if unit is not None and canonical(unit) != canonical(table.unit):
        text = f'{name} is in "{unit}" there, and in "{table.unit}" in the rig file'
        raise LogError(f"{path}: {text}; correct one of them")
    if columns.full_scale_counts is None:
        return factor(table.kind, table.unit)
    if rig.acquisition is None or rig.acquisition.full_scale is None:
        text = f"holds bare counts; say in the rig file what full scale is, as acquisition.full_scale in {table.unit}"
        raise LogError(f"{path}: {text}")
    return factor(table.kind, table.unit) * rig.acquisition.full_scale / columns.full_scale_counts


def _finite(
    path: Path, names: tuple[str, ...], values: tuple[NDArray[Any], ...], rate: float, gaps: bool
) -> NDArray[np.bool_] | None:
    bad = [~np.isfinite(v) if v.dtype.kind == "f" else np.zeros(len(v), bool) for v in values]
    if not any(b.any() for b in bad):
        return None
    everywhere: NDArray[np.bool_] = np.logical_and.reduce(bad)
    if gaps and all(np.array_equal(b, everywhere) for b in bad):
        return everywhere
    for name, b in zip(names, bad, strict=True):
        if b.any():
            row = int(b.argmax())
            count = f"{b.sum():d} row{'s' if b.sum() > 1 else ''} in all"
            text = f"{name} is not a number at row {row} (t = {row / rate:.6g} s), {count}"
            break
    remedy = "cut the record there, or import with --gaps where all channels are missing together"
    raise LogError(f"{path}: {text}; {remedy}")
