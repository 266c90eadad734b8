"""The sink that watches the values of the rig file's alarms, and notifies listeners."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from daq.base.console import unfinished
from daq.base.contract.dates import utc_text
from daq.base.contract.sink import Session, SinkHealth, Status
from daq.report.layers import tone_name
from daq.rig.alarm_table import AlarmTable
from daq.rig.rig import Rig
from drivers.contract import Block, Info, Notice, Reading
from estimator.results import MISSING_FORCE_KEY, Estimate

from ..names import ALARM_CODE, ALARM_LEARNED_CODE, ALARM_OVER_CODE
from .rules import ChangeRule, LimitRule, Rule, State, StrikesRule, Value

LEVEL_KEYS = {"severity": ("velocity_rms_mm_s", "mm/s"), "displacement": ("displacement_rms_um", "um")}
WINDOW_S = 10.0  # that the layers look at
CLOSE_S = 2.0
SAVE_EVERY_S = 3600.0  # of data, while something is learned
KIND_LEVELS = {"rms", "peak", "crest", "kurtosis"}

Json = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmState:
    """State of one alarm. value, sd, unit : the last ones; since_ns : Unix time of the last change of state."""

    what: str
    state: State
    value: float | None = None
    sd: float | None = None
    unit: str = ""
    since_ns: int = 0
    text: str = ""
    limit: float | str | None = None
    change: float | str | None = None

    def to_json(self) -> dict[str, Any]:
        """The state as it is published."""
        names = ("what", "state", "value", "sd", "unit", "limit", "change", "text")
        own = {name: getattr(self, name) for name in names}
        return {"schema": 1} | own | {"since": utc_text(self.since_ns) if self.since_ns else None}


Listener = Callable[[AlarmState], None]


class AlarmWatch:
    """A sink. memory : a file that keeps what was learned over a restart. listeners : called with each new state.

    wall_offset_ns : Unix time minus host time, asked when it is needed.
    """

    def __init__(
        self, rig: Rig, listeners: Sequence[Listener] = (), memory: Path | None = None,
        wall_offset_ns: Callable[[], int] | None = None,
    ) -> None:  # fmt: skip
        self._alarms = {_key(table): (table, make_rule(table, rig)) for table in rig.alarms}
        self.states = {key: _first_state(*own) for key, own in self._alarms.items()}
        self.raised: list[AlarmState] = []  # alarms that have started
        self._listeners, self._memory = listeners, memory
        self._wall_offset_ns = wall_offset_ns or (lambda: time.time_ns() - time.monotonic_ns())
        self._rate_hz, self._now_ns, self._saved_s = 1.0, 0, 0.0
        self._stop = 0
        self._layers: deque[tuple[int, Json]] = deque(maxlen=100)
        self._notices: deque[Notice] = deque()
        self._saving: threading.Thread | None = None
        self._restore()

    def start(self, session: Session) -> None:
        self._rate_hz = session.info.rate_hz
        for state in self.states.values():
            self._notify(state)

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Block):
                self._stop = reading.index + len(reading.counts)
                self._now_ns = reading.t_host_ns + self._wall_offset_ns()
            elif isinstance(reading, Info):
                self._rate_hz = reading.rate_hz
        while self._layers:
            stop, seen = self._layers.popleft()
            self._take(values_of_layers(seen, stop / self._rate_hz))

    def estimate(self, estimate: Estimate) -> None:
        self._take(values_of_estimate(estimate, estimate.index / self._rate_hz))

    def layers(self, stop: int, seen: Json) -> None:
        """Take the layers of a diagnosis of the samples before `stop`; called from any thread."""
        self._layers.append((stop, seen))

    def status(self, status: Status) -> None:
        seconds = status.index / self._rate_hz
        if seconds - self._saved_s >= SAVE_EVERY_S or seconds < self._saved_s:
            self._saved_s = seconds
            self._save()

    def health(self) -> SinkHealth:
        return SinkHealth.of_notices(self._notices)

    def close(self) -> None:
        if self._saving is not None:
            self._saving.join(CLOSE_S)
        self._write(self._to_json())

    # -- the rest is private ----------------------------------------------------------------------------------------

    def _take(self, values: Mapping[str, Value]) -> None:
        for key, (table, rule) in self._alarms.items():
            value = values.get(table.what)
            if value is None and table.kind == "strikes" and LAYERS_SEEN_KEY in values:
                value = values[LAYERS_SEEN_KEY]  # no train of that name
            if value is None:
                continue
            before, said = rule.state, rule.take(value)
            own = replace(self.states[key], state=rule.state, value=value.value, sd=value.sd, unit=value.unit)
            self.states[key] = own
            if said is not None:
                self._say(key, before, said, value.time_s)

    def _say(self, key: str, before: State, said: str, time_s: float) -> None:
        now = self.states[key]
        since_ns = self._now_ns - round((self._stop / self._rate_hz - time_s) * 1e9)
        state = replace(now, since_ns=max(1, since_ns), text=f"{now.what}: {said}")
        self.states[key] = state
        if state.state == "alarm":
            self.raised.append(state)
            code, level = ALARM_CODE, "warning"
        else:
            code, level = (ALARM_LEARNED_CODE if before == "learning" else ALARM_OVER_CODE), "info"
        text = f"alarm: {state.text}" if code == ALARM_CODE else state.text
        self._notices.append(Notice(time.monotonic_ns(), level, code, text))
        self._notify(state)
        self._save()

    def _notify(self, state: AlarmState) -> None:
        for listener in self._listeners:
            listener(state)

    def _to_json(self) -> dict[str, Any]:
        return {key: saved for key, (_, rule) in self._alarms.items() if (saved := rule.to_json()) is not None}

    def _save(self) -> None:
        """Save in a thread, because a disk that stalls must not delay acquisition; the next save is complete again."""
        if self._memory is not None and not (self._saving is not None and self._saving.is_alive()):
            self._saving = threading.Thread(target=self._write, args=(self._to_json(),), name="alarms", daemon=True)
            self._saving.start()

    def _write(self, value: dict[str, Any]) -> None:
        if self._memory is not None and value:
            with suppress(OSError):  # the next save contains the same, and more
                self._memory.parent.mkdir(parents=True, exist_ok=True)
                unfinished.write(self._memory, json.dumps(value).encode())

    def _restore(self) -> None:
        if self._memory is None or not self._memory.exists():
            return
        try:
            saved = json.loads(self._memory.read_text("utf-8"))
            for key, (table, rule) in self._alarms.items():
                if key in saved:
                    rule.restore(saved[key])
                    self.states[key] = _first_state(table, rule)
        except (OSError, ValueError, TypeError, KeyError) as error:
            text = f"{self._memory}: what was usual is not to be read ({error!r}); it is learned anew"
            self._notices.append(Notice(time.monotonic_ns(), "warning", "alarm_memory", text))


LAYERS_SEEN_KEY = "(layers)"  # a look at the layers took place


def _key(table: AlarmTable) -> str:
    """Key of an alarm in the memory: a changed definition is another alarm."""
    return table.what if table.limit is not None else f"{table.what} {table.change or 'seen'}"


def _first_state(table: AlarmTable, rule: Rule) -> AlarmState:
    return AlarmState(what=table.what, state=rule.state, limit=table.limit, change=table.change)


def make_rule(table: AlarmTable, rig: Rig) -> Rule:
    """The rule of an alarm."""
    if table.change is not None:
        return ChangeRule(table)
    if table.limit is None:
        return StrikesRule(table, WINDOW_S)
    limit = table.limit
    if isinstance(limit, str):
        from estimator.identification.record import zone_limits

        machine = rig.model.iso20816
        known = None if machine is None else zone_limits(machine).velocity_mm_s
        limit = float("inf") if known is None else known["BCD".index(limit)]
    return LimitRule(table, limit)


def values_of_estimate(estimate: Estimate, time_s: float) -> dict[str, Value]:
    """By the names of the rig file's alarms."""
    out = {
        name: Value(time_s, p.value, sd=p.sd, unit=p.unit)
        for name, p in estimate.parameters.items()
        if p.value is not None and p.identifiable
    }
    for name, value in (estimate.extra or {}).items():
        if name == MISSING_FORCE_KEY:
            out["missing_force"] = Value(time_s, value, unit="%")
    return out


