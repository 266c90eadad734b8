"""The map of where a model fails: channel by state, the region in words, the share of the missing force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.arrays import true_runs
from estimator.identification.residual.missing_force import MissingForce, PlaceResidual
from estimator.likelihood.path.working_point import WorkingPoint

from .curves import state_curve

SI_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"))


@dataclass(frozen=True, slots=True)
class FailureRegion:
    """Region of a state in which a model fails.

    channel : name. against : state or "frequency", "time", ... that the missing force depends on. region : in words and
    units. share_percent : of the power of the missing force.
    """

    channel: str
    against: str
    region: str
    share_percent: float


def failure_regions(point: WorkingPoint, found: MissingForce, channel: dict[str, str]) -> tuple[FailureRegion, ...]:
    """Every state found, largest share first."""
    total = sum(f.power_N2 for r in found.residuals for f in r.found) + sum(s.power_N2 for s in found.disturbances)
    out = [
        FailureRegion(
            channel[point.data.places[r.place]], f.group, region_text(point, r, f.group), 100 * f.power_N2 / total
        )
        for r in found.residuals
        for f in r.found
        if total > 0
    ]
    out += [
        FailureRegion(channel[point.data.places[s.place]], s.against, s.region, 100 * s.power_N2 / total)
        for s in found.disturbances
    ]
    return tuple(sorted(out, key=lambda w: -w.share_percent))


def region_text(point: WorkingPoint, residual: PlaceResidual, group: str) -> str:
    """Region of the state that holds the missing force, in words and units."""
    data, i = point.data, residual.place
    if group in ("displacement", "velocity"):
        unit = "m" if group == "displacement" else "m/s"
        state = data.x[i] if group == "displacement" else data.v[i]
        c = state_curve(point, residual, group, "")
        density = np.histogram(state, np.append(c.at, 2 * c.at[-1] - c.at[-2]) - 0.5 * (c.at[1] - c.at[0]))[0]
        weight = c.force**2 * density
        return _stretches(c.at, weight, unit)
    other = data.other(i)
    opposite = data.opposite(i)
    return {
        "level": "grows or falls with the vibration level",
        "other_direction": f"follows {data.places[other]}" if other is not None else "other direction",
        "other_bearing": f"follows {data.places[opposite]}" if opposite is not None else "other bearing",
        "time": f"drifts over the {data.seconds:.0f} s of the record",
        "shaft_angle": "varies with the shaft angle",
    }.get(group, group)


def _round(value: float) -> str:
    """A number with two figures, without a power of ten."""
    return f"{float(f'{value:.2g}'):g}"


def _stretches(at: np.ndarray, weight: np.ndarray, unit: str) -> str:
    """Stretches of a state that hold 70 % of the weight."""
    order = np.argsort(-weight)
    enough = int(np.searchsorted(np.cumsum(weight[order]), 0.7 * weight.sum())) + 1
    inside = np.zeros(at.size, bool)
    inside[order[:enough]] = True
    step = 0.5 * (at[1] - at[0])
    factor, prefix = next((f, p) for f, p in SI_PREFIXES if np.abs(at).max() >= f or f == SI_PREFIXES[-1][0])
    parts = [
        f"{_round((at[a] - step) / factor)} to {_round((at[b - 1] + step) / factor)}" for a, b in true_runs(inside)
    ]
    return " and ".join(parts) + f" {prefix}{unit}"
