"""Checks columns of a file against the rig. Data that do not fit are refused, and never filled in silently."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.errors import LogError
from daq.base.contract.part import WHOLE_RECORD, Part
from daq.rig.conversion import Conversion, conversion
from daq.rig.problems import did_you_mean
from daq.rig.rig import Rig
from daq.rig.rig_file import ChannelTable
from daq.rig.units import canonical

from .columns import Columns, in_part, plain, titled
from .formats import RATE_TOLERANCE, read

MAX_LATE_SAMPLES = 0.25  # of a sample: how far a time stamp may be from uniform sampling
NO_VALUE = 1e30  # in any unit: no sensor gives such a value, but instruments write 9.9e37 for "no value"
# Rates that a time column without a unit gives if it is taken as s, over what they are
FACTOR_OF_UNIT = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}
FACTOR_TOLERANCE = 0.02
RATE_IN_OTHER_UNIT = {"kHz, or its period in ms": 1e-3, "MHz, or its period in us": 1e-6, "mHz": 1e3}
FREQUENCY_NAMES = frozenset({"frequency", "freq", "f", "hz", "frequenz", "fréquence"})
COARSE_STEPS_SHARE = 0.05  # of a time column that stands still: its numbers are rounded
# Titles of a table of CAN frames: of the identifier, and beginnings of those of length and bytes
FRAME_TITLES = frozenset({"id", "identifier", "can id", "canid", "arbitration_id"}), frozenset({"dl", "le", "d0", "d1"})
MOST_MISSING = 1_000_000  # samples in the holes of a record, beyond a hundred for each that is there


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Checked columns in the rig's order, as the file holds them; SI = value * factors[channel] + offsets[channel].

    missing : rows that are not there, if the caller allows gaps. started_ns : Unix time of the first row, ns.
    breaks : (row, samples that are missing before it) where another file begins. from_s : of a part, where it begins.
    """

    names: tuple[str, ...]
    values: tuple[NDArray[Any], ...]
    factors: tuple[float, ...]
    rate_hz: float
    missing: NDArray[np.bool_] | None = None
    offsets: tuple[float, ...] = ()
    started_ns: int | None = None
    breaks: tuple[tuple[int, int], ...] = ()
    from_s: float | None = None

    @property
    def lost(self) -> int:
        """Number of missing samples of each channel."""
        return (0 if self.missing is None else int(self.missing.sum())) + sum(count for _, count in self.breaks)

    @property
    def samples(self) -> int:
        return len(self.values[0])

    def si(self) -> NDArray[np.float64]:
        """(samples, channels) in SI; NaN in rows that are not there, and one row of them before each other file."""
        offsets = self.offsets or (0.0,) * len(self.names)
        columns = [v * f + o for v, f, o in zip(self.values, self.factors, offsets, strict=True)]
        y = np.column_stack(columns).astype(np.float64)
        return np.insert(y, [row for row, _ in self.breaks], np.nan, axis=0) if self.breaks else y


def load(
    path: Path, rig: Rig, rate_hz: float | None, note: Callable[[str], None], gaps: bool = False,
    part: Part = WHOLE_RECORD,
) -> Record:  # fmt: skip
    """Read a file and check it, see `checked`; or a part of it in time: nothing outside is checked.

    Names of the channels in files of others are those of the rig file.
    """
    aliases = {c.name: c.alias for c in rig.file.channel if c.alias}
    columns = read(path, [c.name for c in rig.model.channels], aliases)
    if not part.of_time:
        return checked(path, columns, rig, rate_hz, note, gaps)
    columns, from_s = in_part(path, columns, [c.name for c in rig.model.channels], rate_hz, part)
    return replace(checked(path, columns, rig, rate_hz, note, gaps), from_s=from_s)


