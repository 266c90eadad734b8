"""A flexible black box for the residual force: regressors of every state that a cap force can depend on, in groups.

Regressors of one state are hat functions (piecewise linear, with exact mean derivative). Regressors of two states are
products of low degree. u = x / rms, w = v / rms, r^2 = u^2 + w^2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
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

from .black_box_tangents import legendre_in_time, second_order_tangents, shaft_waves
from .thresholds import LIMITS

Float32Series = NDArray[np.float32]
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
    tangents : list of (places, 2) float64
        Mean derivative of each with respect to displacement (1/m) and velocity (s/m) of every location.
    knots : (k,) float64 or None
        Knots of hat functions, m or m/s; None for other groups.
    """

    name: str
    series: list[Float32Series]
    tangents: list[Array]
    knots: Array | None = None


@njit(cache=True, nogil=True)
def _hat_regressors(z, low, step, out, slopes):  # type: ignore[no-untyped-def]
    """Hat functions with knots low + k step, linear beyond the ends. slopes (k,) : mean derivatives."""
    k = out.shape[0]
    n = z.size
    for i in range(n):
        u = (z[i] - low) / step
        j = int(u)
        if j < 0:
            j = 0
        if j > k - 2:
            j = k - 2
        f = u - j
        out[j, i] = 1.0 - f
        out[j + 1, i] = f
        slopes[j] -= 1.0
        slopes[j + 1] += 1.0
    for j in range(k):
        slopes[j] /= n * step


@njit(cache=True, nogil=True)
def _level_regressors(u, w, out, slopes):  # type: ignore[no-untyped-def]
    """Products of u and w, and of each with r = |(u, w)|. slopes (k, 4) : sums of d/du, d/dw, d/duo, d/dwo."""
    for i in range(u.size):
        x, v = u[i], w[i]
        r = max(np.sqrt(x * x + v * v), 1e-6)
        out[0, i], out[1, i], out[2, i], out[3, i], out[4, i] = x * v, x * x * v, x * v * v, r * x, r * v
        slopes[0, 0] += v
        slopes[0, 1] += x
        slopes[1, 0] += 2 * x * v
        slopes[1, 1] += x * x
        slopes[2, 0] += v * v
        slopes[2, 1] += 2 * x * v
        slopes[3, 0] += r + x * x / r
        slopes[3, 1] += x * v / r
        slopes[4, 0] += x * v / r
        slopes[4, 1] += r + v * v / r


@njit(cache=True, nogil=True)
def _other_direction_regressors(u, uo, wo, out, slopes):  # type: ignore[no-untyped-def]
    """States of the other direction, their products with u, and radial springs with a gap.

    slopes (k, 4) : sums of d/du, d/dw, d/duo, d/dwo.
    """
    for i in range(u.size):
        x, y = u[i], uo[i]
        out[0, i], out[1, i], out[2, i], out[3, i] = y, wo[i], y * y, x * y
        out[4, i], out[5, i], out[6, i] = y * y * y, x * x * y, x * y * y
        slopes[0, 2] += 1.0
        slopes[1, 3] += 1.0
        slopes[2, 2] += 2 * y
        slopes[3, 0] += y
        slopes[3, 2] += x
        slopes[4, 2] += 3 * y * y
        slopes[5, 0] += 2 * x * y
        slopes[5, 2] += x * x
        slopes[6, 0] += y * y
        slopes[6, 2] += 2 * x * y
        r = max(np.sqrt(x * x + y * y), 1e-6)
        for k in range(2):
            gap = k + 1.0
            over, bend = (1.0 - gap / r, gap / (r * r * r)) if r > gap else (0.0, 0.0)
            out[7 + 2 * k, i], out[8 + 2 * k, i] = over * x, over * y
            slopes[7 + 2 * k, 0] += over + bend * x * x
            slopes[7 + 2 * k, 2] += bend * x * y
            slopes[8 + 2 * k, 0] += bend * x * y
            slopes[8 + 2 * k, 2] += over + bend * y * y


