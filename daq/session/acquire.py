"""A session from the opening of a link to the closing of its log; several sessions run independently."""

from __future__ import annotations

import contextlib
import gc
import platform
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

from daq.base.console.memory import keep_freed
from daq.base.contract.clock import Clock, SystemClock
from daq.base.contract.sink import Sink
from daq.rig.rig import Rig
from drivers.contract import Driver, Gap, LinkStats, Notice
from estimator.results import Estimate

from .estimation import block_rows
from .estimator_runner import BUSY_BLOCKS
from .estimators import MakeEstimator, maker, warm_up
from .pipeline import Pipeline, Plan
from .reading_queue import QUEUE_BYTES, ReadingQueue

FINITE_KINDS = ("capture", "replay", "simulated")  # kinds of link that wait for the reader; all others are live
RECORDED_KINDS = ("capture", "replay")  # of those, the recorded ones
READ_S = 0.1
LINK_S = 0.5  # a closed link wakes its reader within this time
GRACE_S = 2.0  # a live link may take this much longer than the seconds asked for, from its first sample on
OPEN_S = 0.05  # interval of the check for a stop while the link is opened
STOP_S = 0.6  # after a stop, this long for the reader to end, and for the estimator to finish
ESTIMATOR_S = 10.0  # at the end of the seconds or of the source, this long
ANSWER_S = 30.0  # and this long for a diagnosis that is under way, unless stopped
BUSY_S = 0.01
LOG_SINKS = ("LogWriter", "SegmentedLog")  # names of the sinks that store samples
LOGGED_VERSIONS = ("rotorscope", "numpy", "scipy", "numba", "mcap", "protobuf")

