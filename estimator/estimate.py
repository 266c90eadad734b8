"""What an estimator says, and the contract of a rolling one (the estimator seam)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


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
    def judged(cls, value: float, sd: float, unit: str, limit: float = 0.5) -> Parameter:
        """The parameter, or "not identifiable" if sd exceeds `limit` of the value (physics.md section 3)."""
        if np.isfinite(value) and np.isfinite(sd) and sd <= limit * abs(value):
            return cls(float(value), float(sd), unit)
        return cls(None, None, unit, False, f"relative standard deviation over {100 * limit:.0f} %")

    def to_json(self) -> dict[str, Any]:
        """As in the JSON results: value, sd, unit, identifiable and, where there is one, reason."""
        value, sd = (self.value, self.sd) if self.identifiable else (None, None)
        out: dict[str, Any] = {"value": value, "sd": sd, "unit": self.unit, "identifiable": self.identifiable}
        return out | ({"reason": self.reason} if self.reason else {})


def untold_at(
    places: Collection[str], reason: str, numbers: Mapping[str, Parameter], unit: str = ""
) -> dict[str, Parameter]:
    """Numbers by full name without those at some places, and of laws at their nodes, in units that begin so: "N" where
    nothing tells the mass of a cap."""

    def adrift(name: str) -> bool:
        return any(belongs(name, place) for place in places)

    return {
        name: Parameter(None, None, q.unit, False, reason) if q.unit.startswith(unit) and adrift(name) else q
        for name, q in numbers.items()
    }


def belongs(name: str, place: str) -> bool:
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


MISSING = "missing_force_percent"  # in `extra`: of all candidates; with _NAME behind it: of one that is certain


def certain(extra: Mapping[str, float]) -> list[str]:
    """The candidate effects that an estimate is certain to be missing, strongest first."""
    names = [n for n in extra if n.startswith(MISSING + "_")]
    return [n.removeprefix(MISSING + "_") for n in sorted(names, key=lambda n: -extra[n])]


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
