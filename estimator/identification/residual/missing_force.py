"""The missing force: the part of the residual force that a flexible black box can still predict from a state.

Groups of regressors enter one after the other, the most significant first, until no group is significant after a
correction for the number of groups tried. Of a complete model no group enters, and its missing force is 0. The estimate
of the power found is unbiased, as the power of the estimate's own noise is subtracted:

    P = theta' Q theta - tr(Q Cov),    var P = 2 tr (Q Cov)^2 + 4 theta' Q Cov Q theta

Q is the Gram matrix per second of the regressors found, after projection on the complement of the model's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from estimator.arrays import Array
from estimator.effects.places import kinematic
from estimator.identification.finding import DisturbanceForce, Finding, disturbance_forces, is_cause_of_spectrum
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.path.path_fit import PathFit
from estimator.likelihood.path.subproblem import Subproblem
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model
from estimator.parallel import map_processes

from . import black_box
from .group_fit import as_hat_functions, extra_power, fit_polynomial, fit_with_ridge, group_p_value, hidden_power
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundGroup:
    """A group of regressors that a location's residual force follows.

    Attributes
    ----------
    group : str
        Name of the group, one of the black box's `GROUP_NAMES`.
    power_N2 : float
        Mean square of the force that the group adds to those found before it, N^2.
    gain_nats : float
        Log-likelihood that it adds, nats.
    """

    group: str
    power_N2: float
    gain_nats: float


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


class TriedGroup(NamedTuple):
    """A group on trial: nats gained, its name, the problem with it and the fit, p-value, log-likelihood, N^2 limit."""

    gain_nats: float
    name: str
    problem: Subproblem
    fit: PathFit
    p_value: float
    log_likelihood: float
    hidden_N2: float


def select_groups(point: WorkingPoint, i: int, orders: tuple[float, ...]) -> PlaceResidual:
    """Groups that the residual force at location i follows, by forward selection.

    orders : of the shaft, at which stiffness may vary.
    """
    problem, knots = black_box.group_pool(point, i, orders)
    names: dict[str, tuple[str, ...]] = {}
    for n in problem.extra:
        names[n.split(".")[0]] = (*names.get(n.split(".")[0], ()), n)
    plain = problem.without_extra()
    current, fitted, power = plain, plain.fit(), 0.0
    tries = len(point.data.places) * (len(black_box.GROUP_NAMES) + len(knots))  # hat functions as polynomials too
    level = plain.likelihood(fitted, np.arange(point.data.fold_blocks.size))
    found: list[FoundGroup] = []
    least = _negligible_power(point, i)
    upper = 0.0
    while len(found) < len(names):
        chosen = [group.group for group in found]
        tried = [_try_group(point, i, problem, chosen, n, names, knots, level) for n in names if n not in chosen]
        if not chosen:
            upper = max(upper, *(group.hidden_N2 for group in tried))
        best = min(tried, key=lambda group: (group.p_value, -group.gain_nats))
        if best.p_value * tries > LIMITS.max_group_p_value:
            break
        total, _ = extra_power(point, best.problem, best.fit)
        if total - power < least:
            break
        current, fitted, level = best.problem, best.fit, best.log_likelihood
        more = max(total - power, 0.0)
        found.append(FoundGroup(group=best.name, power_N2=more, gain_nats=best.gain_nats))
        power = max(total, power)
    P, sd = extra_power(point, current, fitted) if found else (0.0, 0.0)
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


def negligible_force_share(data: MotionRecord) -> float:
    """Share of the rms bearing force below which no force is claimed."""
    beside_modes = data.background is not None
    return LIMITS.negligible_force_share_beside_modes if beside_modes else LIMITS.negligible_force_share


def _negligible_power(point: WorkingPoint, i: int) -> float:
    """Mean square, N^2, of a force at location i that errors of the processing or of a background may cause."""
    least = (negligible_force_share(point.data) * point.bearing_force[i]) ** 2
    if point.data.background is None:
        return float(least)
    width_hz = point.data.bins.size * point.data.rate_hz / point.data.block
    excitation = point.S[i] * np.mean(point.data.excitation_shape[i]) * width_hz
    return float(max(least, LIMITS.negligible_excitation_share**2 * excitation))


def _try_group(
    point: WorkingPoint, i: int, problem: Subproblem, chosen: Sequence[str], name: str,
    names: Mapping[str, tuple[str, ...]], knots: Mapping[str, Array], level: float,
) -> TriedGroup:  # fmt: skip
    """A group on trial together with those chosen. Hat functions of a state are tried free and bound to a polynomial.

    names : of the regressors, by group. level : log-likelihood of the groups chosen.
    """
    everything = np.arange(point.data.fold_blocks.size)
    trial = problem.only(tuple(n for group in [*chosen, name] for n in names[group]))
    fit = fit_with_ridge(trial)
    reached = trial.likelihood(fit, everything)
    gained, p = reached - level, group_p_value(trial, fit, names[name], reached - level)
    hidden = 0.0 if chosen else hidden_power(point, trial, fit)
    if name in knots:
        bound, curve, own = fit_polynomial(trial, names[name], knots[name])
        again = bound.likelihood(curve, everything) - level
        bound_p = group_p_value(bound, curve, own, again)
        if bound_p < p:
            gained, p, fit = again, bound_p, as_hat_functions(trial, bound, curve, names[name], knots[name])
    return TriedGroup(
        gain_nats=gained, name=name, problem=trial, fit=fit, p_value=p, log_likelihood=reached, hidden_N2=hidden
    )


@dataclass(frozen=True, slots=True)
class MissingForce:
    """The force that a model lacks: its predictable part at every location, and what no state explains.

    Attributes
    ----------
    residuals : tuple of PlaceResidual
        One per location.
    bearing_force_N : (places,) float64
        Rms of the bearing force, N.
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
            """Whether a finding is distinct from a missing law, which shapes the spectrum of the residual force too."""
            return not is_cause_of_spectrum(f.effect) or all(f.gain_nats > by_state.get(i, 0.0) for i in f.power_N2)

        return replace(self, disturbances=tuple(disturbance_forces([f for f in others if counts(f)])))

    def any_found(self) -> bool:
        """Whether any force is missing."""
        return bool(self.disturbances) or any(r.found for r in self.residuals)

    def places_found(self) -> tuple[int, ...]:
        """Indices of locations whose residual force follows a state."""
        return tuple(r.place for r in self.residuals if r.found)

    def interval(self, places: tuple[int, ...] | None = None) -> tuple[float, float, float]:
        """Rms of the missing force and its 95 % limits, per cent of the rms bearing force.

        Where nothing is found, the upper limit is the force that could hide there.
        """
        at = range(self.bearing_force_N.size) if places is None else places
        own = [r for r in self.residuals if r.place in at]
        scale = float(np.sum(self.bearing_force_N[list(at)] ** 2))
        P = sum(r.power_N2 for r in own) + sum(s.power_N2 for s in self.disturbances if s.place in at)
        sd = float(np.sqrt(sum(r.power_sd_N2**2 for r in own)))
        hidden = sum(r.hidden_N2 for r in own if not r.found)
        low = P - 1.96 * sd if P > 0 else 0.0
        return tuple(100 * float(np.sqrt(max(z, 0.0) / scale)) for z in (P, low, P + 1.96 * sd + hidden))  # type: ignore[return-value]