def checked(
    path: Path, columns: Columns, rig: Rig, rate_hz: float | None, note: Callable[[str], None], gaps: bool = False
) -> Record:
    """The checked record. Raises LogError with fault, place and remedy. note : receives remarks on odd data."""
    names = tuple(c.name for c in rig.model.channels)
    values = tuple(_column(path, columns, name, rig) for name in names)
    lengths = {name: len(v) for name, v in zip(names, values, strict=True)}
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise LogError(f"{path}: channels of unequal length: {text}; cut them to the same samples")
    if lengths[names[0]] < 2:
        raise LogError(f"{path}: {lengths[names[0]]} samples; there is nothing to import")
    rate, rows = _rate(path, columns, rate_hz, lengths[names[0]], rig, gaps, note)
    if rig.model.band[1] >= rate / 2:
        text = f"band.high = {rig.model.band[1]:g} Hz of the rig is not below {rate / 2:g} Hz, half the sampling rate"
        unsure = "" if columns.time_unit_said else ', or whether its time is in s (write "time [ms]" if it is not)'
        raise LogError(f"{path}: {text}; lower band.high, or check the rate{unsure}")
    if columns.odd:
        note(columns.odd)
    said: list[str] = []
    missing = _finite(path, names, values, rate, gaps)
    if rows is not None:
        values, missing = _spread(values, rows, missing)
    to = [_conversion(path, columns, rig, c, said.append) for c in rig.file.channel]
    for text in dict.fromkeys(said):
        note(text)
    if rig.acquisition is not None and abs(rate / rig.acquisition.rate_hz - 1) > RATE_TOLERANCE:
        note(f"{rate:g} Hz, where the rig file expects {rig.acquisition.rate_hz:g} Hz; the file's rate is used")
    return Record(
        names=names, values=values, factors=tuple(c.scale for c in to), rate_hz=rate, missing=missing,
        offsets=tuple(c.offset for c in to), started_ns=columns.started_ns,
    )  # fmt: skip


def _column(path: Path, columns: Columns, name: str, rig: Rig) -> NDArray[Any]:
    if name in columns.twice:
        raise LogError(f"{path}: {columns.twice[name]}")
    if name not in columns.values:
        held = [k for k in columns.values if k not in rig.units] or list(columns.values)
        if {k.strip().lower() for k in held} & FRAME_TITLES[0] and {k.lower()[:2] for k in held} & FRAME_TITLES[1]:
            text = "a table of CAN frames; export it as .asc, .blf or candump .log, from which a DBC takes the signals"
            raise LogError(f"{path}: {text}")
        if not held:
            raise LogError(f"{path}: holds no channel; check that it is whole, and how it was written")
        remedy = did_you_mean(name, held, "it has")
        say = "; alias = of a channel in the rig file says what a file calls it"
        raise LogError(f'{path}: has no channel "{name}" of the rig; {remedy}{say}')
    value = np.atleast_1d(np.squeeze(np.asarray(columns.values[name])))
    if value.ndim != 1:
        raise LogError(f"{path}: {name} is an array of shape {np.shape(columns.values[name])}; one column is needed")
    if value.dtype.kind not in "iuf":
        raise LogError(f"{path}: {name} holds {_kind(value)}, not real numbers; write it as float or int")
    return value


def _kind(value: NDArray[Any]) -> str:
    return "text or objects" if value.dtype.kind in "SUO" else str(value.dtype)


