"""Curves that show where a model fails: force against the states, with 95 % bands.

Two kinds, both from the joint fit of the model's own parameters and of smooth columns of a state (black_box.py).
Residual: what the model leaves over, freed from what its own parameters could take over. Law: the whole restoring
force, model and residual together, freed from a straight line. The residual of a dead zone under a fitted cubic looks
like a high polynomial; its law is flat in the middle with straight flanks, and is known far better than its parts.
A shape is the smooth residual force against the state where most is missing: what an unknown law looks like.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.identification.residual import black_box
from estimator.identification.residual.group_fit import fit_with_ridge
from estimator.identification.residual.missing_force import MissingForce, PlaceResidual
from estimator.likelihood.motion.motion_record import leading_blocks
from estimator.likelihood.path.path_fit import PathFit
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.parallel import map_threads

from .thresholds import LIMITS


def limits_95(value: Array, sd: Array) -> tuple[Array, Array]:
    """Lower and upper 95 % limits of values with these standard deviations."""
    return value - 1.96 * sd, value + 1.96 * sd


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """A force against a state, with its 95 % limits.

    channel : name or place. against : the state. at : (n,) values of the state, SI. band_low, band_high : (n,) N.
    """

    channel: str
    against: str
    at: Array
    band_low: Array
    band_high: Array

    def to_json(self) -> dict[str, Any]:
        """Names, and arrays as lists."""
        values = {own.name: getattr(self, own.name) for own in fields(self)}
        return {name: value if isinstance(value, str) else value.tolist() for name, value in values.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape(Curve):
    """Residual restoring force (n,) N without the part that kL and c can take over."""

    force: Array

    @classmethod
    def from_estimate(cls, channel: str, against: str, at: Array, force: Array, sd: Array) -> Shape:
        """The curve of a force (n,) N with its standard deviation (n,) N."""
        low, high = limits_95(force, sd)
        return cls(channel=channel, against=against, at=at, force=force, band_low=low, band_high=high)


@dataclass(frozen=True, slots=True, kw_only=True)
class Law(Curve):
    """Restoring force (n,) N without its straight line: the measured one and that of the model."""

    measured: Array
    model: Array


def state_curve(point: WorkingPoint, residual: PlaceResidual, group: str, channel: str) -> Shape:
    """The fitted hat functions of one state ("displacement" or "velocity") as a curve, without its straight line."""
    knots = residual.knots[group]
    i = residual.place
    names = [f"{group}.{k}" for k in range(len(knots))]
    # where other states are found too, their part is taken out by the joint fit
    fit = residual.fit if names[0] in residual.fit.names else fit_with_ridge(residual.pool.only(tuple(names)))
    force, cov = fit.increments(names)  # the force that the model lacks, with the sign of the restoring side
    state = point.data.x[i] if group == "displacement" else point.data.v[i]
    rms = float(state.std())
    inside = np.abs(knots) <= min(3.5 * rms, float(np.quantile(np.abs(state), 0.999)))
    weight = np.exp(-0.5 * (knots / rms) ** 2)
    free = _without(np.column_stack([np.ones_like(knots), knots]), weight)[inside]
    return Shape.from_estimate(channel, group, knots[inside], force=free @ force, sd=_sd(free, cov))


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


CURVE_STATES = ("displacement", "velocity", "shaft_angle", "other_direction")
ANGLES_DEG = np.arange(0.0, 361.0, 15.0)


def curves(
    point: WorkingPoint, found: MissingForce, channel: dict[str, str], orders: tuple[float, ...]
) -> tuple[tuple[Shape, ...], tuple[Law, ...]]:
    """Residuals against every state and laws against displacement and velocity, place by place.

    channel : name by place. orders : of the shaft, as the survey had them.
    """
    data = leading_blocks(point.data, LIMITS.mean_seconds)
    rows = _rows(point, data.start)

    def at(residual: PlaceResidual) -> tuple[list[Shape], list[Law]]:
        i, name = residual.place, channel[point.data.places[residual.place]]
        shapes: list[Shape] = []
        laws: list[Law] = []
        for state in CURVE_STATES:
            fit, names = _fit(residual, state)
            if not names:
                continue
            if state == "displacement" or state == "velocity":
                z = data.x[i] if state == "displacement" else data.v[i]
                shape, law = _of_hats(point, residual, fit, names, state, z, rows, name)
                shapes.append(shape)
                laws.append(law)
            elif state == "shaft_angle":
                shapes.append(_against_angle(fit, names, orders, name))
            else:
                group, o = black_box.other_direction_group(data, i), data.other(i)
                if group is not None and o is not None:
                    shapes.append(_against_other(fit, names, group, data.x[o], name))
        return shapes, laws

    drawn = map_threads(at, found.residuals)
    return tuple(s for shapes, _ in drawn for s in shapes), tuple(law for _, laws in drawn for law in laws)


def _rows(point: WorkingPoint, starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the series of a working point that lie in the given blocks."""
    block = point.data.block
    pick = np.flatnonzero(np.isin(point.data.start, starts))
    return np.asarray((pick[:, None] * block + np.arange(block)).ravel(), dtype=np.int64)


def _fit(residual: PlaceResidual, group: str) -> tuple[PathFit, list[str]]:
    """The joint fit of a group and of all groups found, and the names of its regressors; no names without the group."""
    names = [n for n in residual.pool.extra if n.split(".")[0] == group]
    if not names or names[0] in residual.fit.names:
        return residual.fit, names
    return fit_with_ridge(residual.pool.only((*residual.problem.extra, *names))), names


