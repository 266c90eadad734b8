"""The body of the core loop for one device: it passes readings to sinks, ring and estimator in order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.clock import Clock, DeviceClock
from daq.base.contract.errors import ConfigError, LogError
from daq.base.contract.scaling import Scaling
from daq.base.contract.sink import Reporting, Session, Sink, Status
from daq.rig.units import UNITS_OF_KIND, canonical
from daq.trend.names import ALARM_CODE, ALARM_LEARNED_CODE, ALARM_OVER_CODE
from drivers.contract import Block, Gap, Info, LinkStats, Notice, Reading
from estimator.model import Model
from estimator.results import Estimate

from .estimation import Estimation
from .estimator_runner import BUSY_BLOCKS, EstimatorRunner
from .estimators import MakeEstimator
from .layer_watch import LAYER_CODES
from .ledger import Ledger
from .watch import Watch

STATUS_NS = 1_000_000_000
CLIPPED_EVERY_S = 10.0
STALE_S = 10.0  # to finish with the estimator of a rate that the device has left
NEW_CLOCK = ("restart", "reconnect")  # after such a gap, index and host time go together in a new way
# Codes of the pipeline's own notices; a replay makes them again, so they are not taken from the log.
OWN_CODES = frozenset(
    {"clipped", "no_estimate", "estimator_failed", "sink_failed", "channels_by_order", "stopped_behind"}
    | {"missing_force", "parameters_changed", "effect_named", "model_complete", "effect_unknown"}  # naming.py
    | {ALARM_CODE, ALARM_OVER_CODE, ALARM_LEARNED_CODE}
    | LAYER_CODES
)

LOG_LOST_CODES = ("log_incomplete", "log_failed", "log_cut")  # notices that say that the log does not hold everything


@dataclass(frozen=True, slots=True)
class Plan:
    """Settings of a session. model : of the rig; metadata, attachments : for its log; device : its name, "" if alone.

    make : makes its estimator; None: no estimates. rate_hz : expected sampling rate; None: any.
    limit_s : seconds of data; None: no limit. busy_blocks : that wait for the estimator at most.
    """

    model: Model
    make: MakeEstimator | None = None
    rate_hz: float | None = None
    device: str = ""
    _: KW_ONLY
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    limit_s: float | None = None
    busy_blocks: int = BUSY_BLOCKS


class Pipeline:
    """Pipeline of one device: `step` takes readings, `tick` does periodic work, `finish` ends it. One thread.

    Order of things: sinks get the raw readings, then the ring, then the estimator, then sinks its estimates. A sink
    that raises OSError is reported and kept; one that raises anything else is reported and left out from then on.

    wake : called from another thread when estimates wait for `tick`; with it the estimator has a separate thread, so
    that a long solution does not delay the log. The estimates are the same.
    """

    def __init__(
        self, plan: Plan, sinks: Iterable[Sink], clock: Clock, *,
        live: bool = True, notify: Callable[[Notice], None] | None = None, wake: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        self._plan = plan
        self._sinks = list(sinks)
        self._reporting = [s for s in self._sinks if isinstance(s, Reporting)]
        self._clock = clock
        self._live = live
        self._notify = notify
        self._wake = wake
        self._info: Info | None = None
        self._rate_since: tuple[int | None, float] = None, 0.0  # index of the last change of rate, seconds before it
        self._scaling: Scaling | None = None
        self._columns: list[int] = []  # signal of each channel of the model
        self._estimation: Estimation | None = None
        self._early: list[Reading] = []  # readings before the first description of the device
        self._notified_early: list[Notice] = []
        self._unsaid: list[Reading] = []
        self._reported: set[str] = set()
        self._status_ns = clock.now_ns()
        self._status_samples = 0
        self._clipped_until = -1
        self._watch = Watch(clock, self._say)
        self._lag_s: dict[str, float] = {}
        self.clipped = 0
        self.ledger = Ledger()
        self.device_clock: DeviceClock | None = None
        self.last_estimate: Estimate | None = None
        self.problems: list[str] = []
        self.lost_log = ""  # why the log does not hold everything
        self.dropped: dict[str, int] = {}  # in the end, by sink: samples that it has not taken
        self.pending = False  # whether a sink still has something to report, at its last status

    @property
    def done(self) -> bool:
        """Whether the requested time is over."""
        return self.ledger.full

    @property
    def busy(self) -> bool:
        """Whether the estimator is ten seconds behind, so that `step` should wait."""
        return self._estimation is not None and self._estimation.runner.busy

    @property
    def rate_hz(self) -> float | None:
        return self._info.rate_hz if self._info else None

    @property
    def seconds(self) -> float:
        """Seconds of data so far, gaps included."""
        since, seconds = self._rate_since
        start = self.ledger.first if since is None else since
        return seconds + (0 if start is None or not self._info else (self.ledger.stop - start) / self._info.rate_hz)

    # -- the three entries ----------------------------------------------------------------------------------------

    def step(self, readings: Sequence[Reading]) -> None:
        """Take readings in their order. Raises ConfigError if the device does not have the rig's channels."""
        batch: list[Reading] = []
        for reading in readings:
            if isinstance(reading, Info):
                batch = self._take(batch)
                self._introduce(reading)
            batch += self._accept(reading)
        self._take(batch)
        if self._info is not None:
            self._watch.rate_of_rig(readings)

    def tick(self, stats: LinkStats, dropped: Mapping[str, int], *, final: bool = False) -> None:
        """Called from time to time: ask the sinks, report what waits, and once a second give the status."""
        self._hear_sinks()
        self._watch.overflow(dropped.get("reader", 0), final)
        if self._live:
            self._watch.standstill()
            self._watch.losses(final)
        self._collect()
        self._take([])
        now = self._clock.now_ns()
        if self._info is None or not (final or now - self._status_ns >= STATUS_NS):
            return
        seconds, samples = (now - self._status_ns) / 1e9, self.ledger.samples
        rate = (samples - self._status_samples) / seconds if seconds > 0 else 0.0
        self._status_ns, self._status_samples = now, samples
        if self._live:
            self._watch.wall_clock()
        health = {type(s).__name__: s.health() for s in self._reporting}
        for report in health.values():
            self._unsaid += report.notices
        clock = self.device_clock.state() if self.device_clock else None
        if self._live and self.device_clock and self._plan.metadata.get("link_kind") != "virtual":  # at any speed
            self._watch.rate(self.device_clock, clock)
        status = Status(
            t_host_ns=now, index=self.ledger.stop, rate_hz=rate, link=replace(stats, other=dict(stats.other)),
            clock=clock,
            lag_s=self._lag_s | {name: h.lag_s for name, h in health.items()},
            dropped={**dropped, **{name: h.dropped for name, h in health.items()}, "clipped": self.clipped},
        )  # fmt: skip
        self._lag_s = {}
        self._each_sink("status", lambda sink: sink.status(status))

    def finish(self, stats: LinkStats, dropped: Mapping[str, int], estimator_s: float = 10.0) -> None:
        """Give the last estimate and status, and close every sink, even if others fail.

        The pipeline waits at most `estimator_s` for the estimator.
        """
        try:
            if self._estimation is not None:
                if not self._estimation.finish(estimator_s):
                    text = "the last samples before the stop are in the log, but not in the last estimate"
                    self._say("warning", "stopped_behind", text)
                self._collect()
            if self._info is None:
                self._introduce(Info((), self._plan.rate_hz or 1.0))
            self.tick(stats, dropped, final=True)
        finally:
            self._each_sink("close", lambda sink: sink.close())
        self._hear_sinks()
        for reading in self._unsaid:  # too late for the log, not for the operator
            self._one(reading)
        self._unsaid = []

    # -- readings -------------------------------------------------------------------------------------------------

    def _accept(self, reading: Reading) -> list[Reading]:
        if self._info is None and not isinstance(reading, Info):
            self._early.append(reading)
            if isinstance(reading, Notice):  # the log waits for the description of the device, the operator does not
                self._notify_operator(reading)
                self._notified_early.append(reading)
                self._watch.warned(reading)
            return []
        return self.ledger.accept(reading)

    def _take(self, batch: list[Reading]) -> list[Reading]:
        """Give raw readings to the sinks first, then process them. Returns an empty batch."""
        if self._info is not None and (batch or self._unsaid):
            said, self._unsaid = self._unsaid, []
            whole = [*said, *batch]
            self._each_sink("readings", lambda sink: sink.readings(whole))
            for reading in whole:
                self._one(reading)
        return []

    def _one(self, reading: Reading) -> None:
        if isinstance(reading, Block):
            self._block(reading)
        elif isinstance(reading, Gap):
            if self.device_clock is not None and reading.reason in NEW_CLOCK:
                self.device_clock.restart()
            if reading.count:
                self._watch.lost(reading)
                self._estimator_at(reading.index).skip(reading.count)
                self._collect()
        elif isinstance(reading, Notice):
            if reading in self._notified_early:
                self._notified_early.remove(reading)
            else:
                self._notify_operator(reading)

    def _notify_operator(self, notice: Notice) -> None:
        if notice.level == "error":
            self.problems.append(notice.text)
        if notice.code in LOG_LOST_CODES:
            self.lost_log = notice.text
        if self._notify is not None:
            self._notify(notice)

    def _block(self, block: Block) -> None:
        estimation = self._estimator_at(block.index)
        if self._scaling is None or self.device_clock is None:
            return
        stop = block.index + len(block.counts)
        self.device_clock.feed(stop, block.t_host_ns, len(block.counts))
        counts = self._scaling.select(block.counts)
        rows = self._scaling.si(counts)
        clipped = self._scaling.clipped(counts)
        if clipped is not None:
            rows[clipped] = np.nan
            self._say_clipped(block.index, clipped)
        if self._live:
            self._lag("core", block.t_host_ns)
        estimation.append(rows, block.t_host_ns)
        self._collect()

    def _collect(self) -> None:
        """Give the sinks the estimates that are ready."""
        runner = self._estimation.runner if self._estimation else None
        if runner is None:
            return
        for answer in runner.take():
            self.last_estimate = answer.estimate
            self._each_sink("estimate", partial(_give, estimate=answer.estimate))
            if self._live and answer.stamp:
                self._lag("estimate", answer.stamp)
        if runner.failure is not None and "estimator" not in self._reported:
            self._reported.add("estimator")
            text = f"the estimator has stopped: {runner.failure!r}; acquisition goes on"
            self._say("error", "estimator_failed", text)

    # -- what the device is ---------------------------------------------------------------------------------------

    def _introduce(self, info: Info) -> None:
        """Take a description of the device, the first or a changed one."""
        if info == self._info:
            return
        first, before, seconds = self._info is None, self._info, self.seconds
        self._info = info
        if info.signals:
            self._columns = self._columns_of(info)
            self._scaling = Scaling(info, self._columns)
        if before is None or (before.rate_hz, len(before.signals)) != (info.rate_hz, len(info.signals)):
            if self._estimation is not None:
                self._estimation.runner.close(STALE_S)
                self._collect()
                self._estimation = None
            self.device_clock = DeviceClock(info.rate_hz)
            if before is not None:
                self._rate_since = (self.ledger.stop if self.ledger.first is not None else None), seconds
            limit_s = self._plan.limit_s
            if limit_s is not None:
                self.ledger.limit_to(round((limit_s - self._rate_since[1]) * info.rate_hz))
        self._watch.introduced(info.rate_hz, self._plan.rate_hz)
        if first:
            self._watch.begin()
            plan = self._plan
            session = Session(
                model=plan.model, info=info, device=plan.device, attachments=plan.attachments, metadata=plan.metadata
            )
            self._each_sink("start", lambda sink: sink.start(session))
            early, self._early = self._early, []
            self._take([r for reading in early for r in self.ledger.accept(reading)])

    def _columns_of(self, info: Info) -> list[int]:
        """Signal of each channel of the model: by name, or else in order if the numbers are equal."""
        names = [s.name for s in info.signals]
        wanted = [c.name for c in self._plan.model.channels]
        if all(name in names for name in wanted):
            return [names.index(name) for name in wanted]
        if len(names) == len(wanted):
            text = f"channel names differ: the device's {', '.join(names)} are taken as {', '.join(wanted)} in order"
            self._say("warning", "channels_by_order", text)
            return list(range(len(names)))
        missing = ", ".join(name for name in wanted if name not in names)
        raise ConfigError(
            f"the device sends {', '.join(names)}, not the rig's channel {missing}; "
            "name the channels in the rig file as the device does, or map them in [link.signals]"
        )

    def _other_quantity(self) -> str:
        """The channel whose quantity differs from the rig file; its samples are logged, but not estimated from."""
        signals = self._info.signals if self._info else ()
        for channel, column in zip(self._plan.model.channels, self._columns, strict=False):
            unit = signals[column].unit
            if unit and UNITS_OF_KIND[channel.kind].get(canonical(unit)) != 1.0:
                text = f"{channel.name} comes in {unit}, and is {channel.kind} in the rig file"
                return f"{text}; correct kind or unit of the channel, then replay or fit the log"
        return ""

    def _estimator_at(self, index: int) -> Estimation:
        """The estimation under way, or a new one whose first row is `index`."""
        if self._estimation is None:
            rate_hz = self._info.rate_hz if self._info else 1.0
            estimator, wrong = None, self._other_quantity()
            if wrong:
                self._say("error", "no_estimate", f"no rolling estimate: {wrong}")
            elif self._plan.make is not None:
                try:
                    estimator = self._plan.make(self._plan.model, rate_hz)
                except ValueError as error:
                    self._say("warning", "no_estimate", f"no rolling estimate: {error}")
            runner = EstimatorRunner(estimator, self._wake, self._plan.busy_blocks)
            self._estimation = Estimation(runner, len(self._plan.model.channels), rate_hz, index)
        return self._estimation

    # -- saying things --------------------------------------------------------------------------------------------

    def _say(self, level: str, code: str, text: str) -> None:
        """Give a notice to the sinks with the next readings, and to the operator."""
        self._unsaid.append(Notice(self._clock.now_ns(), level, code, text))

    def _say_clipped(self, index: int, clipped: NDArray[np.bool_]) -> None:
        self.clipped += int(clipped.sum())
        if index < self._clipped_until or self._info is None:
            return
        self._clipped_until = index + int(CLIPPED_EVERY_S * self._info.rate_hz)
        names = [c.name for c, column in zip(self._plan.model.channels, clipped.T, strict=True) if column.any()]
        text = f"{', '.join(names)} at full scale near sample {index}: left out of the estimate; use a larger range"
        self._say("warning", "clipped", text)

    def _lag(self, stage: str, since_ns: int) -> None:
        """Keep the largest lag of a stage since the last status."""
        self._lag_s[stage] = max(self._lag_s.get(stage, 0.0), (self._clock.now_ns() - since_ns) / 1e9)

    def _hear_sinks(self) -> None:
        self.pending = False
        for sink in self._reporting:
            health = sink.health()
            self.pending |= health.pending
            self._unsaid += health.notices
            self.dropped[type(sink).__name__] = health.dropped

    def _each_sink(self, what: str, call: Callable[[Sink], None]) -> None:
        for sink in list(self._sinks):
            try:
                call(sink)
            except OSError as error:
                self._report(sink, f"{what}: {error.strerror or error}; it is tried again")
            except Exception as error:  # a defect of a sink must not stop acquisition
                self._sinks.remove(sink)
                self._reporting = [other for other in self._reporting if other is not sink]
                if isinstance(error, LogError) and not self._live and what != "close":
                    raise  # nobody is acquiring: without its log there is no point in going on
                if isinstance(sink, Reporting):
                    self._unsaid += sink.health().notices
                if not isinstance(error, LogError):  # which has been reported
                    self._report(sink, f"{what}: {error!r}; it is left out from now on")

    def _report(self, sink: Sink, problem: str) -> None:
        text = f"{type(sink).__name__} failed at {problem}"
        if text not in self._reported:
            self._reported.add(text)
            self._say("error", "sink_failed", text)


def _give(sink: Sink, estimate: Estimate) -> None:
    sink.estimate(estimate)