def _rate(
    path: Path, columns: Columns, given: float | None, samples: int, rig: Rig, gaps: bool, note: Callable[[str], None]
) -> tuple[float, NDArray[np.int64] | None]:
    """The rate in Hz, and the rows of the samples in a record with gaps; all statements of the rate must agree."""
    said, rows, of_time = columns.rate_hz, None, None
    if said is not None and not (np.isfinite(said) and said > 0):
        raise LogError(f"{path}: a rate of {said:g} Hz; correct rate_hz")
    if columns.time is not None:
        time = np.squeeze(np.asarray(columns.time))
        if said is not None and time.shape != (samples,):
            note(f"its time has {time.size} values where the channels have {samples}: not used, as it says a rate too")
        elif time.dtype.kind not in "iuf":
            raise LogError(f"{path}: the time column holds {_kind(time)}, not real numbers; give seconds")
        else:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # times at the end of the floats
                of_time, rows = _uniform(path, time.astype(np.float64), samples, gaps)
    expected = said or given or (rig.acquisition.rate_hz if rig.acquisition else None)
    if of_time is not None and expected is not None and not columns.time_unit_said:
        unit = next((u for u, f in FACTOR_OF_UNIT.items() if abs(of_time / expected / f - 1) < FACTOR_TOLERANCE), None)
        if unit is not None:
            text = (
                f"its time says no unit: in s it gives {of_time:g} Hz, in {unit} the {expected:g} Hz that are expected"
            )
            raise LogError(f'{path}: {text}; call it "time [{unit}]", or "time [s]" if that is meant')
    if said is not None and of_time is not None and abs(of_time / said - 1) > RATE_TOLERANCE:
        text = f"says a rate of {said:.6g} Hz, but its time gives {of_time:.6g} Hz"
        raise LogError(f"{path}: {text}; remove or correct the one that is wrong")
    if said is not None and of_time is None and given is None and rig.acquisition is not None:
        _look_at_unit(path, said, rig.acquisition.rate_hz)
    known = said if of_time is None else of_time if said is None else said
    if known is not None and not (np.isfinite(known) and known > 0):
        raise LogError(f"{path}: a rate of {known:g} Hz; correct the time column")
    if known is not None and given is not None and abs(given / known - 1) > RATE_TOLERANCE:
        raise LogError(
            f"{path}: the file says {known:.9g} Hz, --rate says {given:g} Hz; leave --rate out or correct it"
        )
    if known is None and given is None and any(plain(titled(n)[0]) in FREQUENCY_NAMES for n in columns.values):
        raise LogError(f"{path}: a table over frequency: a spectrum; export the samples in time")
    if known is None and given is None:
        raise LogError(f"{path}: does not say its sampling rate; give --rate HZ")
    return float(known if known is not None else given or 0.0), rows


def _look_at_unit(path: Path, said_hz: float, expected_hz: float) -> None:
    """Raise LogError where a rate beside samples is the expected one in another unit."""
    for unit, factor in RATE_IN_OTHER_UNIT.items():
        if abs(said_hz / expected_hz / factor - 1) < FACTOR_TOLERANCE:
            text = f"says a rate of {said_hz:g} Hz, where the rig file expects {expected_hz:g} Hz: is it in {unit}"
            raise LogError(f"{path}: {text}? Correct it there; if it is right, correct acquisition.rate_hz")


