"""The work of a worker on one task. Every failure with a log becomes a row with its reason."""

from __future__ import annotations

import ctypes
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from daq.analysis.answers import DOCUMENT_OF, about, origin
from daq.base.console.memory import keep_freed
from daq.base.console.output import version
from daq.base.contract.errors import ConfigError, LogError, RotorscopeError, exit_status
from daq.base.contract.part import WHOLE_RECORD, Part
from daq.exchange.measurement import measure
from daq.log.reader import read_log
from daq.rig.rig import Rig
from estimator.errors import DataError

from .archive import is_local
from .rows import rows_of
from .task import BYTES_PER_MB, WINDOWS_TASK, Task, memory_bytes

STARTED_TOPIC = "rotorscope"  # of the scheduler's events: which worker has started which task
USABLE_SHARE = 0.9  # of a worker's memory: at 0.95 its nanny ends it
KEPT_RIGS = 64
RESET_PEAK = "5"  # to clear_refs in /proc (Linux): the largest memory counts from now on
_one_at_a_time = threading.Lock()  # memory is counted for one task


class TooLargeError(LogError):
    """A task needs more memory than the worker has."""


def answer(task: Task) -> dict[str, Any]:
    """The row of a task in the table of runs, with `rows`: what goes into the other tables. Never raises."""
    with _one_at_a_time:
        keep_freed()
        _report_start(task)
        row = task.row() | {"status": "failed", "code": "", "reason": "", "notes": [], "rows": {}}
        start, start_cpu, own_peak = time.monotonic(), time.process_time(), _reset_peak()
        try:
            row |= {"run_at": time.time(), **_answered(task, row["notes"].append, row)}
        except Exception as error:
            row |= failure(error, task)
        row["took_s"] = round(time.monotonic() - start, 3)
        row["cpu_s"] = round(time.process_time() - start_cpu, 3)
        row["peak_mb"] = _peak_mb() if own_peak else None
        _let_go()
        return row


def failure(error: Exception, task: Task) -> dict[str, Any]:
    """Status, code and reason of what went wrong with a task."""
    if isinstance(error, MemoryError | TooLargeError):
        code, reason = "memory", str(error) or "the memory was not enough: give --window, or larger workers"
    elif isinstance(error, ConfigError):
        code, reason = "rig", str(error)
    elif exit_status(error) is not None:
        code, reason = "record" if isinstance(error.__cause__, DataError) else "log", str(error)
    elif isinstance(error, OSError):
        code, reason = "log", f"{task.log.url}: cannot be read: {error.strerror or error}"
    else:
        command = f"rotorscope {task.name} {task.log.url} --rig {task.log.rig.path} --verbose"
        code, reason = "defect", f"unexpected {type(error).__name__}: {error}; report what this prints: {command}"
    first = next(iter(reason.splitlines()), "")
    return {"status": "failed", "code": code, "reason": first, "rows": {}}


def _answered(task: Task, note: Any, row: dict[str, Any]) -> dict[str, Any]:
    if task.log.rig.problem:
        raise ConfigError(task.log.rig.problem)
    if version() != task.version:
        raise ConfigError(f"a worker has rotorscope {version()}, the command {task.version}: install one version")
    from estimator.parallel import one_core

    rig = _rig(task.log.rig.text, task.log.rig.base, task.log.rig.path)
    part = WHOLE_RECORD if task.from_s is None else Part(from_s=task.from_s, seconds=task.seconds)
    with local(task.log.url, task.log.stamp) as path, one_core():

        def afford(values: int) -> None:
            row["bound_mb"] = round(memory_bytes(task.name, values) / BYTES_PER_MB)
            _afford(task, values)

        if task.name == WINDOWS_TASK and path.suffix.lower() == ".mcap":  # what is in it is not read
            log = read_log(path)
            return _long_enough(task, {"started": log.started, "rate_hz": log.rate_hz, "seconds": log.seconds})
        data = measure(path, rig, note, part, afford)
        known = {"started": data.started, "rate_hz": data.rate_hz, "seconds": len(data.y) / data.rate_hz}
        row |= known
        if task.name == WINDOWS_TASK:
            return _long_enough(task, known)
        with about(task.log.url, data):
            document = DOCUMENT_OF[task.name](rig, data) | origin(task.log.url, task.log.rig.path, rig, data)
    return known | {"status": "done", "rows": rows_of(task.name, document)}


