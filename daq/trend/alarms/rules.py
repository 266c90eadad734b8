"""Rules for alarms: a value beyond a limit for some time, a change from the usual value, an impact train."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, Protocol

import numpy as np
from scipy.special import ndtri

from daq.report.numbers import number, parameter
from daq.rig.alarm_table import AlarmTable

from .sequential import Baseline, Cusum, baseline_is_sure, learn

MEAN_S = 60.0  # of a change: values are means over so long at least; six time constants of the rolling estimate
MAX_LEARN_STAGES = 6  # learn_s, then twice as long each time until the baseline is sure: 64 times at most
State = Literal["learning", "ok", "alarm"]


@dataclass(frozen=True, slots=True)
class Value:
    """A number at a time. time_s : of the data; sd : None if not known; p_value : of a strike train."""

    time_s: float
    value: float
    _: KW_ONLY
    sd: float | None = None
    unit: str = ""
    p_value: float = 1.0


class Rule(Protocol):
    """Takes the values of one alarm in the order of time."""

    state: State

    def take(self, value: Value) -> str | None:
        """The text of a new state, or None."""
        ...

    def to_json(self) -> dict[str, Any] | None:
        """State that must survive a restart; None: nothing."""
        ...

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Restore the state that an earlier session saved."""
        ...


class Hold:
    """The state of an alarm whose condition has to last. hold_s : for how long, of the data."""

    def __init__(self, hold_s: float) -> None:
        self.state: State = "ok"
        self._hold_s = hold_s
        self._since_s: float | None = None

    def changes(self, holds: bool, time_s: float) -> bool:
        """Whether the state changes. holds : whether the condition of the alarm holds at this time."""
        if holds == (self.state == "alarm"):
            self._since_s = None
            return False
        self._since_s = time_s if self._since_s is None else self._since_s
        if time_s - self._since_s < self._hold_s:
            return False
        self._since_s, self.state = None, "alarm" if holds else "ok"
        return True


class LimitRule(Hold):
    """Beyond a limit for `hold_s`. Where a value has a standard deviation, by as many of them as the rate asks for.

    A value that sits at the limit is then beyond it in one of `per_s / hold_s` looks.
    """

    def __init__(self, table: AlarmTable, limit: float) -> None:
        super().__init__(table.hold_s)
        self._table, self._limit = table, limit
        looks = max(2.0, table.per_s / max(table.hold_s, MEAN_S))
        self._margin_sd = float(-ndtri(1.0 / looks))

    def take(self, value: Value) -> str | None:
        below, margin = self._table.below, self._margin_sd * (value.sd or 0.0)
        beyond = value.value < self._limit - margin if below else value.value > self._limit + margin
        if not self.changes(beyond, value.time_s):
            return None
        where = ("below" if below else "above") if beyond else "back from"
        held = f" for {self._table.hold_s:g} s" if self._table.hold_s else ""
        return f"{shown(value)}, {where} {shown_number(self._limit, value.unit)}{held}"

    def to_json(self) -> dict[str, Any] | None:
        return None

    def restore(self, saved: Mapping[str, Any]) -> None: ...


class StrikesRule(Hold):
    """A train of a name is seen for `hold_s`, each time so clearly that noise shows one as rarely as is accepted."""

    def __init__(self, table: AlarmTable, window_s: float) -> None:
        super().__init__(table.hold_s)
        self._table, self._window_s = table, window_s

    def take(self, value: Value) -> str | None:
        seen = value.p_value <= self._window_s / self._table.per_s and value.value > 0
        if not self.changes(seen, value.time_s):
            return None
        held = f"{self._table.hold_s:g} s"
        return f"seen for {held}, severity {number(value.value)}" if seen else f"not seen for {held}"

    def to_json(self) -> dict[str, Any] | None:
        return None

    def restore(self, saved: Mapping[str, Any]) -> None: ...


