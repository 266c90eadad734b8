"""Results of every estimator: parameters, a fit, a rolling estimate, and one value shared by all places."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

NOT_JUDGED = "not_judged"  # code of the message of a record of which nothing can be judged
MAX_P_VALUE_DIFFERENT = 0.01  # p-value under which the places are said to differ


@dataclass(frozen=True, slots=True)
class Message:
    """A remark of an estimator for the user.

    code : stable snake_case word; programs compare codes, never texts. text : one line for the user; its wording may
    change. place : location such as "bearing1.x" or "bearing1"; "" where the remark is about the whole record.
    """

    code: str
    text: str
    place: str = ""


def messages_json(messages: Sequence[Message]) -> dict[str, list[str]]:
    """`messages`, a list of texts, and `message_codes`, a list of codes in the same order."""
    return {"messages": [m.text for m in messages], "message_codes": [m.code for m in messages]}


@dataclass(frozen=True, slots=True)
class SharedValue:
    """The mean by precision and its standard deviation. p_equal : of chi^2 of the places about it."""

    value: float
    sd: float
    unit: str
    places: tuple[str, ...]
    p_equal: float

    def to_json(self) -> dict[str, Any]:
        """The `shared` of a fit: value, sd, unit, places, p_equal."""
        own = ("value", "sd", "unit", "p_equal")
        return {name: getattr(self, name) for name in own} | {"places": list(self.places)}

    def sentence(self, name: str) -> str:
        """In one line."""
        if self.p_equal < MAX_P_VALUE_DIFFERENT:
            return f"{name}: the {len(self.places)} places differ (p = {self.p_equal:.2g} that one value holds)"
        per_cent = f" ({100 * self.sd / abs(self.value):.2g} %)" if self.value else ""
        return (
            f"{name}: the {len(self.places)} places agree (p = {self.p_equal:.2g}); one value for all of them would be "
            f"{self.value:.4g} +- {self.sd:.2g} {self.unit}{per_cent}"
        )


def shared(parameters: Mapping[str, Parameter]) -> dict[str, SharedValue]:
    """By "EFFECT.PARAMETER", where it was estimated at two places or more and is identifiable at all of them.

    Places are taken as independent, which they nearly are: a force balance is of one place, and the disc's force is
    known from their motion.
    """
    groups: dict[str, dict[str, Parameter]] = {}
    for name, p in parameters.items():
        parts = name.split(".")
        if len(parts) == 4:  # bearing, direction, effect, parameter
            groups.setdefault(".".join(parts[2:]), {})[".".join(parts[:2])] = p
    return {
        name: _mean(group)
        for name, group in groups.items()
        if len(group) > 1 and all(p.identifiable and p.value is not None and p.sd for p in group.values())
    }


def _mean(group: Mapping[str, Parameter]) -> SharedValue:
    from scipy.special import chdtrc  # scipy takes longer to import than all of this file

    value = np.array([p.value for p in group.values()], float)
    weight = np.array([p.sd for p in group.values()], float) ** -2.0
    mean = float(weight @ value / weight.sum())
    chi2 = float(weight @ (value - mean) ** 2)
    unit = next(iter(group.values())).unit
    return SharedValue(mean, float(weight.sum() ** -0.5), unit, tuple(group), float(chdtrc(len(value) - 1, chi2)))


@dataclass(frozen=True, slots=True)
class Fit:
    """Parameters by full name ("bearing1.x.kL"), in SI. log_likelihood in nats, None where a method has none.

    method : spectral | fokker-planck | score-matching | volterra. messages : one line each, for the user to read
    (assumptions the data contradict, what was left out).
    """

    parameters: Mapping[str, Parameter]
    log_likelihood: float | None
    samples: int
    method: str
    messages: tuple[Message, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As schemas/fit.json, and `shared`: of each law's parameter, one value for all places."""
        return {
            "schema": 1,
            "parameters": {name: p.to_json() for name, p in self.parameters.items()},
            "shared": {name: value.to_json() for name, value in shared(self.parameters).items()},
            "log_likelihood": self.log_likelihood,
            "samples": self.samples,
            "method": self.method,
        } | messages_json(self.messages)


@dataclass(frozen=True, slots=True)
class Parameter:
    """A value with its standard deviation. Where the data cannot tell it is not identifiable, `reason` says why, and
    `value` is None or, for the fit of the rest, the best one among many: it is not shown."""

    value: float | None
    sd: float | None
    unit: str
    identifiable: bool = True
    reason: str = ""

    @classmethod
    def from_estimate(cls, value: float, sd: float, unit: str, limit: float = 0.5) -> Parameter:
        """The parameter, or "not identifiable" if sd exceeds `limit` of the value (physics.md section 3)."""
        if np.isfinite(value) and np.isfinite(sd) and sd <= limit * abs(value):
            return cls(float(value), float(sd), unit)
        return cls(None, None, unit, False, f"relative standard deviation over {100 * limit:.0f} %")

    def to_json(self) -> dict[str, Any]:
        """As in the JSON results: value, sd, unit, identifiable and, where there is one, reason."""
        value, sd = (self.value, self.sd) if self.identifiable else (None, None)
        out: dict[str, Any] = {"value": value, "sd": sd, "unit": self.unit, "identifiable": self.identifiable}
        return out | ({"reason": self.reason} if self.reason else {})


def with_unidentifiable_at(
    places: Collection[str], reason: str, numbers: Mapping[str, Parameter], unit: str = ""
) -> dict[str, Parameter]:
    """Numbers by full name without those at some places, and of laws at their nodes, in units that begin so: "N" where
    nothing tells the mass of a cap."""

    def adrift(name: str) -> bool:
        return any(is_of_place(name, place) for place in places)

    return {
        name: Parameter(None, None, q.unit, False, reason) if q.unit.startswith(unit) and adrift(name) else q
        for name, q in numbers.items()
    }


def is_of_place(name: str, place: str) -> bool:
    """Whether a number by its full name is of a place, or of a law at the node of the place."""
    node, direction = name.split(".")[:2]
    return place == f"{node}.{direction}" if direction in ("x", "y") else place.split(".")[0] == node


@dataclass(frozen=True, slots=True)
class Estimate:
    """A snapshot. parameters : "bearing1.x.kL" -> Parameter; samples : rows that it rests on, effectively."""

    index: int  # absolute sample index that the estimate is up to
    parameters: Mapping[str, Parameter]
    samples: float
    log_likelihood: float | None = None
    status: str = "ok"  # ok | warming up | a reason why nothing is shown
    extra: Mapping[str, float] | None = None  # e.g. missing_force_percent of the rolling comparison


MISSING_FORCE_KEY = (
    "missing_force_percent"  # in `extra`: of all candidates; with _NAME behind it: of one that is certain
)


def certain_missing_effects(extra: Mapping[str, float]) -> list[str]:
    """The candidate effects that an estimate is certain to be missing, strongest first."""
    names = [n for n in extra if n.startswith(MISSING_FORCE_KEY + "_")]
    return [n.removeprefix(MISSING_FORCE_KEY + "_") for n in sorted(names, key=lambda n: -extra[n])]


class OnlineEstimator(Protocol):
    """Fed fixed-size consecutive blocks (live and replay agree bit for bit); deterministic; never raises on data.

    Construct as cls(model: Model, rate_hz: float, time_constant_s: float).
    """

    def update(self, block: NDArray[np.float64]) -> None:
        """Take the next rows, (n, channels of the model) in SI units; NaN where a sample is missing or clipped."""
        ...

    def snapshot(self) -> Estimate:
        """The estimate as of the last update; changes nothing."""
        ...
