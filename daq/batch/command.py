"""The body of batch: an archive in, tables out."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

from daq.base.console.extras import check_installed
from daq.base.console.output import Output, version
from daq.base.console.stop import Stop
from daq.base.contract.errors import ConfigError, LogError

from .archive import LogSource, RigsByField, RigSource, find_logs, read_rig
from .cluster import connected
from .run import Loop, rate_text
from .tables import DONE_STATUS, MAX_FALSE_DISCOVERY_RATE, NOTHING_NAMED, Place, Results
from .task import WINDOWS_TASK, Task, Windows

BATCH_MODULES = ("distributed", "fsspec", "pyarrow")
MOST_REASONS = 5  # that are shown; the table has them all


@dataclass(frozen=True, slots=True)
class Asked:
    """The options of the command, checked.

    only_failed : do again what failed, and nothing else. timeout_s : of a task; None: no limit.
    """

    names: list[str]
    _: KW_ONLY
    rig: Path | None = None
    rig_of: str | None = None
    windows: Windows | None = None
    only_failed: bool = False
    timeout_s: float | None = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if (self.rig is None) == (self.rig_of is None):
            raise ConfigError("give one of --rig RIG (one rig file for all logs) and --rig-of 'rigs/{machine}.toml'")

    def rig_source(self) -> Callable[[str, dict[str, str]], RigSource]:
        """Finds the rig file of a log. Raises ConfigError for a rig file that is wrong."""
        if self.rig_of is not None:
            return RigsByField(self.rig_of)
        one = read_rig(str(self.rig))
        return lambda _url, _fields: one


@dataclass
class Known:
    """Results in the tables. runs : place of a task -> key, status and length in s."""

    runs: dict[Place, tuple[str, str, float]]
    only_failed: bool
    skipped: int = field(default=0, init=False)

    def seconds(self, task: Task) -> float | None:
        """Length in s of the log of a task, if the task is done for the same request."""
        key, status, seconds = self.runs.get(task.place, ("", "", 0.0))
        return seconds if key == task.key and status == DONE_STATUS else None

    def settled(self, task: Task) -> bool:
        """Whether a task needs not be done."""
        key, status, _ = self.runs.get(task.place, ("", DONE_STATUS, 0.0))
        done = status == DONE_STATUS if self.only_failed else key == task.key
        self.skipped += done
        return done


def batch(output: Output, patterns: Sequence[str], out: Path, asked: Asked) -> None:
    """Analyse every log that the patterns name, and keep the answers as tables in `out`."""
    check_installed(BATCH_MODULES, "batch", "batch")
    start = time.monotonic()
    logs = find_logs(patterns, asked.rig_source())
    with Results.opened(out) as results:
        known = Known(results.known(), asked.only_failed)
        tasks = [task for task in _tasks(logs, asked, known) if not known.settled(task)]
        loop = _run(output, asked, results, known, tasks) if tasks else None
        _report(output, asked, results, (len(logs), known.skipped, time.monotonic() - start), loop)


def _tasks(logs: Sequence[LogSource], asked: Asked, known: Known) -> Iterator[Task]:
    """The tasks of all logs; of a log to be cut into windows, how long it is comes first."""
    for log in logs:
        whole = [Task(log=log, name=name, version=version()) for name in asked.names]
        if asked.windows is None:
            yield from whole
            continue
        cut = Task(log=log, name=WINDOWS_TASK, version=version(), seconds=asked.windows.length_s)
        seconds = known.seconds(cut)
        if seconds is not None:
            yield from cut.windows(asked.windows, seconds, asked.names)
        else:
            yield cut


def _run(output: Output, asked: Asked, results: Results, known: Known, tasks: list[Task]) -> Loop:
    """Do the tasks. Finished tasks are stored, however the run ends. Raises KeyboardInterrupt if the user stops it."""
    with Stop() as stop, connected(asked.scheduler) as client, output.progress("batch") as progress:
        loop = Loop(
            client=client, results=results, timeout_s=asked.timeout_s, windows=asked.windows, names=asked.names,
            settled=known.settled, progress=progress, stopped=stop.event.is_set, note=output.note,
        )  # fmt: skip
        try:
            loop.run(tasks)
        finally:
            results.merge()
        if stop.event.is_set():
            left = f"what is done is kept, {loop.total - loop.done} tasks are left"
            output.note(f"{results.folder}: {left}; type the same command again to go on")
            raise KeyboardInterrupt
    return loop


def _report(
    output: Output, asked: Asked, results: Results, counts: tuple[int, int, float], loop: Loop | None
) -> None:  # fmt: skip
    """Report the result, for people and as JSON. Raises LogError if no task succeeded."""
    logs, skipped, seconds = counts
    done, failed = (0, 0) if loop is None else (loop.done - loop.failed, loop.failed)
    rows, bad, verdicts = len(results.known()), results.failed(), results.verdicts()
    named = [stands for verdict, stands in verdicts if verdict not in NOTHING_NAMED]
    value: dict[str, Any] = {
        "schema": 1,
        "out": str(results.folder),
        "scheduler": asked.scheduler or "local",
        "logs": logs,
        "runs": {"done": done, "failed": failed, "already_there": skipped},
        "table": {"runs": rows, "failed": len(bad)},
        "reasons": [{"code": code, "count": n, "example": text} for (code, text), n in reasons(bad)],
        "verdicts": dict(Counter(verdict for verdict, _ in verdicts).most_common()),
        "correction": {
            "method": "Benjamini-Hochberg",
            "records": len(verdicts),
            "false_discovery_rate": MAX_FALSE_DISCOVERY_RATE,
            "named": len(named),
            "stand": sum(named),
        },
        "seconds": seconds,
    }
    people = [f"{logs} logs: {done} tasks done, {failed} failed, {skipped} there already"]
    if loop is not None and done:
        people[0] += f"; {rate_text(done / seconds)}"
    people += [f"  {n} x {code}: {text}" for (code, text), n in reasons(bad)[:MOST_REASONS]]
    if bad:
        people.append("  --only-failed does them again; the table of runs has every reason")
    if verdicts:
        said = ", ".join(f"{name} {n}" for name, n in value["verdicts"].items())
        people.append(f"verdicts of {len(verdicts)} records: {said}")
    if named:
        people.append(
            f"{value['correction']['stand']} of {len(named)} that name something stand among {len(verdicts)} records "
            f"(Benjamini-Hochberg, false discovery rate {100 * MAX_FALSE_DISCOVERY_RATE:g} %)"
        )
    people.append(f"{results.folder}: runs, parameters, verdicts, severity (.parquet)")
    output.result(value, *people)
    if rows and len(bad) == rows:
        raise LogError(f"{results.folder}: every task failed; the first reason: {reasons(bad)[0][0][1]}")


def reasons(failed: Sequence[tuple[str, str]]) -> list[tuple[tuple[str, str], int]]:
    """(code, an example) -> how many tasks failed so, the most frequent first."""
    count = Counter(code for code, _ in failed)
    example = dict(reversed(failed))
    return [((code, example[code]), n) for code, n in count.most_common()]
