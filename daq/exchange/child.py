"""Reads files in binary formats for `formats`: python -m daq.exchange.child FILE OUT.npz CHANNEL...

It is a separate process, because compiled parts of the libraries for these formats (asammdf, scipy, h5py) crash on some
damaged files. OUT gets the columns, their names and units, and the rate or the time. Exit status UNUSABLE (a
complete sentence) or REFUSED (the library's message): the last line of standard error has the text. NO_MEMORY: the
memory was not enough.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .columns import time_unit
from .leaves import Found, UnusableError, fields_of, of_leaves, same_times

REFUSED_STATUS, UNUSABLE_STATUS, NO_MEMORY_STATUS = 4, 5, 6
MOST_LATE_SAMPLES = 0.25  # between the first samples of channels
LEAST_S, BYTES_PER_S = 20, 100_000  # of CPU time: on some damaged files asammdf does not come to an end
MOST_SPARSE = 100_000_000  # elements of a sparse matrix that are written out
OLDEST_S = 315_532_800.0  # Unix time of 1980: dates before it are of clocks that were never set
TIME_MASTER = 1  # asammdf's sync_type of a master channel that is a time; 0 of one that says nothing
MASTER_KINDS = ("nothing", "time", "an angle", "a distance", "an index")


def _mf4(path: Path, names: Sequence[str]) -> Found:
    try:
        from asammdf import MDF
    except ImportError as error:
        raise UnusableError(
            "an MDF file needs asammdf: pip install 'rotorscope[formats]'; or export it to .csv"
        ) from error
    with MDF(path) as file:
        return of_mf4(file, names)


def of_mf4(file: Any, names: Sequence[str]) -> Found:
    """The channels of an open file. Raises what asammdf raises on a damaged one."""
    places, twice = {}, {}
    for name in names:
        group, _, own = name.partition("/")
        there = list(file.channels_db.get(name, ()))
        if not there and own and group.isdecimal():  # as the message below has it
            there = [place for place in file.channels_db.get(own, ()) if place[0] == int(group)]
            if len(there) > 1 and not _same(file, own, there):
                twice[name] = f"{own} is in group {group} {len(there)} times, with other data each time; rename them"
            else:
                places[name] = (own, *there[0]) if there else ()
        elif len(there) > 1 and not _same(file, name, there):
            groups = ", ".join(f"{g}{_named(file, g)}" for g, _ in there[:6])
            text = f"{name} is in {len(there)} groups of the file, {groups}, with other data in each"
            twice[name] = f'{text}; say which one by alias = "{there[0][0]}/{name}" of its channel in the rig file'
        elif there:
            places[name] = (name, *there[0])
    places = {name: place for name, place in places.items() if place}
    others = {n: np.empty(0) for n in file.channels_db if n not in places and time_unit(n) is None and n not in twice}
    if not places:
        return Found(others, twice=twice)
    signals = {name: file.get(*place, ignore_invalidation_bits=True) for name, place in places.items()}
    first = next(iter(signals))
    time = signals[first].timestamps
    for n, s in signals.items():
        _over_time(file, n, places[n][1])
        if not same_times(s.timestamps, time):
            raise UnusableError(f"{n} was not sampled at the same times as {first}; resample them to one time first")
    units = {n: s.unit for n, s in signals.items() if s.unit}
    time_name = _time_name(file, first, places[first][1])
    start = file.header.start_time.timestamp() + (float(time[0]) if len(time) else 0.0)
    started = round(start * 1e6) * 1000 if start > OLDEST_S else None
    return Found(
        values={n: _valid(s) for n, s in signals.items()} | others,
        rates=[],
        time=time,
        units=units,
        time_name=time_name,
        started=started,
        twice=twice,
    )


def _valid(signal: Any) -> NDArray[Any]:
    """The samples, NaN where the recorder marked them as invalid."""
    bits, samples = signal.invalidation_bits, signal.samples
    if bits is None or not np.any(bits) or samples.dtype.kind not in "iuf":
        return np.asarray(samples)
    return np.where(np.asarray(bits, np.bool_), np.nan, samples)


def _same(file: Any, name: str, places: Sequence[tuple[int, int]]) -> bool:
    """Whether all of these hold one signal."""
    first, *rest = (file.get(name, *place) for place in places)
    return all(
        np.array_equal(first.samples, s.samples) and np.array_equal(first.timestamps, s.timestamps) for s in rest
    )


def _named(file: Any, group: int) -> str:
    name = getattr(file.groups[group].channel_group, "acq_name", "")
    return f' ("{name}")' if name else ""


def _over_time(file: Any, name: str, group: int) -> None:
    """Raise UnusableError if a channel was recorded over something else than time."""
    index = file.masters_db.get(group)
    if index is None:
        raise UnusableError(
            f"{name} has no master channel, so that the file does not say when it was sampled; export it anew"
        )
    master = file.groups[group].channels[index]
    kind = getattr(master, "sync_type", TIME_MASTER)
    if kind not in (0, TIME_MASTER):
        over = MASTER_KINDS[kind] if kind < len(MASTER_KINDS) else "something else"
        text = f'{name} was recorded over {over} (master channel "{master.name}"), not over time'
        raise UnusableError(f"{text}; resample it to time, and export it again")


def _time_name(file: Any, name: str, group: int) -> str:
    """Name of the time of a group, with its unit: some recorders write ms into a master that should be in s."""
    master = file.groups[group].channels[file.masters_db[group]]
    unit = str(getattr(master, "unit", "") or "").strip()
    if isinstance(time_unit("time", unit), str):
        text = f'{name} was recorded over "{master.name}" in {unit}, which is no unit of time'
        raise UnusableError(f"{text}; resample it to time, and export it again")
    return f"time [{unit}]" if unit else "time [s]"


def _mat(path: Path, names: Sequence[str]) -> Found:
    import scipy.io

    try:
        file = scipy.io.loadmat(path, squeeze_me=True)
    except NotImplementedError:  # MATLAB 7.3, which is HDF5
        return _hdf5(path, names, "save it with -v7")
    return of_mat(file, names)


def of_mat(file: Mapping[str, Any], names: Sequence[str]) -> Found:
    """The channels of what scipy read, by name; in structs by the names of their fields, as in MATLAB."""
    leaves: dict[str, Any] = {}
    for name, value in file.items():
        if not name.startswith("__"):
            sparse = hasattr(value, "toarray") and math.prod(value.shape) <= MOST_SPARSE
            leaves.update(fields_of(name, value.toarray() if sparse else value))
    found = of_leaves(leaves, names, ".")
    opaque = [k for k, v in file.items() if type(v).__name__ == "MatlabOpaque"]
    if opaque and not any(np.size(v) for v in found.values.values()):
        text = f'"{opaque[0]}" is an object (a table, timetable or timeseries), which only MATLAB reads'
        raise UnusableError(f"{text}; save its columns as plain arrays: x = T.x; save(FILE, 'x', 'fs')")
    return found


def _hdf5(path: Path, names: Sequence[str], remedy: str = "export it to .csv or .mat") -> Found:
    try:
        import h5py
    except ImportError as error:
        raise UnusableError(
            f"an HDF5 file, which needs h5py: pip install 'rotorscope[formats]'; or {remedy}"
        ) from error
    leaves: dict[str, Any] = {}

    def take(name: str, item: Any) -> None:
        for key, value in item.attrs.items():
            if not key.startswith("MATLAB"):
                leaves[f"{name}/{key}"] = value
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            leaves[name] = item

    with h5py.File(path, "r") as file:
        for key, value in file.attrs.items():
            leaves[key] = value
        file.visititems(take)
        return of_leaves(leaves, names, "/")


def _tdms(path: Path, names: Sequence[str]) -> Found:
    try:
        from nptdms import TdmsFile
    except ImportError as error:
        raise UnusableError(
            "a TDMS file needs nptdms: pip install 'rotorscope[formats]'; or export it to .csv"
        ) from error
    with TdmsFile.open(path) as file:
        channels = {f"{group.name}/{channel.name}": channel for group in file.groups() for channel in group.channels()}
        steps = [
            (p, float(c.properties["wf_increment"])) for p, c in channels.items() if "wf_increment" in c.properties
        ]
        leaves: dict[str, Any] = {p: _Lazy(c) for p, c in channels.items()}
        found = of_leaves(leaves, names, "/")
        asked = {n: [p for p in channels if p == n or p.rpartition("/")[2] == n] for n in names if n in found.values}
        of = [c for paths in asked.values() for c in (channels[p] for p in paths[:1])]
        units = {n: str(channels[p[0]].properties.get("unit_string", "")) for n, p in asked.items() if p}
        start = [c.properties["wf_start_time"] for c in of if "wf_start_time" in c.properties]
        mine = {p for paths in asked.values() for p in paths}
    offsets = [float(c.properties.get("wf_start_offset", 0.0)) for c in of]
    start_ns = [int(np.datetime64(b, "ns").astype(np.int64)) for b in start]
    apart_s = [(ns - start_ns[0]) * 1e-9 for ns in start_ns]
    late = [o + a for o, a in zip(offsets, apart_s or [0.0] * len(offsets), strict=False)]
    least = min((step for p, step in steps if p in mine), default=0.0)
    if late and (len(start) not in (0, len(of)) or max(late) - min(late) > MOST_LATE_SAMPLES * least):
        raise UnusableError(f"its channels begin up to {max(late) - min(late):.6g} s apart; cut them to one start")
    rates = [(f"wf_increment of {p}", 1.0 / step) for p, step in steps if step > 0 and p in mine]
    started = start_ns[0] if start else found.started
    units = {n: u for n, u in units.items() if u}
    return replace(found, rates=found.rates + rates, units=units, started=started)


class _Lazy:
    """A channel whose samples are read when they are asked for."""

    def __init__(self, channel: Any) -> None:
        self._channel = channel
        self.shape, self.ndim, self.size = (len(channel),), 1, len(channel)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self._channel[:], dtype)


def _parquet(path: Path, names: Sequence[str]) -> Found:
    os.environ |= {"ARROW_DEFAULT_MEMORY_POOL": "system", "ARROW_IO_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:  # its own pool and threads take more addresses than a small file is granted
        from pyarrow import parquet
    except ImportError as error:
        raise UnusableError(
            "a Parquet file needs pyarrow: pip install 'rotorscope[formats]'; or export it to .csv"
        ) from error
    file = parquet.ParquetFile(path)
    schema = file.schema_arrow
    wanted = [n for n in schema.names if n in names or time_unit(n) is not None]
    table = file.read(columns=wanted, use_threads=False)
    exact = {f.name for f in schema if str(f.type).startswith("decimal")}
    leaves: dict[str, Any] = {n: (table[n].cast("float64") if n in exact else table[n]).to_numpy() for n in wanted}
    leaves = {n: leaves.get(n, np.empty(0)) for n in schema.names}
    for key, value in (schema.metadata or {}).items():
        text = value.decode("utf-8", "replace")
        leaves.setdefault(key.decode("utf-8", "replace"), _as_number(text) if len(text) < 40 else text)
    units = {f.name: m[b"unit"].decode() for f in schema if b"unit" in (m := f.metadata or {})}
    return replace(of_leaves(leaves, names, "/"), units=units)


def _as_number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


READER_OF_SUFFIX: dict[str, Callable[[Path, Sequence[str]], Found]] = {
    ".mf4": _mf4, ".mdf": _mf4, ".mat": _mat, ".h5": _hdf5, ".hdf5": _hdf5, ".tdms": _tdms, ".parquet": _parquet,
}  # fmt: skip


def _plain(value: NDArray[Any]) -> NDArray[Any]:
    """Numbers unchanged. Objects are replaced by a mark that they are no numbers, since they would need pickle."""
    return value if value.dtype.kind in "biufcMm" else np.zeros(value.shape[:1], "S1")


def _text(value: Any) -> NDArray[np.uint8]:
    """JSON as bytes, because an array of characters may hold invalid ones."""
    return np.frombuffer(json.dumps(value).encode(), np.uint8)


def answer(found: Found) -> dict[str, NDArray[Any]]:
    """The arrays that are sent to the parent."""
    about = {
        "units": found.units, "rates": found.rates, "time": found.time_name, "started": found.started, "odd": found.odd,
        "twice": found.twice,
    }  # fmt: skip
    arrays: dict[str, NDArray[Any]] = {"names": _text(list(found.values)), "about": _text(about)}
    arrays |= {f"column {k}": _plain(v) for k, v in enumerate(found.values.values())}
    return arrays if found.time is None else arrays | {"time": _plain(found.time)}


def main(arguments: Sequence[str]) -> int:
    path, out, *names = arguments
    try:
        found = READER_OF_SUFFIX[Path(path).suffix.lower()](Path(path), names)
        np.savez(out, **answer(found))  # type: ignore[arg-type]
    except Exception as error:  # a damaged file may raise anything in the library
        status, line = refusal(error)
        sys.stderr.write(f"\n{line}\n")
        sys.stderr.flush()
        return status
    return 0


def refusal(error: Exception) -> tuple[int, str]:
    """Exit status, and last line of standard error. Releases the data read so far, which may take all the memory."""
    error.__traceback__ = error.__context__ = error.__cause__ = None
    text = " ".join(str(error).split())
    status = NO_MEMORY_STATUS if isinstance(error, MemoryError) else REFUSED_STATUS
    return UNUSABLE_STATUS if isinstance(error, UnusableError) else status, text or type(error).__name__


def _bounded(file_bytes: int) -> None:
    """Bound the CPU time; the parent bounds the memory. A library's destructor must not write the last line."""
    sys.unraisablehook = lambda _: None
    with contextlib.suppress(ImportError):  # not on this system
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        seconds = LEAST_S + file_bytes // BYTES_PER_S
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))


if __name__ == "__main__":
    _bounded(Path(sys.argv[1]).stat().st_size)
    sys.exit(main(sys.argv[1:]))