def _long_enough(task: Task, known: dict[str, Any]) -> dict[str, Any]:
    """The row of a log that is to be cut into windows. Raises LogError if it is shorter than one."""
    if task.seconds is not None and known["seconds"] < task.seconds:
        text = f"is {known['seconds']:.4g} s long, and --window asks for {task.seconds:g} s; give less"
        raise LogError(f"{task.log.url}: {text}")
    return known | {"status": "done"}


@lru_cache(KEPT_RIGS)
def _rig(text: str, base: str, path: str) -> Rig:
    return Rig.parse(text, Path(base), Path(path), path)


def _afford(task: Task, values: int) -> None:
    """Raise TooLargeError if the worker lacks the memory that the task may take."""
    limit, need = worker_memory(), memory_bytes(task.name, values)
    if limit and need > USABLE_SHARE * limit:
        text = f"{task.name} may take {need / 1e9:.2g} GB of memory, and the worker has {limit / 1e9:.2g} GB"
        raise TooLargeError(f"{task.log.url}: {text}: give --window, or larger workers")


def worker_memory() -> int:
    """The limit of this worker's memory, bytes: its own, or what there is; 0 outside a worker."""
    from distributed import get_worker
    from distributed.system import MEMORY_LIMIT

    try:
        manager = getattr(get_worker(), "memory_manager", None)
    except ValueError:
        return 0
    return int(getattr(manager, "memory_limit", None) or MEMORY_LIMIT)


def _report_start(task: Task) -> None:
    """Report the start of a task and its worker, so that the command can end an overdue one."""
    from distributed import get_worker

    with suppress(ValueError):
        worker = get_worker()
        worker.log_event(STARTED_TOPIC, {"key": task.key, "worker": worker.address})


_copy: dict[str, Path] = {}  # of the last log that came over the network


@contextmanager
def local(url: str, stamp: str) -> Iterator[Path]:
    """A log as a file here. The last one that came over the network stays until the next one comes."""
    import fsspec

    system, path = fsspec.core.url_to_fs(url)
    if is_local(system):
        yield Path(path)
        return
    name = f"{url} {stamp}"
    if name not in _copy:
        for old in _copy.values():
            old.unlink(missing_ok=True)
        _copy.clear()
        handle, taken = tempfile.mkstemp(prefix="rotorscope-", suffix=Path(path).suffix, dir=_scratch())
        os.close(handle)
        place = Path(taken)
        try:
            system.get_file(path, str(place))
        except BaseException:
            place.unlink(missing_ok=True)
            raise
        _copy[name] = place
    try:
        yield _copy[name]
    except RotorscopeError as error:
        raise type(error)(str(error).replace(str(_copy[name]), url)) from error.__cause__


def _scratch() -> str | None:
    """The folder of this worker, which Dask clears away; None outside one."""
    from distributed import get_worker

    with suppress(ValueError):
        return str(get_worker().local_directory)
    return None


def _let_go() -> None:
    """Return free memory to the system: a worker that keeps it would get no further task."""
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def _reset_peak() -> bool:
    """Let the largest memory of this process count from now on; False where the system cannot."""
    try:
        Path("/proc/self/clear_refs").write_text(RESET_PEAK)
    except OSError:
        return False
    return True


def _peak_mb() -> float | None:
    """The largest memory of this process, MB."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024 / BYTES_PER_MB
    return None
