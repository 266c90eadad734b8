"""Data files of others as columns by name; one reader per file ending. Nothing is checked or filled here."""

from __future__ import annotations

import csv
import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, TextIO

import numpy as np
from numpy.typing import NDArray

from daq.base.console.memory import bounded_memory
from daq.base.contract.errors import LogError

from . import child

Column = NDArray[Any]
CSV_ROWS = 200_000  # parsed at a time
LONGEST_LINE = 1 << 20  # bytes
MOST_CHUNKS = 10_000  # of a .wav before its samples
_TITLE_WITH_UNIT = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*)\s*[\])]\s*$")  # "b1x [g]", "b1x (m/s^2)"


@dataclass(frozen=True, slots=True)
class Columns:
    """What a file holds. units : of those columns whose unit the file says; time : s, if the file has one.

    full_scale_counts : the count at full scale if the columns are bare counts (PCM audio), else None. odd : what the
    user should know of a file that was read all the same.
    """

    values: Mapping[str, Column]
    rate_hz: float | None = None
    time: Column | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    full_scale_counts: int | None = None
    odd: str = ""


def read(path: Path, names: Sequence[str]) -> Columns:
    """The columns of a file, by its ending. names : of the rig's channels, for formats that name none (.wav).

    Raises LogError for a file that is missing, of an unknown ending, or not what its ending says.
    """
    reader = READER_OF_SUFFIX.get(path.suffix.lower())
    if reader is None:
        known = ", ".join([*READER_OF_SUFFIX, ".log, .blf, .asc (CAN, with a DBC)"])
        raise LogError(f'{path}: cannot import a file that ends in "{path.suffix}"; known are {known}')
    if not path.is_file():
        raise LogError(f"{path}: there is no such file; check the path")
    try:
        with bounded_memory(path.stat().st_size) as bound:
            return reader(path, names)
    except (LogError, KeyboardInterrupt):
        raise
    except MemoryError as error:
        text = f"reading it takes more than {bound / 1e9:.2g} GB of memory"
        raise LogError(f"{path}: {text}; cut it into parts, or check that it is what it says") from error
    except Exception as error:  # a damaged file may raise anything in the library that reads it
        text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise LogError(
            f"{path}: cannot be read as {path.suffix}: {text}; check that it is whole, and how it was written"
        ) from error


def _npz(path: Path, names: Sequence[str]) -> Columns:
    with path.open("rb") as stream:
        file = np.load(stream, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise LogError(f"{path}: one array without a name; write it with numpy.savez(FILE, b1x=..., rate_hz=...)")
        return of_npz(path, file, names)


def of_npz(path: Path, file: Mapping[str, Column], names: Sequence[str]) -> Columns:
    """An open archive. Raises whatever numpy does over a damaged member."""
    rate = _scalar(path, file["rate_hz"]) if "rate_hz" in file else None
    time = file["time"] if "time" in file and rate is None else None
    known = {*names, "rate_hz", "time"}
    others = dict.fromkeys([k for k in file if k not in known], np.empty(0))  # for messages only
    return Columns({k: file[k] for k in names if k in file} | others, rate, time)


def _scalar(path: Path, value: Any) -> float:
    """rate_hz, whatever shape its one number has."""
    numbers = np.ravel(value)
    if numbers.size != 1 or numbers.dtype.kind not in "iuf":
        raise LogError(f"{path}: rate_hz is {numbers.dtype} of shape {np.shape(value)}; one number is needed, in Hz")
    return float(numbers[0])


def _csv(path: Path, names: Sequence[str]) -> Columns:
    with path.open("rb") as file:
        start = file.read(LONGEST_LINE)
        if len(start) == LONGEST_LINE and not {*b"\r\n"} & {*start}:
            raise LogError(
                f"{path}: its first line does not end within a megabyte; a table with a row a line is needed"
            )
    with path.open(encoding="utf-8-sig", newline="") as file:
        skipped, header, delimiter = _header(file)
        titles = [m[1] if (m := _TITLE_WITH_UNIT.match(h)) else h for h in header]
        if len(set(titles)) < len(titles):
            twice = next(t for i, t in enumerate(titles) if t in titles[:i])
            raise LogError(f'{path}: the header names "{twice}" twice; rename one column')
        units = {t: m[2] for t, h in zip(titles, header, strict=True) if (m := _TITLE_WITH_UNIT.match(h))}
        wanted = [i for i, t in enumerate(titles) if t in names or t.lower() == "time"]
        others = {t: np.empty(0) for t in titles if t not in names and t.lower() != "time"}  # for messages only
        parts: list[NDArray[np.float64]] = []
        row, last = skipped + 1, "\n"
        while lines := list(islice(file, CSV_ROWS)):
            parts.append(_numbers(path, lines, delimiter, row, titles, wanted))
            row, last = row + len(lines), lines[-1]
    odd = (
        "" if last.endswith(("\n", "\r")) else "the last line has no end; if the file was cut, its last number is wrong"
    )
    table = np.concatenate(parts) if parts else np.empty((0, len(wanted)))
    columns = {titles[i]: table[:, k] for k, i in enumerate(wanted)}
    time = next((columns.pop(t) for t in list(columns) if t.lower() == "time" and t not in names), None)
    return Columns(columns | others, None, time, units, odd=odd)


def _header(file: TextIO) -> tuple[int, list[str], str]:
    """Lines up to the header, its titles, and the delimiter."""
    for number, line in enumerate(file, 1):
        if line.strip() and not line.startswith("#"):
            delimiter = max(",;\t", key=line.count)
            return number, [t.strip() for t in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter))], delimiter
    raise LogError(f"{file.name}: is empty; a header of channel names and rows of numbers are needed")


