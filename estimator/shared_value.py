"""What one value of a law's parameter would be if it held at every place, and whether the places agree on one.

Bearings of one type and fit share their contact's constants, and four places together tell a cubic stiffness twice as
well as one does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtrc

from .estimate import Parameter

DIFFERENT = 0.01  # p-value under which the places are said to differ


@dataclass(frozen=True, slots=True)
class Shared:
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

    def said(self, name: str) -> str:
        """In one line."""
        if self.p_equal < DIFFERENT:
            return f"{name}: the {len(self.places)} places differ (p = {self.p_equal:.2g} that one value holds)"
        per_cent = f" ({100 * self.sd / abs(self.value):.2g} %)" if self.value else ""
        return (
            f"{name}: the {len(self.places)} places agree (p = {self.p_equal:.2g}); one value for all of them would be "
            f"{self.value:.4g} +- {self.sd:.2g} {self.unit}{per_cent}"
        )


def shared(parameters: Mapping[str, Parameter]) -> dict[str, Shared]:
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


def _mean(group: Mapping[str, Parameter]) -> Shared:
    value = np.array([p.value for p in group.values()], float)
    weight = np.array([p.sd for p in group.values()], float) ** -2.0
    mean = float(weight @ value / weight.sum())
    chi2 = float(weight @ (value - mean) ** 2)
    unit = next(iter(group.values())).unit
    return Shared(mean, float(weight.sum() ** -0.5), unit, tuple(group), float(chdtrc(len(value) - 1, chi2)))