def values_of_layers(seen: Json, time_s: float) -> dict[str, Value]:
    """By the names of the rig file's alarms; a train that is not there is 0."""
    out = {LAYERS_SEEN_KEY: Value(time_s, 0.0)}
    for what, value in _level_values(seen["record"]["channels"], time_s):
        out[what] = value
    for tone in seen["machine"]["tones"]:
        for channel, amplitude in tone["amplitude"].items():
            out[f"tone.{tone_name(tone)}.{channel}"] = Value(time_s, amplitude, unit=tone["unit"])
    for train in seen["machine"]["strikes"]:
        own = Value(time_s, train["severity"], unit="1", p_value=train["p_value"])
        before = out.get(f"strikes.{train['name']}")
        if before is None or own.p_value < before.p_value:
            out[f"strikes.{train['name']}"] = own
    if speed := seen["machine"]["speed_rpm"]:
        out["speed"] = Value(time_s, speed["value"], sd=speed["sd"], unit="rpm")
    return out


def _level_values(channels: Json, time_s: float) -> Iterator[tuple[str, Value]]:
    for channel, level in channels.items():
        for kind, (key, unit) in LEVEL_KEYS.items():
            if level.get(key) is not None:
                yield f"{kind}.{channel}", Value(time_s, level[key], unit=unit)
        for kind in KIND_LEVELS:
            if level.get(kind) is not None:
                unit = level.get("unit", "") if kind in ("rms", "peak") else "1"
                yield f"{kind}.{channel}", Value(time_s, level[kind], unit=unit)
