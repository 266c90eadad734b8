"""The sink of the trend: each minute estimates, severity, tones and strikes; gaps, warnings and alarms as they come."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from daq.base.contract.clock import Clock, SystemClock
from daq.base.contract.sink import Session, SinkHealth, Status
from daq.report.layers import tone_name
from drivers.contract import Block, Gap, Info, Notice, Reading
from estimator.model import MachineClass
from estimator.results import MISSING_FORCE_KEY, Estimate

from .alarms.watch import AlarmState
from .chores import Chores
from .days import DayWriter, Row

TREND_EVERY_S = 60.0  # of data
CLOSE_S = 20.0  # for the last rows and the file of the day
NOTED_LEVELS = ("warning", "error")
NOTED_CODES = frozenset({"log_removed"})  # remarks that the trend keeps as well
LEVEL_NAMES = ("velocity_rms_mm_s", "displacement_rms_um", "rms", "peak", "crest", "kurtosis")
UNIT_OF_LEVEL = {"velocity_rms_mm_s": "mm/s", "displacement_rms_um": "um", "crest": "1", "kurtosis": "1"}

Json = Mapping[str, Any]


class TrendStore:
    """A sink. It computes nothing per sample, and a separate thread writes to the disk.

    folder : of the trend. live : a disk that stalls must not delay acquisition. wall_offset_ns : Unix time minus
    host time of the readings where they are not of now.
    """

    def __init__(
        self, folder: Path, *, live: bool = True, clock: Clock | None = None, wall_offset_ns: int | None = None,
        every_s: float = TREND_EVERY_S,
    ) -> None:  # fmt: skip
        self._folder = folder
        self._clock: Clock = clock or SystemClock()
        self._live, self._offset_ns, self._every_ns = live, wall_offset_ns, round(every_s * 1e9)
        self._notices: deque[Notice] = deque()
        self._said: set[str] = set()
        self._writer: DayWriter | None = None
        self._rate_hz = 1.0
        self._stop = self._now_ns = 0
        self._due_ns: int | None = None
        self._estimate: Estimate | None = None
        self._layers: deque[tuple[int, Json]] = deque(maxlen=1000)
        self._lost: Counter[str] = Counter()
        self._rows: list[Row] = []
        self._limits: MachineClass | None = None  # not known yet
        self._chores = Chores("trend", self._failed)

    def start(self, session: Session) -> None:
        self._rate_hz, self._limits = session.info.rate_hz, session.model.iso20816

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Block):
                self._block(reading)
            elif isinstance(reading, Gap):
                self._lost[reading.reason] += reading.count
            elif isinstance(reading, Info):
                self._rate_hz = reading.rate_hz
            elif reading.level in NOTED_LEVELS or reading.code in NOTED_CODES:
                text = (reading.text.splitlines() or [""])[0]
                self._rows.append(
                    Row(self._now_ns or self._host_ns(reading.t_host_ns), "notice", reading.code, text=text)
                )

    def estimate(self, estimate: Estimate) -> None:
        """Take the last estimate of each minute of data: in a fast replay many come at once."""
        before, self._estimate = self._estimate, estimate
        if before is not None and self._time_ns(before) // self._every_ns != self._time_ns(estimate) // self._every_ns:
            self._rows += estimate_rows(before, self._time_ns(before))

    def layers(self, stop: int, seen: Json) -> None:
        """Take the layers of a diagnosis of the samples before `stop`; called from any thread."""
        self._layers.append((stop, seen))

    def alarm(self, state: AlarmState) -> None:
        """Take the new state of an alarm."""
        if state.since_ns:
            kind = "alarm_raised" if state.state == "alarm" else "alarm_over"
            own = {"value": state.value, "sd": state.sd, "unit": state.unit, "text": state.text}
            self._rows.append(Row(state.since_ns, kind, state.what, **own))  # type: ignore[arg-type]

    def status(self, status: Status) -> None:
        """Write alarms and warnings once a second, without waiting for the minute."""
        rows, self._rows = self._rows, []
        self._hand_on(rows)

    def health(self) -> SinkHealth:
        return SinkHealth.of_notices(self._notices)

    def close(self) -> None:
        if self._estimate is not None:
            self._rows += estimate_rows(self._estimate, self._time_ns(self._estimate))
        self._collect()
        self._chores.put(self._end)
        self._chores.close(CLOSE_S if self._live else None)

    # -- the rest is private ----------------------------------------------------------------------------------------

    def _of_index(self, index: int) -> int:
        """Unix time of a sample."""
        return max(0, self._now_ns - round((self._stop - 1 - index) * 1e9 / self._rate_hz))

    def _time_ns(self, estimate: Estimate) -> int:
        return self._of_index(estimate.index)

    def _host_ns(self, t_host_ns: int) -> int:
        return max(0, t_host_ns + (self._clock.wall_offset_ns() if self._offset_ns is None else self._offset_ns))

    def _block(self, block: Block) -> None:
        self._stop, self._now_ns = block.index + len(block.counts), self._host_ns(block.t_host_ns)
        if self._due_ns is None:
            self._due_ns = (self._now_ns // self._every_ns + 1) * self._every_ns
        if self._now_ns >= self._due_ns:
            self._due_ns = (self._now_ns // self._every_ns + 1) * self._every_ns
            self._collect()

    def _collect(self) -> None:
        """Give the rows since the last call to the writing thread."""
        rows, self._rows = self._rows, []
        rows += zone_rows(self._limits, self._now_ns)
        self._limits = None
        minutes: dict[int, list[tuple[int, Json]]] = {}
        while self._layers:
            stop, seen = self._layers.popleft()
            time_ns = self._of_index(stop - 1)
            minutes.setdefault(time_ns // self._every_ns, []).append((time_ns, seen))
        for own in minutes.values():
            rows += layer_rows([seen for _, seen in own], own[-1][0])
        rows += [Row(self._now_ns, "gap", reason, float(n), unit="samples") for reason, n in self._lost.items() if n]
        self._lost.clear()
        self._hand_on(rows)

    def _hand_on(self, rows: list[Row]) -> None:
        if rows and not self._chores.put(partial(self._append, rows)):
            self._say_once("the disk stalls: rows of the trend are lost")
        if rows and not self._live:
            self._chores.wait()

    def _append(self, rows: list[Row]) -> None:
        if self._writer is None:
            self._writer = DayWriter(self._folder)
        self._writer.append(rows)
        self._said.clear()

    def _end(self) -> None:
        if self._writer is not None:
            self._writer.append([])
            self._writer.end_day()

    def _failed(self, error: Exception) -> None:
        text = (error.strerror or str(error)) if isinstance(error, OSError) else repr(error)
        self._say_once(f"the trend cannot be written: {text}; acquisition goes on")

    def _say_once(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._notices.append(Notice(self._clock.now_ns(), "error", "trend_fault", text))


def zone_rows(machine: MachineClass | None, time_ns: int) -> Iterator[Row]:
    """The velocities at which the zones B, C and D of its standard begin, mm/s rms; nothing of an unknown machine."""
    if machine is None:
        return
    from estimator.identification.record import zone_limits

    for zone, limit in zip("BCD", zone_limits(machine).velocity_mm_s, strict=True):
        yield Row(time_ns, "zone_limit", zone, limit, unit="mm/s")


def estimate_rows(estimate: Estimate, time_ns: int) -> Iterator[Row]:
    """The parameters that the data determine, and the force that is missing."""
    for name, p in estimate.parameters.items():
        if p.value is not None and p.identifiable and p.sd != 0:  # 0: given
            yield Row(time_ns, "estimate", name, value=p.value, sd=p.sd, unit=p.unit)
    for name, value in (estimate.extra or {}).items():
        if name.startswith(MISSING_FORCE_KEY):
            which = name.removeprefix(MISSING_FORCE_KEY).strip("_")
            yield Row(time_ns, "missing_force", which or "all", value, unit="%")


def layer_rows(seen: Sequence[Json], time_ns: int) -> Iterator[Row]:
    """Severity, speed, tones and strikes of several windows: the largest of each number, the last speed."""
    if not seen:
        return
    largest: dict[tuple[str, str], Row] = {}
    for row in (row for one in seen for row in _window_rows(one, time_ns)):
        before = largest.get((row.kind, row.name))
        if before is None or (row.value or 0.0) >= (before.value or 0.0):
            largest[row.kind, row.name] = row
    speed = seen[-1]["machine"]["speed_rpm"]
    if speed:
        yield Row(
            time_ns, "speed", "shaft", value=speed["value"], sd=speed["sd"], unit="rpm", text=speed["source"]
        )  # fmt: skip
    yield from largest.values()


def _window_rows(seen: Json, time_ns: int) -> Iterator[Row]:
    for channel, level in seen["record"]["channels"].items():
        for name in LEVEL_NAMES:
            if level.get(name) is not None:
                zone = level.get("zone") or "" if name == "velocity_rms_mm_s" else ""
                unit = UNIT_OF_LEVEL.get(name) or level.get("unit", "")
                yield Row(time_ns, "severity", f"{channel}.{name}", level[name], unit=unit, text=zone)
    for tone in seen["machine"]["tones"]:
        where = f"{tone['frequency_hz']:.6g} Hz"
        name = tone_name(tone) if tone["kind"] == "order" else f"{tone['frequency_hz']:.3g} Hz"
        for channel, amplitude in tone["amplitude"].items():
            yield Row(time_ns, "tone", f"{name}.{channel}", amplitude, unit=tone["unit"], text=where)
    for train in seen["machine"]["strikes"]:
        order = "" if train["order"] is None else f"order {train['order']:.4g}, "
        text = f"{order}{train['frequency_hz']:.5g} Hz, {train['channel']}, p {train['p_value']:.1g}"
        yield Row(time_ns, "strikes", train["name"], train["severity"], unit="1", text=text)