def _evaluated(law: Callable[..., None], columns: int, *states: Float32Series) -> tuple[list[Float32Series], Array]:
    """The regressors of a law of some states, and the means (columns, 4) of their derivatives."""
    out, slopes = np.empty((columns, states[0].size), np.float32), np.zeros((columns, 4))
    law(*states, out, slopes)
    return list(out), slopes / states[0].size


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
    """Hat functions of a state z (n,) at some knots.

    which : 0 for displacement, 1 for velocity. places : number of locations.
    """
    out = np.zeros((knots.size, z.size), np.float32)
    slopes = np.zeros(knots.size)
    _hat_regressors(z, float(knots[0]), float(knots[1] - knots[0]), out, slopes)
    tangents = []
    for s in slopes:
        t = np.zeros((places, 2))
        t[place, which] = s
        tangents.append(t)
    return RegressorGroup(name, list(out), tangents, knots)


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


def _state_group(data: MotionRecord, i: int, name: str, series: list[Float32Series], slopes: Array) -> RegressorGroup:
    """A group of regressors of location i. slopes : (columns, 4) mean d/du, d/dw, d/duo, d/dwo."""
    o = data.other(i)
    tangents = np.zeros((len(series), len(data.places), 2))
    tangents[:, i] = slopes[:, :2] / data.rms[:2, i]
    if o is not None:
        tangents[:, o] = slopes[:, 2:] / data.rms[:2, o]
    return RegressorGroup(name, series, list(tangents))


def other_direction_group(data: MotionRecord, i: int) -> RegressorGroup | None:
    """Regressors of location i and the other direction of its node; None if that is not measured."""
    o = data.other(i)
    if o is None:
        return None
    states = [
        data.denoised_displacement(i) / data.rms[0, i],
        data.denoised_displacement(o) / data.rms[0, o],
        data.v[o] / data.rms[1, o],
    ]
    found = _state_group(
        data,
        i,
        "other_direction",
        *_evaluated(
            _other_direction_regressors, LIMITS.other_direction_regressors, *(z.astype(np.float32) for z in states)
        ),
    )
    return _on_denoised_displacement(found, data, i)


def _on_denoised_displacement(group: RegressorGroup, data: MotionRecord, i: int) -> RegressorGroup:
    """The group evaluated at the denoised displacement, with its mean tangents, as laws are evaluated.

    Sensor noise in the displacement would gain likelihood as x^2 v.
    """
    if data.denoise_correction is not None:
        o = data.other(i)
        for series, tangents in zip(group.series, group.tangents, strict=True):
            mean = np.array([tangents[i, 0], 0.0, 0.0 if o is None else tangents[o, 0], 0.0])
            if mean.any():
                restore_mean_tangent(series, mean, data.denoise_correction, i, -1 if o is None else o)
    return group


