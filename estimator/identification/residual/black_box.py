"""A flexible black box for the residual force: regressors of every state that a cap force can depend on, in groups.

Regressors of one state are hat functions (piecewise linear, with exact mean derivative). Regressors of two states are
products of low degree. u = x / rms, w = v / rms, r^2 = u^2 + w^2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.denoise import restore_mean_tangent
from estimator.likelihood.motion.motion_record import TIME_FOLDS, MotionRecord, fold_record
from estimator.likelihood.path.subproblem import (
    Subproblem,
    base_regressors,
    fold_products,
    subproblem,
    with_extra,
)
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.response.fluctuation import Fluctuation
from estimator.likelihood.response.regressor_set import tangent_response

from .black_box_tangents import (
    Derived,
    Float32Series,
    legendre_in_time,
    level_regressors,
    second_order_tangents,
    shaft_waves,
)
from .thresholds import LIMITS

GROUP_NAMES = ("displacement", "velocity", "level", "other_direction", "other_bearing", "time", "shaft_angle")
MIN_VISIT_SAMPLES = 30  # beyond the last knot but one, on each side


@dataclass(frozen=True, slots=True)
class RegressorGroup:
    """Regressors of one location that depend on the same states.

    Attributes
    ----------
    name : str
        One of `GROUP_NAMES`.
    series : list of (n,) float32
        The regressors, without unit.
    tangents : (regressors, places, 2) float64
        Mean derivative of each with respect to displacement (1/m) and velocity (s/m) of every location.
    knots : (k,) float64 or None
        Knots of hat functions, m or m/s; None for other groups.
    """

    name: str
    series: list[Float32Series]
    tangents: Array
    knots: Array | None = None


def hat_knots(z: NDArray[np.floating[Any]], scale: float, step: float) -> Array:
    """(k,) knots of hat functions of a state z, SI, over the range that the state visits.

    scale : rms of the state. step : between knots, over the rms. A hat function that is not zero at one sample only
    would gain likelihood by its mean derivative alone.
    """
    half = int(np.ceil(LIMITS.knot_span_rms / step))
    while half > 2 and min(np.sum(side > (half - 1) * step * scale) for side in (z, -z)) < MIN_VISIT_SAMPLES:
        half -= 1
    return np.arange(-half, half + 1, dtype=np.float64) * step * scale


def hat_group(
    name: str, z: NDArray[np.floating[Any]], knots: Array, place: int, which: int, places: int
) -> RegressorGroup:
    """Hat functions of a state z (n,) at some knots, linear beyond the ends.

    which : 0 for displacement, 1 for velocity. places : number of locations.
    """
    step, row = float(knots[1] - knots[0]), np.arange(z.size)
    at = (z.astype(np.float64) - knots[0]) / step
    cell = np.clip(at.astype(np.intp), 0, knots.size - 2)
    out = np.zeros((knots.size, z.size), np.float32)
    out[cell, row], out[cell + 1, row] = 1.0 - (at - cell), at - cell
    tangents = np.zeros((knots.size, places, 2))
    tangents[:, place, which] = -np.diff(np.bincount(cell, minlength=knots.size - 1), prepend=0, append=0)
    return RegressorGroup(name, list(out), tangents / (z.size * step), knots)


def velocity_knot_step(point: WorkingPoint, i: int) -> float:
    """Distance between knots of the velocity at location i, over its rms.

    Within tau = 1 / (2 high), which the band resolves, a white force moves the velocity by sqrt(2 c tau / m) of its
    rms, and the motion turns by w0 tau. The velocity crosses a narrower hat within tau, and the force of that hat then
    follows the force of the same instant by more than the likelihood allows for.
    """
    tau, mass = 0.5 / point.data.band[1], float(point.data.mass[i])
    k, c = (max(float(z), 0.0) / mass for z in point.mean_tangent[i, i])
    return max(
        LIMITS.v_knot_step_rms, LIMITS.min_hat_width_kicks * float(np.sqrt(2.0 * c * tau)), float(np.sqrt(k)) * tau
    )


def _mean(z: Float32Series | float) -> float:
    return float(np.mean(z, dtype=np.float64))


def _state_group(data: MotionRecord, i: int, name: str, made: Sequence[Derived]) -> RegressorGroup:
    """A group of regressors of location i, each with its derivatives by u, w and, of the other direction, uo, wo.

    They are evaluated at the denoised displacement, with their mean tangents, as laws are: sensor noise in the
    displacement would gain likelihood as x^2 v.
    """
    o, tangents = data.other(i), np.zeros((len(made), len(data.places), 2))
    for (series, *by), own in zip(made, tangents, strict=True):
        slopes = np.array([*map(_mean, by), *[0.0] * (4 - len(by))])
        own[i] = slopes[:2] / data.rms[:2, i]
        if o is not None:
            own[o] = slopes[2:] / data.rms[:2, o]
        mean = np.array([own[i, 0], 0.0, 0.0 if o is None else own[o, 0], 0.0])
        if data.denoise_correction is not None and mean.any():
            restore_mean_tangent(series, mean, data.denoise_correction, i, -1 if o is None else o)
    return RegressorGroup(name, [series for series, *_ in made], tangents)


def other_direction_group(data: MotionRecord, i: int) -> RegressorGroup | None:
    """Regressors of location i and the other direction of its node; None if that is not measured.

    States of the other direction, their products with u, and radial springs with a gap.
    """
    o = data.other(i)
    if o is None:
        return None
    x, y = (data.denoised_displacement(k) / data.rms[0, k] for k in (i, o))
    x, y, w = (z.astype(np.float32) for z in (x, y, data.v[o] / data.rms[1, o]))
    made: list[Derived] = [
        (y.copy(), 0.0, 0.0, 1.0), (w, 0.0, 0.0, 0.0, 1.0), (y * y, 0.0, 0.0, 2 * y), (x * y, y, 0.0, x),
        (y * y * y, 0.0, 0.0, 3 * y * y), (x * x * y, 2 * x * y, 0.0, x * x), (x * y * y, y * y, 0.0, 2 * x * y),
    ]  # fmt: skip
    r = np.maximum(np.hypot(x, y), 1e-6)
    for gap in (1.0, 2.0):
        over, bend = np.maximum(1.0 - gap / r, 0.0), np.where(r > gap, gap / r**3, 0.0)
        made.append((over * x, over + bend * x * x, 0.0, bend * x * y))
        made.append((over * y, bend * x * y, 0.0, over + bend * y * y))
    return _state_group(data, i, "other_direction", made)


def regressor_groups(
    data: MotionRecord,
    i: int,
    orders: tuple[float, ...],
    knots: tuple[Array, Array],
    times: tuple[float, float],
) -> Iterator[RegressorGroup]:
    """Groups of regressors of location i, one at a time, as they are large.

    orders : of the shaft, for varying stiffness. knots : of hat functions of displacement (m) and velocity (m/s). times
    : s, first and last of the record that the data are a part of.
    """
    P = len(data.places)
    sx, sv = float(data.rms[0, i]), float(data.rms[1, i])
    u, w = (data.denoised_displacement(i) / sx).astype(np.float32), (data.v[i] / sv).astype(np.float32)
    # Hats are functions of the measured displacement. Of the denoised one their sum is nearly the law's own regressor,
    # with a mean tangent known to one per cent only, and wins likelihood without any force.
    yield hat_group("displacement", data.displacement(i), knots[0], i, 0, P)
    yield hat_group("velocity", data.v[i], knots[1], i, 1, P)
    yield _state_group(data, i, "level", level_regressors(u, w))
    beside = other_direction_group(data, i)
    if beside is not None:
        yield beside
    q = data.opposite(i)
    if q is not None:
        tangents = np.zeros((2, P, 2))
        tangents[[0, 1], q, [0, 1]] = 1.0 / data.rms[:2, q]
        up, wp = (data.x[q] / data.rms[0, q]).astype(np.float32), (data.v[q] / data.rms[1, q]).astype(np.float32)
        yield RegressorGroup("other_bearing", [up, wp], tangents)
    made: list[Derived] = []
    for z in (own.astype(np.float32) for own in legendre_in_time(data.t, *times)):
        made += [(z * u, z), (z * w, 0.0, z)]
    yield _state_group(data, i, "time", made)
    if data.speed > 0.0:
        yield _state_group(data, i, "shaft_angle", [(z * u, z) for z in shaft_waves(data.phase, orders)])


def group_pool(point: WorkingPoint, i: int, orders: tuple[float, ...]) -> tuple[Subproblem, dict[str, Array]]:
    """The model of location i with every group of regressors on trial, and the knots of the hat functions by group.

    Regressors are evaluated fold by fold, as all together are large, and scaled to the rms of the residual force.
    """
    data, times = point.data, (float(point.data.t[0]), float(point.data.t[-1]))
    plain = subproblem(point, (i,))
    base = base_regressors(point, np.array(plain.places))
    own = float(np.sqrt(np.vdot(point.spectra[i], point.spectra[i]) / point.spectra[i].size))
    made: list[tuple[NDArray[np.int64], Array, Array]] = []
    by_fold: list[list[RegressorGroup]] = []
    ends = (
        hat_knots(data.displacement(i), float(data.rms[0, i]), LIMITS.x_knot_step_rms),
        hat_knots(data.v[i], float(data.rms[1, i]), velocity_knot_step(point, i)),
    )
    for f in range(TIME_FOLDS):
        part, blocks = fold_record(data, f), np.flatnonzero(data.fold == f)
        found, spectra = [], []
        for g in regressor_groups(part, i, orders, ends, times):
            spectra += [point.whitening.spectrum(i, z, blocks=blocks) for z in g.series]
            found.append(replace(g, series=[]))
        made.append(fold_products(point, i, base, f, np.stack(spectra)))
        by_fold.append(found)
    power = np.sqrt(np.sum([np.diag(square) for _, _, square in made], axis=0) / point.spectra[i].size)
    scales = own / np.maximum(power, 1e-30)
    made = [(rows, C * scales, square * np.multiply.outer(scales, scales)) for rows, C, square in made]
    whole = [
        replace(own[0], tangents=np.average([g.tangents for g in own], axis=0, weights=data.fold_blocks))
        for own in zip(*by_fold, strict=True)
    ]
    around = point.fluctuations[i]
    here = around and around.shorter(LIMITS.second_order_record_s)
    tangents: Complexes = np.concatenate([_group_tangents(point, i, g, here, orders, times) for g in whole])
    tangents *= scales[:, None, None, None]
    names = tuple(f"{g.name}.{k}" for g in whole for k in range(len(g.tangents)))
    knots = {g.name: g.knots for g in whole if g.knots is not None}
    at = {i: (np.arange(scales.size), made)}
    return with_known_response(with_extra(point, plain, at, names, scales, tangents)), knots


def with_known_response(problem: Subproblem) -> Subproblem:
    """The problem in which extra regressors in the span of the model's regressors have the response of the latter.

    One force has one response. The second-order response of an extra regressor is known to one per cent only. Its
    difference from the model's own response would change the determinant, and win likelihood, without any force.
    """
    gram, b = problem.gram, len(problem.base)
    G = gram.G.sum(axis=(0, 1))[1:, 1:]
    own, cross = G[:b, :b], G[:b, b:]
    size = np.sqrt(np.maximum(np.diag(own), 1e-300))
    weights = np.linalg.pinv(own / np.multiply.outer(size, size), rcond=1e-10) @ (cross / size[:, None]) / size[:, None]
    left = 1.0 - np.einsum("bk,bk->k", cross, weights) / np.maximum(np.diag(G)[b:], 1e-300)
    known = np.flatnonzero(left < LIMITS.min_own_power_share)
    tangents = gram.tangents.copy()
    tangents[b + known] = np.tensordot(weights[:, known].T, tangents[:b], 1)
    return replace(problem, gram=replace(gram, tangents=tangents))


def _group_tangents(
    point: WorkingPoint, i: int, group: RegressorGroup, here: Fluctuation | None, orders: tuple[float, ...],
    times: tuple[float, float],
) -> Complexes:  # fmt: skip
    """(columns, places, places, bins) tangent of a group per unit. here : for second-order corrections."""
    P = len(point.data.places)
    out = np.zeros((len(group.tangents), P, P, point.whitened.tangents.shape[-1]), complex)
    for k, t in enumerate(group.tangents):
        out[k, i] = tangent_response(t, point.whitening.s)
    if here is not None:
        s2 = point.whitening.s**2
        for k, sigma in enumerate(
            second_order_tangents(group.name, here, point.data.rms[:2, i], group.knots, orders, times)
        ):
            out[k, i, i] -= sigma / s2
    return point.whitening.tangents_to_measured(out)
