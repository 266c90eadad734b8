"""The loop of a batch: tasks go to Dask, rows come back and are stored, until nothing is left or the user stops it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any

from daq.base.console.output import Progress, quiet_progress
from drivers.contract import LinkError

from .tables import Results
from .task import WINDOWS_TASK, Task, Windows
from .work import STARTED_TOPIC, answer

TICK_S = 0.5  # between two looks at what is overdue
STORE_S, STORE_SHARE, STORE_ROWS = 2.0, 0.01, 500  # what is done is stored so often, or after a share of the time
MERGED_ROWS = 20_000  # what lies in pieces at most: a merge of more would need more memory
IN_FLIGHT_PER_CORE, LEAST_IN_FLIGHT = 20, 50  # tasks that the scheduler holds: enough for its workers never to wait
COUNT_S = 5.0  # between two counts of the workers
RESTART_S = 20  # for a worker that is ended over a task
DEAD_TEXT = "ended its worker each time, most likely for want of memory: give --window, or larger workers"


@dataclass(kw_only=True)
class Loop:
    """Runs the tasks of a batch. client : of Dask. timeout_s : of a task; None for none. windows, names : of a log.

    settled : whether a task needs not be done. stopped : whether the user has asked to stop. note : receives remarks.
    """

    client: Any
    results: Results
    timeout_s: float | None = None
    windows: Windows | None = None
    names: list[str] = field(default_factory=list)
    settled: Callable[[Task], bool] = lambda task: False
    progress: Progress = quiet_progress
    stopped: Callable[[], bool] = lambda: False
    note: Callable[[str], None] = lambda text: None

    def __post_init__(self) -> None:
        self._todo: deque[Task] = deque()
        self._flying: dict[Any, Task] = {}
        self._finished: SimpleQueue[Any] = SimpleQueue()
        self._started: dict[str, tuple[float, str]] = {}  # key -> time and worker
        self._rows: list[dict[str, Any]] = []
        self._stored_s = self._started_s = time.monotonic()
        self._counted_s, self._most, self._had_cores = -COUNT_S, LEAST_IN_FLIGHT, True
        self.total = self.done = self.failed = self._pending = 0

    def run(self, tasks: Iterable[Task]) -> None:
        """Do all tasks. Finished tasks are stored, however the run ends.

        Raises LinkError if the scheduler is gone, LogError if results cannot be stored.
        """
        self.more(tasks)
        self.client.subscribe_topic(STARTED_TOPIC, self._on_start)
        try:
            while (self._todo or self._flying) and not self.stopped():
                self._submit()
                self._take()
                self._end_overdue()
                self._store()
        finally:
            self._store(now=True)

    def more(self, tasks: Iterable[Task]) -> None:
        """Add further tasks."""
        new = [task for task in tasks if not self.settled(task)]
        self._todo.extend(new)
        self.total += len(new)

    def _submit(self) -> None:
        if time.monotonic() > self._counted_s + COUNT_S:  # workers come and go
            self._counted_s = time.monotonic()
            cores = sum(self.client.nthreads().values())
            self._most = max(LEAST_IN_FLIGHT, IN_FLIGHT_PER_CORE * cores)
            if not cores and self._had_cores:
                self.note("no worker is left: waiting for one; Ctrl-C ends, and keeps what is done")
            self._had_cores = cores > 0
        while self._todo and len(self._flying) < self._most:
            task = self._todo.popleft()
            if task.log.rig.problem:
                self._keep(answer(task), task)
                continue
            future = self.client.submit(answer, task, pure=False)
            self._flying[future] = task
            future.add_done_callback(self._finished.put)

    def _take(self) -> None:
        """Take the rows of finished tasks, after a short wait for the first one."""
        ended: dict[Any, Task] = {}
        wait = TICK_S if self._flying else 0.0
        while self._flying:
            try:
                future = self._finished.get(timeout=wait)
            except Empty:
                break
            wait = 0.0
            if (task := self._flying.pop(future, None)) is not None:
                self._started.pop(task.key, None)
                ended[future] = task
        self._look_for_scheduler()
        whole = [future for future in ended if future.status == "finished"]
        for future, row in zip(whole, self._gathered(whole), strict=True):  # in one question: each takes its time
            self._keep(row, ended.pop(future))
        for future, task in ended.items():
            if future.status == "lost":  # with the worker that held it, which another task had to end
                self._todo.append(task)
            else:
                self._keep(self._lost(task, future), task)
        self._report_progress()

    def _gathered(self, futures: list[Any]) -> list[dict[str, Any]]:
        from concurrent.futures import CancelledError

        try:
            return list(self.client.gather(futures)) if futures else []
        except CancelledError as error:
            raise self._gone() from error

    def _lost(self, task: Task, future: Any) -> dict[str, Any]:
        """The row of a task that has no result. Raises LinkError if the scheduler is gone."""
        if future.status == "cancelled":
            raise self._gone()
        from distributed.scheduler import KilledWorker

        error = future.exception()
        if isinstance(error, KilledWorker):
            return failed(task, "worker", f"{task.log.url}: {task.name} {DEAD_TEXT}")
        return failed(task, "worker", f"{task.log.url}: the worker cannot do it: {type(error).__name__}: {error}")

    def _keep(self, row: dict[str, Any], task: Task) -> None:
        self._rows.append(row)
        if task.name == WINDOWS_TASK and row["status"] == "done" and self.windows is not None:
            self.more(task.windows(self.windows, row["seconds"], self.names))
        self.done += 1
        self.failed += row["status"] != "done"

    def _on_start(self, event: tuple[float, Mapping[str, Any]]) -> None:
        said = event[1]
        self._started[said["key"]] = time.monotonic(), said["worker"]

    def _end_overdue(self) -> None:
        """End the workers of tasks that take too long; their nannies start them again."""
        if self.timeout_s is None:
            return
        for future, task in list(self._flying.items()):
            since, worker = self._started.get(task.key, (None, ""))
            if since is None or time.monotonic() - since < self.timeout_s or future.done():
                continue
            del self._flying[future]
            text = f"{task.log.url}: {task.name} takes longer than --timeout {self.timeout_s:g} s"
            self._keep(failed(task, "time", text), task)
            self.client.cancel([future], force=True)
            with suppress(Exception):  # a worker without a nanny goes on with it
                self.client.restart_workers([worker], timeout=RESTART_S, raise_for_error=False)

    def _look_for_scheduler(self) -> None:
        if self.client.status not in ("running", "connecting") or self.client.scheduler.comm is None:
            raise self._gone()

    def _gone(self) -> LinkError:
        return LinkError(
            f"the scheduler is gone: {self.done} of {self.total} are kept; start it, and type the same command again"
        )

    def _store(self, now: bool = False) -> None:
        """Store the rows that have come, now and then."""
        now_s = time.monotonic()
        wait_s = max(STORE_S, STORE_SHARE * (now_s - self._started_s))
        due = len(self._rows) >= STORE_ROWS or now_s - self._stored_s >= wait_s
        if not self._rows or not (now or due):
            return
        rows, self._rows = self._rows, []
        self._stored_s = now_s
        self.results.add(rows)
        self._pending += len(rows)
        if self._pending >= MERGED_ROWS:
            self.results.merge()
            self._pending = 0

    def _report_progress(self) -> None:
        spent = time.monotonic() - self._started_s
        rate = self.done / spent if spent else 0.0
        text = f"{self.done} of {self.total}"
        if self.done:
            text += f", {rate_text(rate)}, {time_text((self.total - self.done) / rate)} left"
        if self.failed:
            text += f", {self.failed} failed"
        self.progress(self.done / max(1, self.total), text)


def failed(task: Task, code: str, reason: str) -> dict[str, Any]:
    """The row of a task that no worker finished."""
    return task.row() | {
        "status": "failed", "code": code, "reason": reason, "notes": [], "rows": {}, "run_at": time.time(),
    }  # fmt: skip


def rate_text(per_second: float) -> str:
    """A rate in the unit that has a figure before the point."""
    for factor, unit in ((1.0, "second"), (60.0, "minute")):
        if per_second * factor >= 1.0:
            return f"{per_second * factor:.3g} a {unit}"
    return f"{per_second * 3600.0:.2g} an hour"


def time_text(seconds: float) -> str:
    """A length of time for people."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