def regressor_groups(
    data: MotionRecord,
    i: int,
    orders: tuple[float, ...],
    knots: tuple[Array, Array],
    times: tuple[float, float] | None = None,
) -> Iterator[RegressorGroup]:
    """Groups of regressors of location i, one at a time, as they are large.

    orders : of the shaft, for varying stiffness. knots : of hat functions of displacement (m) and velocity (m/s). times
    : s, first and last of the record if the data are a part of it.
    """
    P = len(data.places)
    sx, sv = float(data.rms[0, i]), float(data.rms[1, i])
    u, w = (data.denoised_displacement(i) / sx).astype(np.float32), (data.v[i] / sv).astype(np.float32)
    # Hats are functions of the measured displacement. Of the denoised one their sum is nearly the law's own regressor,
    # with a mean tangent known to one per cent only, and wins likelihood without any force.
    yield hat_group("displacement", data.displacement(i), knots[0], i, 0, P)
    yield hat_group("velocity", data.v[i], knots[1], i, 1, P)

    def m(z: Float32Series) -> float:
        return float(np.mean(z, dtype=np.float64))

    yield _on_denoised_displacement(
        _state_group(data, i, "level", *_evaluated(_level_regressors, LIMITS.level_regressors, u, w)), data, i
    )
    beside = other_direction_group(data, i)
    if beside is not None:
        yield beside
    q = data.opposite(i)
    if q is not None:
        tx, tv = np.zeros((P, 2)), np.zeros((P, 2))
        tx[q, 0], tv[q, 1] = 1.0 / data.rms[0, q], 1.0 / data.rms[1, q]
        up, wp = (data.x[q] / data.rms[0, q]).astype(np.float32), (data.v[q] / data.rms[1, q]).astype(np.float32)
        yield RegressorGroup("other_bearing", [up, wp], [tx, tv])
    first, last = (float(data.t[0]), float(data.t[-1])) if times is None else times
    tau, second = (z.astype(np.float32) for z in legendre_in_time(data.t, first, last))
    slopes = np.zeros((4, 4))
    slopes[0, 0] = slopes[1, 1] = m(tau)
    slopes[2, 0] = slopes[3, 1] = m(second)
    yield _on_denoised_displacement(
        _state_group(data, i, "time", [tau * u, tau * w, second * u, second * w], slopes), data, i
    )
    if data.speed > 0.0:
        turning = shaft_waves(data.phase, orders)
        slopes = np.array([[m(z), 0.0, 0.0, 0.0] for z in turning])
        yield _on_denoised_displacement(_state_group(data, i, "shaft_angle", [z * u for z in turning], slopes), data, i)


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
    most = sum(z.size for z in ends) + LIMITS.level_regressors + LIMITS.other_direction_regressors + 6 + 2 * len(orders)
    rows = most * int(data.fold_blocks.max())
    room = np.empty(0, np.float32)  # of all folds: memory that is new takes longer than what is computed in it
    for f in range(TIME_FOLDS):
        part, blocks = fold_record(data, f), np.flatnonzero(data.fold == f)
        found, count = [], 0
        X = room
        for g in regressor_groups(part, i, orders, ends, times):
            for z in g.series:
                spectrum = point.whitening.spectrum(i, z, blocks=blocks)
                if not count:
                    room = room if room.size else np.empty(rows * spectrum.shape[1], np.float32)
                    X = room[: most * spectrum.size].reshape(most, *spectrum.shape)
                X[count] = spectrum
                count += 1
            found.append(RegressorGroup(g.name, [], g.tangents, g.knots))
        made.append(fold_products(point, i, base, f, X[:count]))
        by_fold.append(found)
    power = np.sqrt(np.sum([np.diag(square) for _, _, square in made], axis=0) / point.spectra[i].size)
    scales = own / np.maximum(power, 1e-30)
    made = [(rows, C * scales, square * np.multiply.outer(scales, scales)) for rows, C, square in made]
    mean = np.average([[t for g in found for t in g.tangents] for found in by_fold], axis=0, weights=data.fold_blocks)
    columns = np.split(mean, np.cumsum([len(g.tangents) for g in by_fold[0]])[:-1])
    whole = [replace(g, tangents=[*own]) for g, own in zip(by_fold[0], columns, strict=True)]
    around = point.fluctuations[i]
    here = around and around.shorter(LIMITS.second_order_record_s)
    tangents: Complexes = np.concatenate([_group_tangents(point, i, g, here, orders, times) for g in whole])
    tangents *= scales[:, None, None, None]
    names = tuple(f"{g.name}.{k}" for g in whole for k in range(len(g.tangents)))
    knots = {g.name: g.knots for g in whole if g.knots is not None}
    at = {i: (np.arange(scales.size), made)}
    return with_known_response(with_extra(point, plain, at, names, scales, tangents)), knots


def with_known_response(problem: Subproblem) -> Subproblem:
    """The problem in which extra regressors that the model's own regressors span have the response of these.

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