def _uniform(path: Path, time: NDArray[np.float64], samples: int, gaps: bool) -> tuple[float, NDArray[np.int64] | None]:
    """The rate of a time column, which must be uniform but for holes, if `gaps`; then also the row of each sample."""
    if time.shape != (samples,):
        raise LogError(f"{path}: the time column has {time.size} rows, the channels {samples}; cut both to one length")
    if not np.isfinite(time).all():
        raise LogError(f"{path}: time at row {int(np.argmin(np.isfinite(time)))} is not a number; repair or cut it")
    steps = np.diff(time)
    step = float(np.median(steps))
    if step >= 0 and (steps >= 0).all() and (steps == 0).mean() > COARSE_STEPS_SHARE:
        row = int(np.argmax(steps == 0)) + 1
        text = (
            f"time stands still at row {row} ({time[row]:g} s), as its numbers are rounded more coarsely than it goes"
        )
        raise LogError(f"{path}: {text}; write more digits, or leave the time column out and give --rate")
    if step <= 0 or (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        raise LogError(f"{path}: time does not increase at row {row} ({time[row]:g} s); sort or repair the time column")
    jumps = np.flatnonzero(steps > (1 + MAX_LATE_SAMPLES * 2) * step)
    rows = np.arange(samples)
    if jumps.size and not gaps:
        row, lost = int(jumps[0]) + 1, float(steps[jumps[0]]) / step - 1
        more = f", and there are {jumps.size - 1} more gaps" if jumps.size > 1 else ""
        text = f"about {lost:.0f} samples are missing before row {row} (t = {time[row]:g} s){more}"
        raise LogError(f"{path}: {text}; import with --gaps, or the parts by themselves")
    if jumps.size:
        whole = np.ones(samples - 1)
        whole[jumps] = np.rint(steps[jumps] / step)
        if whole.sum() > 100 * samples + MOST_MISSING:
            raise LogError(f"{path}: its gaps are {whole.sum():.3g} samples long; import the parts by themselves")
        rows = np.concatenate([[0], np.cumsum(whole.astype(np.int64))])
    slope = (time[-1] - time[0]) / rows[-1]
    late = np.abs(time - time[0] - slope * rows) / slope
    if late.max() > MAX_LATE_SAMPLES:
        row = int(late.argmax())
        text = f"not sampled uniformly: row {row} is {late[row]:.2f} samples off its place"
        raise LogError(f"{path}: {text}; resample it, or leave the time column out and give --rate")
    rate = float(1.0 / slope)
    whole_hz = float(np.rint(rate))
    rate = whole_hz if abs(rate - whole_hz) < 1e-6 * rate else rate  # printed times are rounded
    return rate, rows if jumps.size else None


def _spread(
    values: tuple[NDArray[Any], ...], rows: NDArray[np.int64], missing: NDArray[np.bool_] | None
) -> tuple[tuple[NDArray[Any], ...], NDArray[np.bool_]]:
    """Samples at their rows, and which rows are not there."""
    length = int(rows[-1]) + 1
    gone = np.ones(length, bool)
    gone[rows] = False if missing is None else missing
    out = []
    for value in values:
        column = np.zeros(length, value.dtype)
        column[rows] = value
        out.append(column if value.dtype.kind != "f" else np.where(gone, np.nan, column))
    return tuple(out), gone


def _conversion(
    path: Path, columns: Columns, rig: Rig, channel: ChannelTable, note: Callable[[str], None]
) -> Conversion:
    """How the values of a channel become SI."""
    stated = columns.units.get(channel.name) or columns.units_of_kind.get(channel.kind, "")
    try:
        to = conversion(channel, stated)
    except ValueError as error:
        raise LogError(f"{path}: {channel.name} {error}") from error
    if stated and to.unit != canonical(channel.unit):
        note(f'{channel.name} is in "{stated}" there, and in "{channel.unit}" in the rig file: converted')
    counts = columns.full_scale_counts
    full_scale = None if rig.acquisition is None else rig.acquisition.full_scale
    if counts is None:
        return to
    if counts == 1:  # floats within +-1
        if full_scale is None:
            text = f"its samples are floats within +-1, taken as {channel.unit}"
            note(f"{text}; if 1 is full scale, say acquisition.full_scale in the rig file")
            return to
        note(f"its samples are floats within +-1: 1 is taken as full scale, {full_scale:g} {channel.unit}")
    elif full_scale is None:
        text = f"holds bare counts; say in the rig file what full scale is, as acquisition.full_scale in {channel.unit}"
        raise LogError(f"{path}: {text}")
    return replace(to, scale=to.scale * full_scale / counts)


def _finite(
    path: Path, names: tuple[str, ...], values: tuple[NDArray[Any], ...], rate: float, gaps: bool
) -> NDArray[np.bool_] | None:
    with np.errstate(invalid="ignore"):
        bad = [~(np.abs(v) < NO_VALUE) if v.dtype.kind == "f" else np.zeros(len(v), bool) for v in values]
    if not any(b.any() for b in bad):
        return None
    everywhere: NDArray[np.bool_] = np.logical_and.reduce(bad)
    if gaps and all(np.array_equal(b, everywhere) for b in bad):
        return everywhere
    for name, value, b in zip(names, values, bad, strict=True):
        if b.any():
            row = int(b.argmax())
            count = f"{b.sum():d} row{'s' if b.sum() > 1 else ''} in all"
            what = "not a number" if not np.isfinite(value[row]) else f'{value[row]:g}, which stands for "no value",'
            text = f"{name} is {what} at row {row} (t = {row / rate:.6g} s), {count}"
            break
    remedy = "cut the record there, or import with --gaps where all channels are missing together"
    raise LogError(f"{path}: {text}; {remedy}")
