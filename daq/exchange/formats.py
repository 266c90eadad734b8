"""Data files of others as columns by name; one reader per file ending. Nothing is checked or filled here."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from daq.base.console.file_kinds import other_content, other_kind
from daq.base.console.memory import bounded_memory
from daq.base.contract.errors import ConfigError, LogError
from daq.rig.units import is_unit

from . import child
from .columns import Column, Columns, date_ns, in_seconds, stated_rate, time_unit, titled
from .csv_file import read_csv
from .leaves import UNIT_NAMES, part_of
from .lvm_file import read_lvm
from .uff_file import read_uff
from .wav_file import read_wav

RATE_TOLERANCE = 2e-3  # between two statements of the rate


def read(path: Path, names: Sequence[str], aliases: Mapping[str, str] | None = None) -> Columns:
    """The columns of a file, by its ending.

    names : of the rig's channels, in its order: a .wav names none. aliases : channel -> its name in the file.
    Raises LogError for a file that is missing, of an unknown ending, or not what its ending says; ConfigError where a
    library is not installed.
    """
    if path.is_dir():
        raise LogError(f"{path}: is a folder; give a file in it")
    reader = READER_OF_SUFFIX.get(path.suffix.lower())
    if path.suffix.lower() == ".mcap":
        raise LogError(f"{path}: is a log by its ending: it is read as it is, by fit, diagnose, info and the others")
    if reader is None and (what := other_kind(path)):
        raise LogError(f"{path}: {what}")
    if reader is None:
        known = ", ".join([*READER_OF_SUFFIX, ".log, .blf, .asc (CAN, with a DBC)"])
        remedy = REMEDY_OF_SUFFIX.get(path.suffix.lower(), "")
        what = f'is no log (.mcap), and cannot be read by its ending "{path.suffix}"'
        raise LogError(f"{path}: {what}; {remedy}known are {known}")
    if not path.is_file():
        raise LogError(f"{path}: there is no such file; check the path")
    if not os.access(path, os.R_OK):
        raise LogError(f"{path}: no permission to read it; ask its owner to let you")
    if what := other_content(path):
        raise LogError(f"{path}: {what}")
    try:
        with bounded_memory(path.stat().st_size) as bound:
            if reader is read_wav or not aliases:
                return reader(path, names)
            return by_channel(reader(path, [*names, *aliases.values()]), aliases)
    except (LogError, ConfigError, KeyboardInterrupt):
        raise
    except MemoryError as error:
        text = f"reading it takes more than {bound / 1e9:.2g} GB of memory"
        raise LogError(f"{path}: {text}; cut it into parts, or check that it is what it says") from error
    except Exception as error:  # a damaged file may raise anything in the library that reads it
        text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise LogError(
            f"{path}: cannot be read as {path.suffix}: {text}; check that it is whole, and how it was written"
        ) from error


def by_channel(columns: Columns, aliases: Mapping[str, str]) -> Columns:
    """With the names of the channels in place of those in the file; what the file calls a channel is left as it is."""
    values, units, twice = dict(columns.values), dict(columns.units), dict(columns.twice)
    for name, alias in aliases.items():
        if alias in values:
            values[name] = values.pop(alias)
            units[name] = units.pop(alias, "")
            twice.pop(name, None)
        elif alias in twice:
            twice[name] = twice[alias]
    return replace(columns, values=values, units=units, twice=twice)


def _npz(path: Path, names: Sequence[str]) -> Columns:
    with path.open("rb") as stream:
        if stream.read(2) not in (b"PK", b"\x93N"):  # of an archive, or of one array
            raise LogError(f"{path}: is no archive of numpy; write it with numpy.savez(FILE, b1x=..., rate_hz=...)")
        stream.seek(0)
        file = np.load(stream, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise LogError(f"{path}: one array without a name; write it with numpy.savez(FILE, b1x=..., rate_hz=...)")
        try:
            return of_npz(path, file, names)
        except ValueError as error:
            if "allow_pickle" not in str(error):
                raise
            raise LogError(f"{path}: holds Python objects, not numbers; save arrays of float or int") from error


def of_npz(path: Path, file: Mapping[str, Column], names: Sequence[str]) -> Columns:
    """An open archive. Raises whatever numpy does over a damaged member."""
    rates = stated_rate(
        (k, _scalar(path, file[k]) if k == "rate_hz" else file[k]) for k in file if _says_rate(k, names)
    )
    times = [k for k in file if k not in names and time_unit(k) is not None]
    known = {*names, *times, *(k for k, _ in rates), "channels", "units", "started"}
    others = dict.fromkeys([k for k in file if k not in known], np.empty(0))  # for messages only
    parts = {k: part[0] for k in names if k not in file and (part := part_of(file, k)) is not None}
    columns = Columns({k: file[k] for k in names if k in file} | parts | others, one_rate(path, rates))
    if {"channels", "units"} <= set(file):
        channels, units = (np.ravel(file[k]).astype(str).tolist() for k in ("channels", "units"))
        columns = replace(columns, units={n: u for n, u in zip(channels, units, strict=False) if u})
    said = [str(np.ravel(file[k])[0]) for k in UNIT_NAMES if k in file and k not in names and np.size(file[k]) == 1]
    if said and not columns.units and is_unit(said[0]):
        columns = replace(columns, units=dict.fromkeys(names, said[0]))
    if "started" in file and np.size(file["started"]) == 1:
        columns = replace(columns, started_ns=date_ns(str(np.ravel(file["started"])[0])))
    return with_time(path, columns, times[0], file[times[0]]) if times else columns


def _says_rate(name: str, names: Sequence[str]) -> bool:
    return name not in names and bool(stated_rate([(name, 1.0)]))


def one_rate(path: Path, rates: Sequence[tuple[str, float]]) -> float | None:
    """The rate that a file says, Hz. Raises LogError if it says two."""
    for name, rate in rates[1:]:
        if not np.isclose(rate, rates[0][1], rtol=RATE_TOLERANCE):
            text = f"{rates[0][0]} says {rates[0][1]:g} Hz, {name} {rate:g} Hz"
            raise LogError(f"{path}: {text}; remove the one that is wrong")
    return rates[0][1] if rates else None


def with_time(path: Path, columns: Columns, name: str, time: Column) -> Columns:
    """With a time vector of this name, in s from here on."""
    title, in_title = titled(name)
    unit, time = time_unit(title, in_title or columns.units.get(name, "")), np.squeeze(np.asarray(time))
    if isinstance(unit, str):
        raise LogError(f'{path}: {name} is in "{unit}", which is no unit of time; write s, ms, us, ns, min or h')
    if time.dtype.kind == "M":
        stamps = time.astype("datetime64[ns]").astype(np.int64)
        first = int(stamps[0]) if stamps.size else None
        return replace(columns, time=(stamps - (first or 0)) * 1e-9, started_ns=columns.started_ns or first)
    if time.dtype.kind == "m":
        return replace(columns, time=time.astype("timedelta64[ns]").astype(np.int64) * 1e-9)
    if time.dtype.kind not in "iuf" or unit is None or time.ndim != 1:
        return replace(columns, time=time)  # said when it is needed
    seconds, started_ns = in_seconds(time.astype(np.float64), unit)
    said = started_ns is not None or not np.isnan(unit)
    return replace(columns, time=seconds, started_ns=columns.started_ns or started_ns, time_unit_said=said)


def _scalar(path: Path, value: Any) -> float:
    """rate_hz, whatever shape its one number has."""
    numbers = np.ravel(value)
    if numbers.size != 1 or numbers.dtype.kind not in "iuf":
        raise LogError(f"{path}: rate_hz is {numbers.dtype} of shape {np.shape(value)}; one number is needed, in Hz")
    return float(numbers[0])


def _elsewhere(path: Path, names: Sequence[str]) -> Columns:
    """Read a file in a separate process (child.py)."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "columns.npz"
        command = [sys.executable, "-P", "-m", "daq.exchange.child", str(path.resolve()), str(out), *names]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        return answered(path, out, done.returncode, done.stderr)


