"""[[alarm]] of the rig file: what is watched, what is an alarm, how many false ones are accepted."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from .problems import Problem, did_you_mean
from .table import Table

SECONDS_OF_PERIOD = {"day": 86_400.0, "week": 604_800.0, "month": 2_629_800.0, "year": 31_557_600.0}
PER_PATTERN = re.compile(r"\s*(\d+(?:\.\d+)?)\s+an?\s+(day|week|month|year)\s*")
SHARE_PATTERN = re.compile(r"\s*(\d+(?:\.\d+)?)\s*%\s*")
LEVEL_KINDS = ("severity", "displacement", "rms", "peak", "crest", "kurtosis")  # severity: velocity, mm/s rms
STRIKE_NAMES = ("BPFO", "BPFI", "BSF", "FTF", "other")
ZONE_KIND, STRIKES_KIND, TONE_KIND = "severity", "strikes", "tone"
WHOLE_MACHINE_KINDS = ("missing_force", "speed")  # of the whole machine
Zone = Literal["B", "C", "D"]


class AlarmTable(Table):
    """An alarm. Besides strikes, which are an alarm when they are there, it needs limit or change."""

    what: str = Field(
        description="bearing1.x.kL (any parameter), severity.CHANNEL (velocity, mm/s), rms.CHANNEL, kurtosis.CHANNEL, "
        "strikes.BPFO, tone.1X.CHANNEL, missing_force (%), speed (rpm)"
    )
    limit: float | Zone | None = Field(
        default=None, description="an alarm above it, in SI or the unit named; of severity also the zone that begins"
    )
    below: bool = Field(default=False, description="an alarm below the limit instead")
    change: Annotated[float, Field(gt=0)] | str | None = Field(
        default=None, description='the change that is worth an alarm: "5 %" of what was learned, or in the unit'
    )
    hold_s: Annotated[float, Field(ge=0)] = Field(default=60.0, description="so long a limit must be passed, s")
    per: str = Field(default="1 a month", description='false alarms that are accepted: "1 a month", "2 a year"')
    learn_s: Annotated[float, Field(ge=600)] = Field(
        default=86_400.0, description="of a change: what is usual is learned from so much at least, s"
    )

    @field_validator("per")
    @classmethod
    def a_rate(cls, value: str) -> str:
        found = PER_PATTERN.fullmatch(value)
        if found is None or float(found[1]) == 0:
            raise ValueError(f'"{value}" is no rate; write it as "1 a month" (day, week, month, year)')
        return value

    @field_validator("change")
    @classmethod
    def a_share(cls, value: float | str | None) -> float | str | None:
        if isinstance(value, str) and (SHARE_PATTERN.fullmatch(value) is None or not float(value.strip(" %"))):
            raise ValueError(f'"{value}" is no change; write "5 %", or a number in the unit of the value')
        return value

    @model_validator(mode="after")
    def one_kind(self) -> AlarmTable:
        if self.limit is not None and self.change is not None:
            raise ValueError("limit and change are two alarms: give one, and the other in an [[alarm]] of its own")
        if self.limit is None and self.change is None and self.kind != STRIKES_KIND:
            raise ValueError('needs limit = NUMBER or change = "5 %"')
        if isinstance(self.limit, str) and self.kind != ZONE_KIND:
            raise ValueError(f'limit = "{self.limit}": a zone is one of severity.CHANNEL alone; give a number')
        if self.below and not isinstance(self.limit, float):
            raise ValueError("below needs limit = NUMBER")
        return self

    @property
    def kind(self) -> str:
        """The first word of `what`; "estimate" for a parameter."""
        first = self.what.partition(".")[0]
        known = (*LEVEL_KINDS, STRIKES_KIND, TONE_KIND, *WHOLE_MACHINE_KINDS)
        return first if first in known else "estimate"

    @property
    def name(self) -> str:
        """`what` without the kind."""
        return self.what if self.kind == "estimate" else self.what.partition(".")[2]

    @property
    def per_s(self) -> float:
        """Seconds between two false alarms, on average."""
        found = PER_PATTERN.fullmatch(self.per)
        return SECONDS_OF_PERIOD[found[2]] / float(found[1]) if found else SECONDS_OF_PERIOD["month"]

    def change_of(self, usual: float) -> float:
        """The change that is worth an alarm, in the unit of the value. usual : what was learned."""
        if isinstance(self.change, str):
            return abs(usual) * float(self.change.strip(" %")) / 100.0
        return self.change or 0.0


def alarm_problems(
    alarms: Sequence[AlarmTable], channels: Sequence[str], places: Sequence[str], classed: bool
) -> list[Problem]:
    """Names in the alarms that are not there. places : measured ones, such as bearing1.x; classed : a machine class."""
    problems = []
    for k, alarm in enumerate(alarms):
        kind, name, path = alarm.kind, alarm.name, ("alarm", k, "what")
        if kind in LEVEL_KINDS and not name:
            problems.append(Problem(path, f'"{alarm.what}": write {kind}.CHANNEL; channels are {", ".join(channels)}'))
        elif kind in LEVEL_KINDS and name not in channels:
            problems.append(Problem(path, f'"{name}" is no channel; {did_you_mean(name, channels, "there are")}'))
        elif kind == STRIKES_KIND and name not in STRIKE_NAMES:
            problems.append(Problem(path, f'"{name}" is no train; {did_you_mean(name, STRIKE_NAMES)}'))
        elif kind == TONE_KIND and name.rpartition(".")[2] not in channels:
            problems.append(Problem(path, f'"{alarm.what}": write tone.1X.CHANNEL; channels are {", ".join(channels)}'))
        elif kind == "estimate" and not any(name.startswith((f"{p}.", f"{p.split('.')[0]}.")) for p in places):
            first = (*LEVEL_KINDS, STRIKES_KIND, TONE_KIND, *WHOLE_MACHINE_KINDS)
            text = f'"{alarm.what}" is nothing that is measured: a parameter begins with {", ".join(places)}'
            problems.append(Problem(path, f"{text}; else {did_you_mean(name.partition('.')[0], first, 'there are')}"))
        if isinstance(alarm.limit, str) and not classed:
            example = 'iso20816 = { part = 3, group = 2, support = "rigid" }'
            text = f"a zone needs [machine] {example}; add it, or give a number in mm/s"
            problems.append(Problem(("alarm", k, "limit"), text))
        if alarm.what in [other.what for other in alarms[:k] if (other.limit is None) == (alarm.limit is None)]:
            problems.append(Problem(path, f'"{alarm.what}" is watched so already; remove one'))
    return problems
