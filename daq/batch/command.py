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
from .tables import MAX_FALSE_DISCOVERY_RATE, NOTHING_NAMED, Results
from .task import WINDOWS_TASK, Task, Windows

BATCH_MODULES = ("distributed", "fsspec", "pyarrow")
MOST_REASONS = 5  # that are shown; the table has them all
Row = dict[str, Any]


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
    """What the tables hold already, by the place of each task."""

    rows: dict[tuple[Any, ...], Row]
    only_failed: bool
    skipped: int = field(default=0, init=False)

    @classmethod
    def of(cls, runs: Sequence[Row], only_failed: bool) -> Known:
        return cls({(r["log"], r["rig"], r["task"], r["from_s"], r["window_s"]): r for r in runs}, only_failed)

    def row(self, task: Task) -> Row | None:
        """The row of a task as it is now asked for; None if it is to be done."""
        row = self.rows.get(task.place)
        return row if row is not None and row["key"] == task.key else None

    def settled(self, task: Task) -> bool:
        """Whether a task needs not be done."""
        there = self.rows.get(task.place)
        failed = there is not None and there["status"] != "done"
        if task.name == WINDOWS_TASK and self.only_failed and there is None:
            done = True
        else:
            done = not failed if self.only_failed else self.row(task) is not None
        self.skipped += done
        return done


def batch(output: Output, patterns: Sequence[str], out: Path, asked: Asked) -> None:
    """Analyse every log that the patterns name, and keep the answers as tables in `out`."""
    check_installed(BATCH_MODULES, "batch", "batch")
    begun = time.monotonic()
    logs = find_logs(patterns, asked.rig_source())
    with Results.opened(out) as results:
        known = Known.of(results.runs(), asked.only_failed)
        tasks = [task for task in _tasks(logs, asked, known) if not known.settled(task)]
        loop = _run(output, asked, results, known, tasks) if tasks else None
        _tell(output, asked, results, (len(logs), known.skipped, time.monotonic() - begun), loop)


def _tasks(logs: Sequence[LogSource], asked: Asked, known: Known) -> Iterator[Task]:
    """The tasks of all logs; of a log to be cut into windows, how long it is comes first."""
    for log in logs:
        whole = [Task(log=log, name=name, version=version()) for name in asked.names]
        if asked.windows is None:
            yield from whole
            continue
        cut = Task(log=log, name=WINDOWS_TASK, version=version(), seconds=asked.windows.length_s)
        row = known.row(cut)
        if row is not None and row["status"] == "done":
            yield from cut.windows(asked.windows, row["seconds"], asked.names)
        else:
            yield cut


def _run(output: Output, asked: Asked, results: Results, known: Known, tasks: list[Task]) -> Loop:
    """Do the tasks. What is done is in the tables, whatever ends it. Raises KeyboardInterrupt if the user does."""
    with Stop() as stop, connected(asked.scheduler) as client, output.progress("batch") as progress:
        loop = Loop(
            client=client, results=results, timeout_s=asked.timeout_s, windows=asked.windows, names=asked.names,
            settled=known.settled, progress=progress, stopped=stop.event.is_set,
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


def _tell(
    output: Output, asked: Asked, results: Results, counts: tuple[int, int, float], loop: Loop | None
) -> None:  # fmt: skip
    """What was done, for people and as JSON. Raises LogError if nothing came of anything."""
    logs, skipped, seconds = counts
    done, failed = (0, 0) if loop is None else (loop.done - loop.failed, loop.failed)
    rows = results.runs()
    bad = [row for row in rows if row["status"] != "done"]
    verdicts = results.verdicts()
    named = [v for v in verdicts if v["verdict"] not in NOTHING_NAMED]
    value: dict[str, Any] = {
        "schema": 1,
        "out": str(results.folder),
        "scheduler": asked.scheduler or "local",
        "logs": logs,
        "runs": {"done": done, "failed": failed, "already_there": skipped},
        "table": {"runs": len(rows), "failed": len(bad)},
        "reasons": [{"code": code, "count": n, "example": text} for (code, text), n in reasons(bad)],
        "verdicts": dict(Counter(v["verdict"] for v in verdicts).most_common()),
        "correction": {
            "method": "Benjamini-Hochberg",
            "records": len(verdicts),
            "false_discovery_rate": MAX_FALSE_DISCOVERY_RATE,
            "named": len(named),
            "stand": sum(bool(v["stands"]) for v in named),
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
    if rows and len(bad) == len(rows):
        raise LogError(f"{results.folder}: every task failed; the first reason: {reasons(bad)[0][0][1]}")


def reasons(failed: Sequence[Row]) -> list[tuple[tuple[str, str], int]]:
    """(code, an example) -> how many tasks failed so, the most frequent first."""
    count = Counter(row["code"] for row in failed)
    example = {row["code"]: row["reason"] for row in reversed(failed)}
    return [((code, example[code]), n) for code, n in count.most_common()]
