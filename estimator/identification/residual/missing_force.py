"""The missing force: the part of the residual force that a flexible black box can still predict from a state.

Groups of regressors enter one after the other, the most significant first, until no group is significant after a
correction for the number of groups tried. Of a complete model no group enters, and its missing force is 0. The estimate
of the power found is unbiased, as the power of the estimate's own noise is subtracted:

    P = theta' Q theta - tr(Q Cov),    var P = 2 tr (Q Cov)^2 + 4 theta' Q Cov Q theta

Q is the Gram matrix per second of the regressors found, after projection on the complement of the model's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.polynomial.hermite_e import hermeval
from scipy.linalg import block_diag
from scipy.special import chdtrc

from estimator.arrays import Array
from estimator.effects.places import kinematic
from estimator.identification.finding import SPECTRAL_EFFECTS, DisturbanceForce, Finding, disturbance_forces
from estimator.likelihood.path.path_fit import PathFit
from estimator.likelihood.path.subproblem import Subproblem
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model
from estimator.parallel import map_processes
from estimator.results import NOT_JUDGED, Message

from . import black_box

MAX_GROUP_P_VALUE = 1e-3  # of a group at a location, after correction for the groups and locations tried
SURVEY_S = 24.0  # of a long record: enough to see a thousandth of the bearing force
NEGLIGIBLE_FORCE_SHARE = 1.2e-3  # of the rms bearing force: errors of band limit and integrators are smaller
UNJUDGED_MESSAGE = Message(
    NOT_JUDGED, "the model cannot be judged: the sensors of all channels clip, use larger ranges"
)
LAW_LIKE_ERROR_SHARE = 0.6  # of the error of restored motion, that may look like a law (0.18 to 0.49 at 1 to 3 %)
POLYNOMIAL_DEGREE = 9  # of the smooth curves
RIDGE_SHARE = 1e-3  # of a regressor's own information: holds hat functions without samples at zero


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundGroup:
    """A group of regressors that a location's residual force follows.

    Attributes
    ----------
    place : int
        Index of the location in the motion record.
    group : str
        Name of the group, one of the black box's `GROUP_NAMES`.
    power_N2 : float
        Mean square of the force that the group adds to those found before it, N^2.
    gain_nats : float
        Log-likelihood that it adds, nats.
    p_value : float
        After a correction for the groups and locations tried.
    """

    place: int
    group: str
    power_N2: float
    gain_nats: float
    p_value: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceResidual:
    """The predictable part of the residual force at one location.

    Attributes
    ----------
    place : int
        Index of the location in the motion record.
    found : tuple of FoundGroup
        Significant groups in the order of their selection.
    power_N2, power_sd_N2 : float
        Mean square of the force of all groups found, N^2, and its standard deviation.
    problem, fit : Subproblem, PathFit
        The model with the groups found, and its fit.
    knots : dict of str to (k,) float64
        Knots of the groups of hat functions, m or m/s, by name of the group.
    pool : Subproblem
        The model with every group.
    hidden_N2 : float
        Upper 95 % limit of the power that the largest group tested could have, N^2.
    """

    place: int
    found: tuple[FoundGroup, ...]
    power_N2: float
    power_sd_N2: float
    problem: Subproblem
    fit: PathFit
    knots: dict[str, Array]
    pool: Subproblem
    hidden_N2: float


def select_groups(point: WorkingPoint, i: int, orders: tuple[float, ...], tries: int) -> PlaceResidual:
    """Groups that the residual force at location i follows, by forward selection.

    orders : of the shaft, at which stiffness may vary. tries : groups tested at all locations, for the significance.
    Hat functions of a state are tried free and bound to a polynomial.
    """
    problem, knots = black_box.group_pool(point, i, orders)
    names: dict[str, tuple[str, ...]] = {}
    for n in problem.extra:
        names[n.split(".")[0]] = (*names.get(n.split(".")[0], ()), n)
    plain = problem.without_extra()
    base = plain.fit()
    everything = np.arange(point.data.fold_blocks.size)
    tries += len(point.data.places) * len(knots)  # the polynomials
    level = plain.likelihood(base, everything)
    chosen: list[str] = []
    found: list[FoundGroup] = []
    fitted, power = base, 0.0
    current = plain
    least = (negligible_share(point, i) * point.bearing_force[i]) ** 2
    upper = least if point.data.unsure(i) else 0.0
    while len(chosen) < len(names):
        best: tuple[float, str, Subproblem, PathFit, float, float] | None = None
        for name in names:
            if name in chosen:
                continue
            trial = problem.only(tuple(n for g in [*chosen, name] for n in names[g]))
            fit = fit_with_ridge(trial)
            reached = trial.likelihood(fit, everything)
            gained, p = reached - level, group_p_value(trial, fit, names[name], reached - level)
            if not chosen:
                upper = max(upper, _hidden_power(point, trial, fit, i))
            if name in knots:
                bound, curve, own = fit_polynomial(trial, names[name], knots[name])
                again = bound.likelihood(curve, everything) - level
                bound_p = group_p_value(bound, curve, own, again)
                if bound_p < p:
                    gained, p, fit = again, bound_p, as_hat_functions(trial, bound, curve, names[name], knots[name])
            if best is None or (p, -gained) < (best[4], -best[0]):
                best = (gained, name, trial, fit, p, reached)
        if best is None or min(1.0, best[4] * tries) > MAX_GROUP_P_VALUE:
            break
        gained, name, current_new, fitted_new, p, reached = best
        total, _ = extra_power(point, current_new, fitted_new, i)
        if total - power < least:
            break
        current, fitted = current_new, fitted_new
        chosen.append(name)
        level = reached
        found.append(
            FoundGroup(
                place=i, group=name, power_N2=max(total - power, 0.0), gain_nats=gained, p_value=min(1.0, p * tries)
            )
        )
        power = max(total, power)
    P, sd = extra_power(point, current, fitted, i) if chosen else (0.0, 0.0)
    return PlaceResidual(
        place=i,
        found=tuple(found),
        power_N2=P,
        power_sd_N2=sd,
        problem=current,
        fit=fitted,
        knots=knots,
        pool=problem,
        hidden_N2=upper,
    )


def negligible_share(point: WorkingPoint, i: int) -> float:
    """Share of the rms bearing force at location i below which a missing force is not claimed."""
    return max(NEGLIGIBLE_FORCE_SHARE, LAW_LIKE_ERROR_SHARE * point.data.unsure(i))


def group_p_value(problem: Subproblem, fit: PathFit, names: tuple[str, ...], gained: float) -> float:
    """p-value of the log-likelihood (nats) that the named regressors gain."""
    return float(chdtrc(effective_dof(problem, fit, names), 2 * max(gained, 0.0)))


def fit_polynomial(
    problem: Subproblem, names: tuple[str, ...], knots: Array
) -> tuple[Subproblem, PathFit, tuple[str, ...]]:
    """The problem with hat functions bound to polynomials of degree 2 to 9, its fit, and the names of the polynomials.

    names : of the last extra regressors, hat functions of one state at the knots (k,). A weak smooth law that is lost
    in the noise of free hat functions is significant with few parameters.
    """
    weights = _polynomials(problem, names, knots)
    bound = problem.combined(weights)
    return bound, fit_with_ridge(bound), bound.extra[len(problem.extra) - len(names) :]


def as_hat_functions(
    problem: Subproblem, bound: Subproblem, fit: PathFit, names: tuple[str, ...], knots: Array
) -> PathFit:
    """The fit of a problem bound to polynomials, expressed in the free hat functions."""
    M = block_diag(np.eye(len(problem.base)), _polynomials(problem, names, knots))
    delta, covariance = fit.delta @ M, M.T @ fit.covariance @ M
    return PathFit(
        names=problem.gram.names,
        delta=delta,
        covariance=covariance,
        S=fit.S,
        log_likelihood=fit.log_likelihood,
        scales=problem.gram.scales,
    )


def _polynomials(problem: Subproblem, names: tuple[str, ...], knots: Array) -> Array:
    """(earlier + 8, extra) weights: earlier extra regressors unchanged, then polynomials of the hat functions."""
    u = 3.7 * knots / knots[-1]  # about in rms
    rows = [
        hermeval(u, np.eye(POLYNOMIAL_DEGREE + 1)[d]) / math.sqrt(math.factorial(d))
        for d in range(2, POLYNOMIAL_DEGREE + 1)
    ]
    own = np.stack(rows) / problem.gram.scales[-len(names) :]
    return np.asarray(block_diag(np.eye(len(problem.extra) - len(names)), own))


def fit_with_ridge(problem: Subproblem) -> PathFit:
    """Fit with a weak prior on the extra regressors."""
    return problem.fit(ridge=ridge_information(problem), steps=6)


def ridge_information(problem: Subproblem) -> float:
    """Information of the weak prior: `RIDGE_SHARE` of the mean information of an extra regressor."""
    G = problem.gram.G.sum(axis=1)
    n = problem.gram.n.sum(axis=1)
    S = G[:, 0, 0] / n
    own = 2 * np.einsum("ikk->ik", G / S[:, None, None]).sum(axis=0)[1 + len(problem.base) :]
    return RIDGE_SHARE * float(np.mean(own)) if own.size else 0.0


def effective_dof(problem: Subproblem, fit: PathFit, names: tuple[str, ...]) -> float:
    """Degrees of freedom of the named regressors that the others do not span."""
    Q, _, index = freed_gram(problem, fit)
    whole = np.einsum("ifkk->k", problem.gram.G)[1 + len(problem.base) :]
    at = [index.index(n) for n in names if n in index]
    others = [k for k in range(len(index)) if k not in at]
    A = Q[np.ix_(at, at)]
    if others:
        B = Q[np.ix_(at, others)]
        A = A - B @ np.linalg.pinv(Q[np.ix_(others, others)], rcond=1e-6) @ B.T
    d = np.sqrt(np.maximum(whole[at], 1e-300))
    e = np.linalg.eigvalsh(A / np.multiply.outer(d, d))
    return float(max(1.0, np.sum(np.maximum(e, 0) / (np.maximum(e, 0) + RIDGE_SHARE))))


def freed_gram(problem: Subproblem, fit: PathFit) -> tuple[Array, Array, tuple[str, ...]]:
    """Gram matrix (extra, extra) of the extra regressors, N^2/Hz, projected on the complement of the base; the
    covariance (extra, extra) of their coefficients; and their names."""
    G = problem.gram.G.sum(axis=(0, 1))
    b = len(problem.base)
    Gb, Ge, Gc = G[1 : 1 + b, 1 : 1 + b], G[1 + b :, 1 + b :], G[1 + b :, 1 : 1 + b]
    Q = Ge - Gc @ np.linalg.pinv(Gb, rcond=1e-9) @ Gc.T
    return Q, fit.covariance[b:, b:], problem.extra


def extra_power(point: WorkingPoint, problem: Subproblem, fit: PathFit, i: int) -> tuple[float, float]:
    """Unbiased mean square of the force of the extra regressors at location i, N^2, and its standard deviation."""
    Q, cov, _ = freed_gram(problem, fit)
    if not len(Q):
        return 0.0, 0.0
    per_second = point.data.rate_hz / point.data.block / point.data.blocks
    theta = fit.delta[len(problem.base) :]
    QC = Q @ cov
    P = float(theta @ Q @ theta - np.trace(QC)) * per_second
    variance = 2 * np.trace(QC @ QC) + 4 * theta @ QC @ Q @ theta
    return P, float(np.sqrt(max(variance, 0.0))) * per_second


def _hidden_power(point: WorkingPoint, problem: Subproblem, fit: PathFit, i: int) -> float:
    """Upper 95 % limit of the power (N^2) of a group that was not found, by the normal approximation."""
    P, sd = extra_power(point, problem, fit, i)
    return max(P, 0.0) + 1.645 * sd


@dataclass(frozen=True, slots=True)
class MissingForce:
    """The force that a model lacks: its predictable part at every location, and what no state explains.

    Attributes
    ----------
    residuals : tuple of PlaceResidual
        One per judged location.
    bearing_force_N : (places,) float64
        Rms of the bearing force, N; 0 where nothing is judged.
    disturbances : tuple of DisturbanceForce
        Forces of findings that no state explains.
    """

    residuals: tuple[PlaceResidual, ...]
    bearing_force_N: Array
    disturbances: tuple[DisturbanceForce, ...] = ()

    def with_findings(self, others: Sequence[Finding]) -> MissingForce:
        """The missing force with findings that no state explains."""
        by_state = {r.place: sum(f.gain_nats for f in r.found) for r in self.residuals}

        def counts(f: Finding) -> bool:
            """Whether a finding is one of its own: a missing law shapes the spectrum of the residual force too."""
            return f.effect not in SPECTRAL_EFFECTS or all(f.gain_nats > by_state.get(i, 0.0) for i in f.power_N2)

        return replace(self, disturbances=tuple(disturbance_forces([f for f in others if counts(f)])))

    def looked_anywhere(self) -> bool:
        """Whether any location was judged. Locations of clipped sensors are not."""
        return bool(self.residuals)

    def any_found(self) -> bool:
        """Whether any force is missing."""
        return bool(self.disturbances) or any(r.found for r in self.residuals)

    def places_found(self) -> tuple[int, ...]:
        """Indices of locations whose residual force follows a state."""
        return tuple(r.place for r in self.residuals if r.found)

    def percent(self, point: WorkingPoint, places: tuple[int, ...] | None = None) -> float:
        """Rms of the missing force, per cent of the rms bearing force, over all locations or some."""
        return self.interval(places)[0]

    def interval(self, places: tuple[int, ...] | None = None) -> tuple[float, float, float]:
        """Rms of the missing force and its 95 % limits, per cent of the rms bearing force.

        Where nothing is found, the upper limit is the force that could hide there; it is 100 where nothing was judged.
        """
        if not self.looked_anywhere() and not self.disturbances:
            return 0.0, 0.0, 100.0
        at = range(self.bearing_force_N.size) if places is None else places
        own = [r for r in self.residuals if r.place in at]
        scale = float(np.sum(self.bearing_force_N[list(at)] ** 2))
        P = sum(r.power_N2 for r in own) + sum(s.power_N2 for s in self.disturbances if s.place in at)
        sd = float(np.sqrt(sum(r.power_sd_N2**2 for r in own)))
        hidden = sum(r.hidden_N2 for r in own if not r.found)
        low = P - 1.96 * sd if P > 0 else 0.0
        return tuple(100 * float(np.sqrt(max(z, 0.0) / scale)) for z in (P, low, P + 1.96 * sd + hidden))  # type: ignore[return-value]


def unjudged_messages(found: MissingForce) -> tuple[Message, ...]:
    """The message on a record of which no location is judged; empty otherwise."""
    return () if found.looked_anywhere() else (UNJUDGED_MESSAGE,)


def stiffness_orders(model: Model) -> tuple[float, ...]:
    """Shaft orders at which stiffness is expected to vary: 1, 2 and the ball pass."""
    known = kinematic("bpfo", model)
    return (1.0, 2.0) if known is None else (1.0, 2.0, float(known))


def survey(
    point: WorkingPoint, model: Model, only: tuple[int, ...] | None = None, others: Sequence[Finding] = (),
    seconds: float = SURVEY_S,
) -> MissingForce:  # fmt: skip
    """The missing force of a model, from part of a long record.

    Parameters
    ----------
    point : WorkingPoint
        The model fitted to the record.
    model : Model
        The rig, for the shaft orders of its stiffness.
    only : tuple of int or None
        Indices of the locations to judge; None judges all. The others count as explained.
    others : sequence of Finding
        Findings that no state explains.
    seconds : float
        Length of the part of the record that is used, s.

    Returns
    -------
    MissingForce
        Groups of regressors found at each location, and the forces of the findings.
    """
    point = point_on_part(point, seconds)
    found = map_processes(_group_selections(point, model, only))
    return MissingForce(tuple(found), _judged_bearing_force(point)).with_findings(others)


def survey_with(
    point: WorkingPoint, model: Model, others: Callable[[], list[Finding]], *more: Callable[[], Any]
) -> tuple[MissingForce, list[Finding], *tuple[Any, ...]]:
    """The missing force on all of the record with the findings of `others`, these findings, and the answers of `more`.

    All are computed by two processes.
    """
    asked: list[Callable[[], Any]] = [others, *more, *_group_selections(point, model)]  # longest first
    findings, *found = map_processes(asked)
    own = MissingForce(tuple(found[len(more) :]), _judged_bearing_force(point))
    return own.with_findings(findings), findings, *found[: len(more)]


def _judged_bearing_force(point: WorkingPoint) -> Array:
    """(places,) rms of the bearing force at judged locations, N; 0 at the others."""
    return np.where(np.isin(np.arange(len(point.data.places)), point.data.judged), point.bearing_force, 0.0)


def _group_selections(
    point: WorkingPoint, model: Model, only: tuple[int, ...] | None = None
) -> list[Callable[[], PlaceResidual]]:
    """The selection of groups at every judged location, as calls in any order."""
    places = [i for i in point.data.judged if only is None or i in only]
    tries = len(point.data.places) * len(black_box.GROUP_NAMES)
    return [partial(select_groups, point, i, stiffness_orders(model), tries) for i in places]