def answered(path: Path, out: Path, status: int, said: str) -> Columns:
    """The columns from the child process. Raises its error if there are none."""
    last = said.strip().rpartition("\n")[2]
    if status == child.UNUSABLE_STATUS:
        raise LogError(f"{path}: {last}")
    if status == child.NO_MEMORY_STATUS:
        raise MemoryError
    if status == child.REFUSED_STATUS:
        raise ValueError(last)
    if status == -getattr(signal, "SIGXCPU", 0):
        raise ValueError("the library that reads it comes to no end")
    if status:
        raise ValueError(f"the library that reads it crashed (status {status})")
    with np.load(out, allow_pickle=False) as file:
        return of_answer(path, file)


def of_answer(path: Path, file: Mapping[str, Column]) -> Columns:
    """An open file of columns. Raises whatever numpy and json do over a damaged one."""
    values = {str(name): file[f"column {k}"] for k, name in enumerate(json.loads(file["names"].tobytes()))}
    about = json.loads(file["about"].tobytes())
    units = {str(name): str(unit) for name, unit in about["units"].items()}
    rates = [(str(name), float(rate)) for name, rate in about["rates"]]
    started = about.get("started")
    started_ns = started if isinstance(started, int) else None if started is None else date_ns(str(started))
    twice = {str(name): str(text) for name, text in about.get("twice", {}).items()}
    odd = str(about.get("odd", ""))
    columns = Columns(values, one_rate(path, rates), None, units, odd=odd, started_ns=started_ns, twice=twice)
    return with_time(path, columns, str(about["time"]), file["time"]) if "time" in file else columns


_SHEET_REMEDY = "save the sheet as .csv (UTF-8); "
REMEDY_OF_SUFFIX = {
    ".xlsx": _SHEET_REMEDY,
    ".xls": _SHEET_REMEDY,
    ".ods": _SHEET_REMEDY,
    ".zip": "unpack it, and give the file that is in it; ",
    ".gz": "unpack it first; ",
    ".dat": "if it is a table of text, name it .csv, and .mdf if it is of INCA; ",
    ".npy": "it names no channel: write it with numpy.savez(FILE, b1x=..., rate_hz=...) as .npz; ",
    ".trc": "a PCAN trace: convert it to .asc with PEAK's converter, or record with candump -L into a .log; ",
}
READER_OF_SUFFIX: dict[str, Callable[[Path, Sequence[str]], Columns]] = {
    ".npz": _npz, ".csv": read_csv, ".txt": read_csv, ".tsv": read_csv, ".lvm": read_lvm, ".mat": _elsewhere,
    ".mf4": _elsewhere,
    ".mdf": _elsewhere, ".uff": read_uff, ".unv": read_uff, ".uf": read_uff, ".wav": read_wav, ".tdms": _elsewhere,
    ".h5": _elsewhere, ".hdf5": _elsewhere, ".parquet": _elsewhere,
}  # fmt: skip