Notify = Callable[[Notice], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary:
    """The result of a session.

    seconds : of data, gaps included.
    samples, lost_samples : of each channel.
    gaps : where samples are missing, in order.
    kind : of the link ("can", "serial", "virtual", "replay", ...).
    stats : counters of the link.
    last_estimate : None if the session was too short for one, or the rig file allows none.
    clipped : values at full scale, which are left out of the estimate.
    problems : what an operator must know, one line each.
    device : name of the device in a service with several, else "".
    identical : of a replay with `check`, whether the estimates equal the logged ones bit for bit; else None.
    compared : of a replay with `check`, the number of estimates that were compared.
    not_logged : samples that were acquired, and are not in the log because its disk failed.
    lost_log : why the log is worthless or incomplete, one line; "" if it is not.
    """

    seconds: float
    samples: int
    lost_samples: int
    gaps: tuple[Gap, ...]
    kind: str
    stats: LinkStats
    last_estimate: Estimate | None
    clipped: int = 0
    problems: tuple[str, ...] = ()
    device: str = ""
    identical: bool | None = None
    compared: int = 0
    not_logged: int = 0
    lost_log: str = ""

    def to_json(self) -> dict[str, Any]:
        """As schemas/run.json."""
        s = self.stats
        counters = ("frames", "bytes", "crc_errors", "resyncs", "reconnects", "restarts", "duplicates")
        link: dict[str, Any] = {"kind": self.kind} | {name: getattr(s, name) for name in counters} | {"other": s.other}
        estimate = self.last_estimate
        out: dict[str, Any] = {
            "schema": 1,
            "seconds": self.seconds,
            "samples": self.samples,
            "lost_samples": self.lost_samples,
            "gaps": [{"index": g.index, "count": g.count, "reason": g.reason} for g in self.gaps],
            "not_logged": self.not_logged,
            "clipped_values": self.clipped,
            "link": link,
            "estimates": {n: p.to_json() for n, p in estimate.parameters.items()} if estimate else {},
            "estimate_status": estimate.status if estimate else "no estimate",
            "problems": list(self.problems),
        }
        if self.device:
            out["device"] = self.device
        if self.identical is not None:
            out |= {"identical": self.identical, "estimates_compared": self.compared}
        return out


def acquire_from(
    rig: Rig, driver: Driver, sinks: Sequence[Sink], seconds: float | None = None, stop: threading.Event | None = None,
    *, device: str = "", metadata: Mapping[str, str] | None = None, notify: Notify | None = None,
    clock: Clock | None = None, make: MakeEstimator | None = None,
    grace_s: float = GRACE_S, queue_bytes: int = QUEUE_BYTES, busy_blocks: int = BUSY_BLOCKS,
) -> RunSummary:  # fmt: skip
    """Acquire until `seconds` of data have come, the source ends or `stop` is set. Sinks are closed in any case.

    device : name of the device in a service with several. metadata : into the log, beside versions and link kind.
    notify : called from this thread with everything an operator should read. make : instead of the rig's estimator.
    grace_s : a live link may take this much longer than `seconds`. queue_bytes : of readings between the reader of the
    link and this thread. busy_blocks : that may wait for the estimator.
    Raises LinkError if the link cannot be opened, ConfigError if it does not have the rig's channels, and whatever a
    driver raised against its contract, after the sinks are closed.
    """
    keep_freed()  # with a heap for each thread, their free memory grows for hours
    clock, stop = clock or SystemClock(), stop or threading.Event()
    live = driver.kind not in FINITE_KINDS
    make = make or maker(rig.estimator.method, rig.estimator.time_constant_s, rig.estimator.watch)
    rate_hz = rig.acquisition.rate_hz if rig.acquisition else None
    about = _about(driver, clock) | dict(metadata or {})
    plan = Plan(
        rig.model,
        make,
        rate_hz,
        device=device,
        attachments=rig.attachments(),
        metadata=about,
        limit_s=seconds,
        busy_blocks=busy_blocks,
    )
    queue = ReadingQueue(queue_bytes, live)
    pipeline = Pipeline(plan, sinks, clock, live=live, notify=notify, wake=queue.wake if live else None)
    core = _Core(
        driver=driver,
        queue=queue,
        pipeline=pipeline,
        clock=clock,
        stop=stop,
        seconds=seconds,
        live=live,
        grace_s=grace_s,
    )
    try:
        if live:
            _open_unless_stopped(driver, stop, lambda: _warm_up(make, rig, rate_hz))
        else:
            driver.open()
        core.follow()
        core.take_rest()
        core.wait_for_diagnosis()
    finally:
        pipeline.finish(driver.stats, {"reader": queue.dropped}, STOP_S if stop.is_set() else ESTIMATOR_S)
    return _summary(pipeline, driver, device)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Core:
    """The core loop of one device, which the thread of the caller runs, and the thread that reads its link."""

    driver: Driver
    queue: ReadingQueue
    pipeline: Pipeline
    clock: Clock
    stop: threading.Event
    seconds: float | None  # of data to acquire; None: until the source ends or `stop` is set
    live: bool  # the device does not wait for the reader
    grace_s: float

    def follow(self) -> None:
        """Step the pipeline with what the link delivers, until the end; then close the link."""
        reader = threading.Thread(
            target=_read, args=(self.driver, self.queue, self.stop), name=f"read {self.driver.kind}", daemon=True
        )
        reader.start()
        begin_ns, flowing = self.clock.now_ns(), False
        try:
            while not (self.stop.is_set() or self.pipeline.done or self.queue.ended):
                if self.pipeline.busy:
                    self.stop.wait(BUSY_S)
                else:
                    self.pipeline.step(self.queue.take(READ_S))
                self._tick()
                if not flowing and self.pipeline.ledger.first is not None:
                    begin_ns, flowing = self.clock.now_ns(), True
                if self._late(begin_ns):
                    if flowing and self.seconds is not None:
                        self.pipeline.step([_short(self.pipeline, self.seconds, self.grace_s, self.clock)])
                    break
        finally:
            self.queue.close()
            self.driver.close()
            reader.join(STOP_S)

    def take_rest(self) -> None:
        """Log the readings that came before the stop; a file can be read again."""
        while not self.pipeline.done and (self.live or not self.stop.is_set()) and (rest := self.queue.take(0.0)):
            self.pipeline.step(rest)

    def wait_for_diagnosis(self) -> None:
        """Wait for the diagnosis of a sink that is under way."""
        until_ns = self.clock.now_ns() + ANSWER_S * 1e9
        self._tick()
        while self.pipeline.pending and not self.stop.is_set() and self.clock.now_ns() < until_ns:
            self.stop.wait(READ_S)
            self._tick()

    def _tick(self) -> None:
        self.pipeline.tick(self.driver.stats, {"reader": self.queue.dropped})

    def _late(self, begin_ns: int) -> bool:
        """Whether a live link has taken longer than the seconds asked for, and the grace."""
        limited = self.live and self.seconds is not None
        return limited and self.clock.now_ns() > begin_ns + ((self.seconds or 0.0) + self.grace_s) * 1e9


def _short(pipeline: Pipeline, seconds: float, grace_s: float, clock: Clock) -> Notice:
    text = f"{pipeline.seconds:.4g} s of data came in {seconds + grace_s:g} s, where {seconds:g} s were asked for"
    return Notice(clock.now_ns(), "warning", "short", f"{text}: the run ends here; is the device silent, or too slow?")


def _read(driver: Driver, queue: ReadingQueue, stop: threading.Event) -> None:
    """The reader thread."""
    failure: BaseException | None = None
    try:
        while queue.open and not stop.is_set():
            readings = driver.read(LINK_S)
            if readings:
                queue.put(readings)
            elif driver.exhausted:
                break
        driver.close()
        queue.put(driver.read(0.0))  # samples that were held
    except BaseException as error:  # raised again in the core loop
        failure = error
    queue.end(failure)


def _open_unless_stopped(driver: Driver, stop: threading.Event, before: Callable[[], None]) -> None:
    """Open the link in a thread, after `before`: a host that does not answer must not delay a stop."""
    failures: list[BaseException] = []
    left, done = threading.Event(), threading.Event()

    def begin() -> None:
        try:
            before()
            if not left.is_set():
                driver.open()
        except BaseException as error:  # raised again below
            failures.append(error)
        done.set()
        if left.is_set():
            driver.close()

    threading.Thread(target=begin, name=f"open {driver.kind}", daemon=True).start()
    while not done.wait(OPEN_S):
        if stop.is_set():
            left.set()
            return
    if failures:
        raise failures[0]


def _warm_up(make: MakeEstimator, rig: Rig, rate_hz: float | None) -> None:
    """Compile and load before a live session what would delay it later."""
    with contextlib.suppress(ValueError):  # the pipeline meets it again, and says so
        if rate_hz:
            warm_up(make, rig.model, rate_hz, block_rows(rate_hz))
    gc.freeze()  # to go through all that is loaded by now holds every thread for 0.1 s


def _about(driver: Driver, clock: Clock) -> dict[str, str]:
    started = datetime.fromtimestamp((clock.now_ns() + clock.wall_offset_ns()) / 1e9, UTC)
    versions = {name: version(name) for name in LOGGED_VERSIONS}
    return versions | {
        "python": platform.python_version(), "link_kind": driver.kind, "started": started.isoformat(timespec="seconds"),
    }  # fmt: skip


def _summary(pipeline: Pipeline, driver: Driver, device: str) -> RunSummary:
    ledger = pipeline.ledger
    return RunSummary(
        seconds=pipeline.seconds, samples=ledger.samples, lost_samples=ledger.lost, gaps=tuple(ledger.gaps),
        kind=driver.kind, stats=driver.stats, last_estimate=pipeline.last_estimate, clipped=pipeline.clipped,
        problems=tuple(pipeline.problems), device=device,
        not_logged=sum(pipeline.dropped.get(sink, 0) for sink in LOG_SINKS),
        lost_log=pipeline.lost_log,
    )  # fmt: skip


@dataclass(frozen=True)
class Device:
    """One of several devices of a service.

    name : of the device, in messages and metrics.
    rig : its rig file.
    driver : its link, constructed and not opened.
    sinks : where its samples and estimates go; they are closed at the end.
    metadata : into its log, beside versions and link kind.
    """

    name: str
    rig: Rig
    driver: Driver
    sinks: Sequence[Sink]
    _: KW_ONLY
    metadata: Mapping[str, str] = field(default_factory=dict)


def acquire_all(
    devices: Sequence[Device], seconds: float | None = None, stop: threading.Event | None = None,
    *, notify: Callable[[str, Notice], None] | None = None, make: MakeEstimator | None = None,
) -> dict[str, RunSummary | Exception]:  # fmt: skip
    """Outcome of each device by its name. Each device has a separate core loop, so that none waits for another.

    An exception is the outcome of its device, and ends no other.
    """
    outcome: dict[str, RunSummary | Exception] = {}
    stop = stop or threading.Event()

    def run(device: Device) -> None:
        report = None if notify is None else lambda notice: notify(device.name, notice)
        try:
            outcome[device.name] = acquire_from(
                device.rig, device.driver, device.sinks, seconds, stop,
                device=device.name, metadata=device.metadata, notify=report, make=make,
            )  # fmt: skip
        except Exception as error:
            outcome[device.name] = error
            if report is not None:
                report(Notice(SystemClock().now_ns(), "error", "device_failed", str(error) or repr(error)))

    threads = [threading.Thread(target=run, args=(d,), name=f"core {d.name}", daemon=True) for d in devices]
    for thread in threads:
        thread.start()
    for thread in threads:
        while thread.is_alive():  # with a timeout, so that a signal handler gets its turn
            thread.join(READ_S)
    return outcome
