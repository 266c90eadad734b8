"""The smooth curve of the residual force against a state: what a person needs to see of an unknown law."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.arrays import Array
from estimator.identification.residual.group_fit import fit_with_ridge
from estimator.identification.residual.missing_force import MissingForce, PlaceResidual
from estimator.likelihood.path.working_point import WorkingPoint


def limits_95(value: Array, sd: Array) -> tuple[Array, Array]:
    """Lower and upper 95 % limits of values with these standard deviations."""
    return value - 1.96 * sd, value + 1.96 * sd


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """Residual restoring force against a state, without the part that kL and c can take over.

    channel : name or place. against : the state. at : (n,) values of the state, SI. force : (n,) N. band_low,
    band_high : (n,) N, 95 % limits.
    """

    channel: str
    against: str
    at: Array
    force: Array
    band_low: Array
    band_high: Array

    @classmethod
    def from_estimate(cls, channel: str, against: str, at: Array, force: Array, sd: Array) -> Shape:
        """The curve of a force (n,) N with its standard deviation (n,) N."""
        low, high = limits_95(force, sd)
        return cls(channel=channel, against=against, at=at, force=force, band_low=low, band_high=high)

    def to_json(self) -> dict[str, Any]:
        return {
            "channel": self.channel,
            "against": self.against,
            **{k: [float(z) for z in getattr(self, k)] for k in ("at", "force", "band_low", "band_high")},
        }


def state_curve(point: WorkingPoint, residual: PlaceResidual, group: str, channel: str) -> Shape:
    """The fitted hat functions of one state ("displacement" or "velocity") as a curve, without its straight line."""
    knots = residual.knots[group]
    i = residual.place
    names = [f"{group}.{k}" for k in range(len(knots))]
    # where other states are found too, their part is taken out by the joint fit
    fit = residual.fit if names[0] in residual.fit.names else fit_with_ridge(residual.pool.only(tuple(names)))
    at = np.array([fit.names.index(n) for n in names])
    scales = fit.scales[at]
    # the force that the model lacks is added to the restoring side with the sign of delta
    force, cov = fit.delta[at] * scales, fit.covariance[np.ix_(at, at)] * np.multiply.outer(scales, scales)
    state = point.data.x[i] if group == "displacement" else point.data.v[i]
    rms = float(state.std())
    inside = np.abs(knots) <= min(3.5 * rms, float(np.quantile(np.abs(state), 0.999)))
    weight = np.exp(-0.5 * (knots / rms) ** 2)
    D = np.stack([np.ones_like(knots), knots / rms], axis=1)
    free = np.eye(len(force)) - D @ np.linalg.solve(D.T @ (weight[:, None] * D), D.T * weight)
    force, sd = free @ force, np.sqrt(np.maximum(np.diag(free @ cov @ free.T), 0.0))
    at_knots, force, sd = knots[inside], force[inside], sd[inside]
    return Shape.from_estimate(channel, group, at_knots, force=force, sd=sd)


def missing_force_curve(
    point: WorkingPoint, found: MissingForce, otherwise: tuple[int, str] | None = None
) -> Shape | None:
    """The curve against the state that explains most, where it is one of displacement or velocity.

    otherwise : place and state to draw if the survey alone finds neither.
    """
    best = [
        (f.gain_nats, r, f.group) for r in found.residuals for f in r.found if f.group in ("displacement", "velocity")
    ]
    if not best and otherwise is not None:
        best = [(0.0, r, otherwise[1]) for r in found.residuals if r.place == otherwise[0]]
    if not best:
        return None
    _, residual, group = max(best, key=lambda z: z[0])
    return state_curve(point, residual, group, point.data.places[residual.place])