def on_hats(z: Array, knots: Array, series: Array) -> tuple[Array, Array]:
    """(k, m) least-squares projection of series (m, n) on hat functions of z with these knots; (k,) visits."""
    step, last = knots[1] - knots[0], knots.size - 2
    u = (z - knots[0]) / step
    inside = (u >= 0) & (u <= last + 1)
    u, series = u[inside], series[:, inside]
    j = np.minimum(u.astype(np.intp), last)
    f = u - j
    k = knots.size
    low, high = 1.0 - f, f
    H = np.diag(np.bincount(j, low * low, k) + np.bincount(j + 1, high * high, k))
    off = np.bincount(j, low * high, k)[:-1]
    H += np.diag(off, 1) + np.diag(off, -1)
    right = np.stack([np.bincount(j, low * s, k) + np.bincount(j + 1, high * s, k) for s in series], axis=1)
    H += 1e-9 * np.trace(H) / k * np.eye(k)
    visits = np.bincount(j, low, k) + np.bincount(j + 1, high, k)
    return np.linalg.solve(H, right), np.asarray(visits, dtype=np.float64)


def _of_hats(
    point: WorkingPoint, residual: PlaceResidual, fit: PathFit, names: list[str], state: str, z: Array,
    rows: NDArray[np.int64], channel: str,
) -> tuple[Shape, Law]:  # fmt: skip
    """Residual and law against displacement or velocity. z : (n,) the state in these rows."""
    i = residual.place
    knots = residual.knots[state]
    # x and v of one instant do not depend on each other: the other one's linear force only adds noise to a mean
    x_state = state == "displacement"
    idle, amount = ("c", point.c[i] * point.data.v[i]) if x_state else ("kL", point.kL[i] * point.data.x[i])
    aside = f"{point.data.places[i]}.{idle}"
    base = [t for t in point.regressors if i in t.series and t.name in fit.names and t.name != aside]
    own = (point.force[i] - point.data.known[i] - amount)[rows]
    means, visits = on_hats(z, knots, np.stack([own, *(t.series[i][rows] for t in base)]))
    model, D = means[:, 0], means[:, 1:]
    values, cov = fit.increments([*(t.name for t in base), *names])
    to_total = np.concatenate([D, np.eye(knots.size)], axis=1)
    to_hats = np.concatenate([np.zeros_like(D), np.eye(knots.size)], axis=1)
    rms = float(z.std())
    inside = (np.abs(knots) <= min(3.5 * rms, float(np.quantile(np.abs(z), 0.9995)))) & (visits > 0)

    freed = (_without(np.column_stack([np.ones_like(knots), D]), visits) @ to_hats)[inside]
    x = knots[inside]
    shape = Shape.from_estimate(channel, state, x, force=freed @ values, sd=_sd(freed, cov))

    near = np.where(np.abs(knots) <= LIMITS.inner_rms * rms, visits, 0.0) if x_state else visits
    line = _without(np.column_stack([np.ones_like(knots), knots]), near)[inside]
    total, modelled = line @ to_total, line @ model
    whole = modelled + total @ values
    low, high = limits_95(whole, _sd(total, cov))
    law = Law(channel=channel, against=state, at=x, measured=whole, band_low=low, band_high=high, model=modelled)
    return shape, law


def _without(D: Array, weight: Array) -> Array:
    """The projection that removes the span of the columns of D from a curve, by weighted least squares."""
    D = D / np.maximum(np.sqrt((weight[:, None] * D**2).sum(axis=0)), 1e-300)
    return np.asarray(np.eye(len(D)) - D @ np.linalg.pinv(D.T @ (weight[:, None] * D), rcond=1e-8) @ (D.T * weight))


def _sd(A: Array, cov: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", A, cov, A), 0.0)))


def _linear(fit: PathFit, names: list[str], A: Array, at: Array, channel: str, against: str) -> Shape:
    """A (points, columns) times the amplitudes of the columns, with its band."""
    values, cov = fit.increments(names)
    return Shape.from_estimate(channel, against, at, force=A @ values, sd=_sd(A, cov))


def _against_angle(fit: PathFit, names: list[str], orders: tuple[float, ...], channel: str) -> Shape:
    """Force at one rms of displacement against the shaft angle: a stiffness that varies with the angle."""
    angle = np.radians(ANGLES_DEG)
    kept = [k for k, order in enumerate(orders) if order in LIMITS.turn_orders]
    A = np.column_stack([w(orders[k] * angle) for k in kept for w in (np.cos, np.sin)])
    own = [names[2 * k + j] for k in kept for j in (0, 1)]
    return _linear(fit, own, A, ANGLES_DEG, channel, "shaft_angle")


def _against_other(fit: PathFit, names: list[str], group: black_box.RegressorGroup, z: Array, channel: str) -> Shape:
    """Mean force at a displacement z of the other direction."""
    rms = float(z.std())
    knots = np.asarray(np.arange(-9, 10) * 0.35 * rms, dtype=np.float64)
    A, visits = on_hats(z, knots, np.stack(group.series).astype(np.float64))
    inside = np.abs(knots) <= min(3.0 * rms, float(np.quantile(np.abs(z), 0.9995)))
    inside &= visits > 0
    return _linear(fit, names, A[inside], knots[inside], channel, "other_direction")
