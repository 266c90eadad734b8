"""Universal files: time responses of dataset 58 in the units that dataset 164 or their own heads say."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from daq.base.console.extras import required
from daq.base.contract.errors import LogError

from .columns import Column, Columns, date_ns, time_unit

MOST_LATE_SAMPLES = 0.25  # between the first samples of records
TIME_TYPE = 17  # of an abscissa
SAME_STEP_REL = 1e-6  # between the steps of records: they are written in single precision
ROUNDED_STEP_REL = 5e-6  # of a step of six figures, as dataset 58 writes it
SET_MARK, RECORD_HEAD = b"    -1", b"\n    58"  # before and behind each dataset; how a dataset 58 begins
VALUES_OF_LINE = 6  # at most, in a dataset 58 as text: a last line may be filled up
# Dataset 164 says by what to divide to get metres and newtons
UNIT_OF_LENGTH = {1.0: "m", 1e3: "mm", 1e2: "cm", 1e6: "um", 1 / 0.0254: "in", 1 / 0.3048: "ft"}
UNIT_OF_FORCE = {1.0: "N", 1e3: "mN", 1e-3: "kN", 1 / 4.4482216152605: "lbf", 1 / 9.80665: "kgf"}


def read_uff(path: Path, names: Sequence[str]) -> Columns:
    pyuff = required("pyuff", "formats", str(path))
    _check_whole(path)
    file = pyuff.UFF(str(path))
    kinds = [int(kind) for kind in file.get_set_types()]
    units = [file.read_sets(i) for i, kind in enumerate(kinds) if kind == 164]
    return of_uff(path, (file.read_sets(i) for i, kind in enumerate(kinds) if kind == 58), names, units)


def _check_whole(path: Path) -> None:
    """Raise LogError if the file ends inside a dataset 58: the library passes over it."""
    content = path.read_bytes()
    last = content.rfind(RECORD_HEAD)
    if last >= 0 and content.find(SET_MARK, last + len(RECORD_HEAD)) < 0:
        raise LogError(f"{path}: its last dataset 58 has no end; the file is cut: export it again")


def of_uff(
    path: Path, sets: Iterable[Mapping[str, Any]], names: Sequence[str], systems: Sequence[Mapping[str, Any]] = ()
) -> Columns:
    """Data sets 58 and 164 as pyuff has them."""
    records = [s for s in sets if s.get("func_type") == 1]  # time response
    if not records:
        raise LogError(f"{path}: holds no time response (dataset 58, function type 1); export the time histories")
    values: dict[str, Column] = {}
    units: dict[str, str] = {}
    for s in records:
        labels = [str(s.get(k, "")).strip() for k in ("id1", "id2", "id4", "id5", "rsp_ent_name")]
        name = next((label for label in labels if label in names), labels[0] or f"record {len(values) + 1}")
        if name in values:
            raise LogError(f'{path}: two time responses are called "{name}"; name each after its channel')
        values[name] = _samples(path, name, s)
        if unit := str(s.get("ordinate_axis_units_lab", "")).strip().strip("-").removeprefix("NONE"):
            units[name] = unit
    started_ns = next((ns for s in records if (ns := date_ns(str(s.get("id3", ""))))), None)
    of_kind = _system(path, systems)
    rate_hz, time = _sampled(path, records, list(values))
    return Columns(values, rate_hz, time, units, started_ns=started_ns, units_of_kind=of_kind)


def _sampled(
    path: Path, records: Sequence[Mapping[str, Any]], names: Sequence[str]
) -> tuple[float | None, Column | None]:  # fmt: skip
    """The rate of all records, or their times. Raises LogError where they differ, or are over something else."""
    for name, s in zip(names, records, strict=True):
        if int(s.get("abscissa_spec_data_type", TIME_TYPE) or TIME_TYPE) != TIME_TYPE:
            raise LogError(f"{path}: {name} is recorded over something that is no time; export the time histories")
    unit = _abscissa_unit(path, records[0])
    uneven = [int(s.get("abscissa_spacing", 1)) == 0 or float(s.get("abscissa_inc", 0.0)) == 0.0 for s in records]
    if any(uneven):
        first = np.asarray(records[0]["x"])
        for name, s in zip(names, records, strict=True):
            if not np.array_equal(np.asarray(s["x"]), first):
                text = f"{name} was not sampled at the same times as {names[0]}"
                raise LogError(f"{path}: {text}; resample them to one time first")
        return None, first * unit
    steps = [float(s["abscissa_inc"]) * unit for s in records]
    begins = [float(s.get("abscissa_min", 0.0)) * unit for s in records]
    if max(begins) - min(begins) > MOST_LATE_SAMPLES * min(map(abs, steps)):
        raise LogError(f"{path}: its records begin {max(begins) - min(begins):.6g} s apart; cut them to one start")
    for name, step in zip(names, steps, strict=True):
        if not math.isclose(step, steps[0], rel_tol=SAME_STEP_REL):
            text = f"{names[0]} is sampled at {1 / steps[0]:.6g} Hz, {name} at {1 / step:.6g} Hz"
            raise LogError(f"{path}: {text}; export channels of one rate")
    rate_hz = 1.0 / steps[0]
    whole = math.isclose(rate_hz, round(rate_hz), rel_tol=ROUNDED_STEP_REL)
    return (float(round(rate_hz)) if whole else rate_hz), None


def _abscissa_unit(path: Path, record: Mapping[str, Any]) -> float:
    """Seconds of one unit of the abscissa."""
    label = str(record.get("abscissa_axis_units_lab", "")).strip().strip("-").removeprefix("NONE")
    unit = time_unit("time", label)
    if isinstance(unit, str):
        raise LogError(f'{path}: the time is in "{label}", which is no unit of time; write s, ms, us or min')
    return 1.0 if unit is None or math.isnan(unit) else unit


def _samples(path: Path, name: str, record: Mapping[str, Any]) -> Column:
    """The values of a dataset, without the zeros that fill up its last line."""
    column: Column = np.real(record["data"])
    points = int(record["num_pts"])
    filled = points < len(column) < points + VALUES_OF_LINE and not np.asarray(record["data"])[points:].any()
    if len(column) != points and not filled:
        text = f"{name} has {len(column)} values, its header says {points}"
        raise LogError(f"{path}: {text}; the file is cut or damaged: export it again")
    if np.imag(record["data"]).any():
        raise LogError(f"{path}: {name} is complex; a time response is real: export the time histories")
    return column[:points]


def _system(path: Path, systems: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Units of the kinds of channel, from the last dataset 164; none if there is none."""
    if not systems:
        return {}
    last = systems[-1]
    length, force = (_unit(units, float(last.get(key, 1.0) or 1.0)) for units, key in (
        (UNIT_OF_LENGTH, "length"), (UNIT_OF_FORCE, "force")))  # fmt: skip
    if length is None or force is None:
        text = f"dataset 164 has units of its own (factors {last.get('length')} and {last.get('force')})"
        raise LogError(f"{path}: {text}; export it in SI units, or name the unit of each channel")
    return {"acceleration": f"{length}/s^2", "velocity": f"{length}/s", "displacement": length, "force": force}


def _unit(units: Mapping[float, str], said: float) -> str | None:
    return next((unit for value, unit in units.items() if math.isclose(said, value, rel_tol=1e-3)), None)