def _numbers(
    path: Path, lines: list[str], delimiter: str, row: int, titles: list[str], wanted: list[int]
) -> NDArray[np.float64]:
    if not wanted or not any(line.strip() for line in lines):
        return np.empty((0, len(wanted)))
    try:
        if any(line.count(delimiter) != len(titles) - 1 for line in lines if line.strip()):
            raise ValueError("a line has more or fewer cells than the header")
        return np.loadtxt(lines, delimiter=delimiter, usecols=wanted, ndmin=2, comments=None)
    except ValueError as error:
        for k, line in enumerate(lines):
            cells = next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter), [])
            if cells and len(cells) != len(titles):
                text = f"{len(cells)} cells where the header has {len(titles)}"
                raise LogError(f"{path}:{row + k}: {text}; repair or cut that line") from error
            for i in wanted if cells else ():
                try:
                    float(cells[i])
                except ValueError:
                    what = f'"{cells[i]}" is not a number' if cells[i].strip() else "the cell is empty"
                    raise LogError(f"{path}:{row + k}: {titles[i]}: {what}; repair or cut that line") from error
        raise


def _elsewhere(path: Path, names: Sequence[str]) -> Columns:
    """In a process of its own, see import_child."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "columns.npz"
        command = [sys.executable, "-P", "-m", "daq.exchange.child", str(path.resolve()), str(out), *names]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        return answered(path, out, done.returncode, done.stderr)


def answered(path: Path, out: Path, status: int, said: str) -> Columns:
    """What the child process answered: its file of columns, or why there is none."""
    last = said.strip().rpartition("\n")[2]
    if status == child.TOLD_STATUS:
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
    units = {str(name): str(unit) for name, unit in json.loads(file["units"].tobytes()).items()}
    rate = _scalar(path, file["rate"]) if "rate" in file else None
    return Columns(values, rate, file.get("time"), units)


def _uff(path: Path, names: Sequence[str]) -> Columns:
    import pyuff

    file = pyuff.UFF(str(path))
    return of_uff(path, (file.read_sets(i) for i, kind in enumerate(file.get_set_types()) if int(kind) == 58), names)


def of_uff(path: Path, sets: Iterable[Mapping[str, Any]], names: Sequence[str]) -> Columns:
    """Data sets 58 as pyuff has them."""
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
        values[name] = column = np.real(s["data"])
        if len(column) != s["num_pts"]:
            text = f"{name} has {len(column)} values, its header says {s['num_pts']}"
            raise LogError(f"{path}: {text}; the file is cut or damaged: export it again")
        if np.imag(s["data"]).any():
            raise LogError(f"{path}: {name} is complex; a time response is real: export the time histories")
        if unit := str(s.get("ordinate_axis_units_lab", "")).strip().strip("-").removeprefix("NONE"):
            units[name] = unit
    steps = {float(s.get("abscissa_inc", 0.0)) for s in records}
    if len(steps) > 1 or 0.0 in steps:
        return Columns(values, None, np.asarray(records[0]["x"]), units)
    return Columns(values, 1.0 / steps.pop(), None, units)


def _wav(path: Path, names: Sequence[str]) -> Columns:
    import warnings

    from scipy.io import wavfile

    missing = _beyond_the_end(path)
    if missing:
        text = f"{missing} bytes of the samples it announces are missing: it is cut, or was written through a pipe"
        raise LogError(f"{path}: {text}; copy or export it again")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # chunks that carry no samples
        rate, data = wavfile.read(path, mmap=False)
    data = data.reshape(len(data), -1)
    if data.shape[1] != len(names):
        text = f"{data.shape[1]} tracks, where the rig has {len(names)} channels ({', '.join(names)})"
        raise LogError(f"{path}: {text}; a .wav names none, so their number and order must be the rig's")
    values = {n: data[:, i] for i, n in enumerate(names)}
    if data.dtype.kind == "f":
        return Columns(values, float(rate))
    if data.dtype == np.uint8:
        raise LogError(f"{path}: 8-bit sound; 16, 24 or 32 bits, or floats, are needed")
    return Columns(values, float(rate), full_scale_counts=2 ** (8 * data.dtype.itemsize - 1))


def _beyond_the_end(path: Path) -> int:
    """Bytes of samples that a .wav announces and does not hold; the library takes what there is, and is silent."""
    size = path.stat().st_size
    with path.open("rb") as file:
        order: Literal["little", "big"] = "big" if file.read(12)[:4] == b"RIFX" else "little"
        long = None  # of a file that may be above 4 GB
        for _ in range(MOST_CHUNKS):
            head = file.read(8)
            name, length = head[:4], int.from_bytes(head[4:], order)
            if name == b"ds64":
                long = int.from_bytes(file.read(16)[8:], "little")
                length -= 16
            elif name == b"data":
                return max(file.tell() + (length if long is None else long) - size, 0)
            file.seek(max(length, 0) + length % 2, 1)
            if len(head) < 8:
                break
    return 0


READER_OF_SUFFIX: dict[str, Callable[[Path, Sequence[str]], Columns]] = {
    ".npz": _npz, ".csv": _csv, ".mat": _elsewhere, ".mf4": _elsewhere, ".uff": _uff, ".unv": _uff, ".wav": _wav,
}  # fmt: skip