class ChangeRule:
    """A lasting change of the mean from what was learned first, by a sequential test (sequential.py)."""

    def __init__(self, table: AlarmTable) -> None:
        self.state: State = "learning"
        self._table = table
        self._mean_s = max(MEAN_S, table.hold_s)
        self._slot: int | None = None
        self._total = self._sd_total = 0.0
        self._count = self._sd_count = 0
        self._learned: list[tuple[float, float]] = []
        self._stage = 0
        self._test: Cusum | None = None
        self._back = 0

    def take(self, value: Value) -> str | None:
        slot, said = int(value.time_s // self._mean_s), None
        if self._slot is not None and slot != self._slot and self._count:
            mean = self._total / self._count
            sd = self._sd_total / self._sd_count if self._sd_count else None
            said = self._mean(Value(value.time_s, mean, sd=sd, unit=value.unit))
            self._total = self._sd_total = 0.0
            self._count = self._sd_count = 0
        if self._test is not None and self._slot is not None and slot - self._slot not in (0, 1):
            self._test.interrupted()
        self._slot = slot
        self._total, self._count = self._total + value.value, self._count + 1
        if value.sd:
            self._sd_total, self._sd_count = self._sd_total + value.sd, self._sd_count + 1
        return said

    def _mean(self, value: Value) -> str | None:
        if self._test is None:
            self._learned.append((value.value, float("nan") if value.sd is None else value.sd))
            due = self._table.learn_s / self._mean_s * 2**self._stage
            return self._learn(value.unit) if len(self._learned) >= due else None
        test, usual = self._test, self._test.baseline.mean
        change = self._table.change_of(usual)
        side = test.update(value.value, value.sd)
        if self.state == "alarm":
            self._back = self._back + 1 if abs(value.value - usual) < 0.5 * change else 0
            if self._back * self._mean_s < max(self._table.hold_s, 2 * self._mean_s):
                return None
            self.state, self._back = "ok", 0
            test.reset()
            return f"{shown(value)}, again within half of the change from {shown_number(usual, value.unit)}"
        if not side:
            return None
        self.state = "alarm"
        per_cent = f" ({100 * (value.value / usual - 1):+.2g} %)" if usual else ""
        way = "above" if side > 0 else "below"
        return (
            f"{shown(value)}, has changed{per_cent}: it lasts {way} what was usual, {shown_number(usual, value.unit)}"
        )

    def _learn(self, unit: str) -> str | None:
        values, sds = np.array(self._learned).T
        baseline = learn(values, sds)
        self._stage += 1
        if not baseline_is_sure(baseline) and self._stage <= MAX_LEARN_STAGES:
            return None  # it drifts: the same again, twice as long
        self._begin(baseline)
        test = self._test
        if test is None:
            return None
        change = self._table.change_of(baseline.mean)
        delay_s = test.delay(change) * self._mean_s
        seen = f"a change of {shown_number(change, unit)} is seen after about {delay_s / 60:.2g} min"
        if delay_s > self._table.per_s:
            seen = f"a change of {shown_number(change, unit)} is too small to be seen at this rate of false alarms"
        return f"learned: {shown_number(baseline.mean, unit)} is usual; {seen}"

    def _begin(self, baseline: Baseline) -> None:
        self._learned = []
        self.state = "ok"
        change = self._table.change_of(baseline.mean)
        self._test = Cusum(baseline, change, self._table.per_s / self._mean_s)

    def to_json(self) -> dict[str, Any] | None:
        own: dict[str, Any] = {"mean_s": self._mean_s, "state": self.state, "stage": self._stage}
        if self._test is not None:
            return own | {"baseline": self._test.baseline.to_json()}
        return own | {"learned": [[v, s if s == s else None] for v, s in self._learned]}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Raises ValueError, TypeError or KeyError if it is not what `to_json` gives."""
        if saved["mean_s"] != self._mean_s:
            return
        self._stage = int(saved["stage"])
        if "baseline" in saved:
            self._begin(Baseline(**saved["baseline"]))
            self.state = "alarm" if saved["state"] == "alarm" else "ok"
        else:
            self._learned = [(float(v), float("nan") if s is None else float(s)) for v, s in saved["learned"]]


def shown(value: Value) -> str:
    """The value with its 95 % interval and unit."""
    return parameter({"value": value.value, "sd": value.sd, "unit": value.unit}, digits=4)


def shown_number(number: float, unit: str) -> str:
    """A number in its unit."""
    return parameter({"value": number, "unit": unit}, digits=4)