def stiffness_orders(model: Model) -> tuple[float, ...]:
    """Shaft orders at which stiffness is expected to vary: 1, 2 and the ball pass."""
    known = kinematic("bpfo", model)
    return (1.0, 2.0) if known is None else (1.0, 2.0, float(known))


def survey_seconds(rate_hz: float) -> float:
    """Length of the part of a record that is surveyed, s."""
    return max(LIMITS.survey_s, LIMITS.survey_rows / rate_hz)


def survey(
    point: WorkingPoint, model: Model, only: tuple[int, ...] | None = None, others: Sequence[Finding] = ()
) -> MissingForce:
    """The missing force of a model, from the first `survey_seconds` of a record.

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

    Returns
    -------
    MissingForce
        Groups of regressors found at each location, and the forces of the findings.
    """
    point = point_on_part(point, survey_seconds(point.data.rate_hz))
    found = map_processes(_group_selections(point, model, only))
    return MissingForce(tuple(found), point.bearing_force).with_findings(others)


def survey_with(
    point: WorkingPoint, model: Model, others: Callable[[], list[Finding]], *more: Callable[[], Any]
) -> tuple[MissingForce, list[Finding], *tuple[Any, ...]]:
    """The missing force on all of the record with the findings of `others`, these findings, and the results of `more`.

    All are computed by two processes.
    """
    asked: list[Callable[[], Any]] = [others, *more, *_group_selections(point, model)]  # longest first
    findings, *found = map_processes(asked)
    own = MissingForce(tuple(found[len(more) :]), point.bearing_force)
    return own.with_findings(findings), findings, *found[: len(more)]


def _group_selections(
    point: WorkingPoint, model: Model, only: tuple[int, ...] | None = None
) -> list[Callable[[], PlaceResidual]]:
    """The selection of groups at every location, as calls in any order."""
    places = [i for i in range(len(point.data.places)) if only is None or i in only]
    return [partial(select_groups, point, i, stiffness_orders(model)) for i in places]
