"""Reads a .mf4 or .mat file for import_formats: python -m daq.exchange.child FILE OUT.npz CHANNEL...

A process of its own, because compiled parts of the libraries for these formats (asammdf, scipy) crash on some damaged
files. OUT gets the columns, their names and units, and the rate or the time. Exit status TOLD (a complete sentence) or
REFUSED (what the library said): the last line of standard error has it. NO_MEMORY: the memory was not enough.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

REFUSED_STATUS, TOLD_STATUS, NO_MEMORY_STATUS = 4, 5, 6
LEAST_S, BYTES_PER_S = 20, 100_000  # of CPU time: on some damaged files asammdf does not come to an end


class Told(ValueError):
    """Why the file cannot be used, and what to do."""


@dataclass(frozen=True, slots=True)
class Found:
    """values : of the channels asked for; others are there by name only."""

    values: dict[str, NDArray[Any]]
    rate: NDArray[Any] | None = None
    time: NDArray[Any] | None = None
    units: dict[str, str] = field(default_factory=dict)


def _mf4(path: Path, names: Sequence[str]) -> Found:
    from asammdf import MDF

    with MDF(path) as file:
        return of_mf4(file, names)


def of_mf4(file: Any, names: Sequence[str]) -> Found:
    """An open file. Raises whatever asammdf does over a damaged one."""
    found = [n for n in names if n in file.channels_db]
    if not found:
        return Found({n: np.empty(0) for n in file.channels_db if "time" not in n.lower()})
    signals = [file.get(n, *file.channels_db[n][0]) for n in found]
    time = signals[0].timestamps
    for n, s in zip(found, signals, strict=True):
        if len(s.timestamps) != len(time) or not np.array_equal(s.timestamps, time):
            raise Told(f"{n} was not sampled at the same times as {found[0]}; resample them to one time first")
    units = {n: s.unit for n, s in zip(found, signals, strict=True) if s.unit}
    return Found({n: s.samples for n, s in zip(found, signals, strict=True)}, None, time, units)


def _mat(path: Path, names: Sequence[str]) -> Found:
    import scipy.io

    try:
        file = scipy.io.loadmat(path, squeeze_me=True)
    except NotImplementedError as error:
        raise Told("a MATLAB 7.3 file (HDF5); save it with -v7") from error
    return of_mat(file, names)


def of_mat(file: Mapping[str, Any], names: Sequence[str]) -> Found:
    """What scipy made of it, by name."""
    rate = file.get("rate_hz", file.get("fs"))
    values = {k: np.asarray(v) for k, v in file.items() if not k.startswith("__") and np.ndim(v) >= 1}
    time = values.pop("time", None) if "time" not in names else None
    values = {k: v if k in names else np.empty(0) for k, v in values.items()}
    return Found(values, None if rate is None else np.asarray(rate), time if rate is None else None)


READER_OF_SUFFIX: dict[str, Callable[[Path, Sequence[str]], Found]] = {".mf4": _mf4, ".mat": _mat}


def _plain(value: NDArray[Any]) -> NDArray[Any]:
    """Numbers as they are. Objects do not travel (they would need pickle): only that they are none is told."""
    return value if value.dtype.kind in "biufc" else np.zeros(value.shape[:1], "S1")


def _text(value: Any) -> NDArray[np.uint8]:
    """JSON as bytes: an array of characters may hold what is none."""
    return np.frombuffer(json.dumps(value).encode(), np.uint8)


def answer(found: Found) -> dict[str, NDArray[Any]]:
    """What travels."""
    arrays: dict[str, NDArray[Any]] = {"names": _text(list(found.values)), "units": _text(found.units)}
    arrays |= {f"column {k}": _plain(v) for k, v in enumerate(found.values.values())}
    extra = {"rate": found.rate, "time": found.time}
    return arrays | {k: _plain(v) for k, v in extra.items() if v is not None}


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
    """The exit status, and the last line of standard error. What was being read is let go: it may be all the memory."""
    error.__traceback__ = error.__context__ = error.__cause__ = None
    text = " ".join(str(error).split())
    status = NO_MEMORY_STATUS if isinstance(error, MemoryError) else REFUSED_STATUS
    return TOLD_STATUS if isinstance(error, Told) else status, text or type(error).__name__


def _bounded(file_bytes: int) -> None:
    """Memory is bounded by whoever started us. The last line we say is ours: no library's that goes half-made."""
    sys.unraisablehook = lambda _: None
    with contextlib.suppress(ImportError):  # not on this system
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        seconds = LEAST_S + file_bytes // BYTES_PER_S
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))


if __name__ == "__main__":
    _bounded(Path(sys.argv[1]).stat().st_size)
    sys.exit(main(sys.argv[1:]))
