"""What of the inferred force can still be predicted, state by state: the missing force.

Groups of flexible columns (black_box.py) enter one after the other, by significance of the likelihood they gain, until
none is significant given the number of groups tried: a complete model is left with nothing, and its missing force is
0. The power of the part found is unbiased: the square of the estimate minus its own noise,

    P = theta' Q theta - tr(Q Cov),    var P = 2 tr (Q Cov)^2 + 4 theta' Q Cov Q theta

with Q the Gram matrix of the found columns per second, freed from what the model's own parameters could take over.
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

LEVEL = 1e-3  # of a group at a place, after counting the groups and places tried
SURVEY_SECONDS = 24.0  # of a long record: enough to see a thousandth of the bearing force
NEGLIGIBLE_FORCE_SHARE = (
    1.2e-3  # of the rms bearing force: below it lie the band limit and the integrators of any simulation
)
UNJUDGED = Message(NOT_JUDGED, "the model cannot be judged: the sensors of all channels clip, use larger ranges")
LEANS = 0.6  # of what drawn motion is off by, that may look like a law: 0.18 to 0.49 of it where 1 to 3 % are drawn
DEGREE = 9  # of the smooth curves
RIDGE = 1e-3  # of a column's own information: keeps hat functions that nothing visits at zero


@dataclass(frozen=True, slots=True)
class FoundGroup:
    """A group found at a place: power in N^2, nats gained, p-value; the fit that holds its coefficients."""

    place: int
    group: str
    power: float
    gain: float
    p_value: float


@dataclass(frozen=True, slots=True)
class PlaceResidual:
    """What is found at one place. P, sd : N^2 of all groups together; problem, fit : the groups found, fitted."""

    place: int
    found: tuple[FoundGroup, ...]
    P: float
    sd: float
    problem: Subproblem
    fit: PathFit
    knots: dict[str, Array]  # of the groups of hat functions, SI
    pool: Subproblem  # every group
    upper: float  # N^2: what could hide from the largest group tested, 95 %


def select_groups(point: WorkingPoint, i: int, orders: tuple[float, ...], tries: int) -> PlaceResidual:
    """Forward selection of groups at place i. tries : groups tested over all places, for the significance.

    Hat functions of a state are tried free, and bound to a smooth curve.
    """
    problem, knots = black_box.group_pool(point, i, orders)
    names: dict[str, tuple[str, ...]] = {}
    for n in problem.extra:
        names[n.split(".")[0]] = (*names.get(n.split(".")[0], ()), n)
    plain = problem.without_extra()
    base = plain.fit()
    everything = np.arange(point.data.fold_blocks.size)
    tries += len(point.data.places) * len(knots)  # the smooth curves
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
                upper = max(upper, _hidden(point, trial, fit, i))
            if name in knots:
                bound, curve, own = fit_polynomial(trial, names[name], knots[name])
                again = bound.likelihood(curve, everything) - level
                bound_p = group_p_value(bound, curve, own, again)
                if bound_p < p:
                    gained, p, fit = again, bound_p, as_hat_functions(trial, bound, curve, names[name], knots[name])
            if best is None or (p, -gained) < (best[4], -best[0]):
                best = (gained, name, trial, fit, p, reached)
        if best is None or min(1.0, best[4] * tries) > LEVEL:
            break
        gained, name, current_new, fitted_new, p, reached = best
        total, _ = extra_power(point, current_new, fitted_new, i)
        if total - power < least:
            break
        current, fitted = current_new, fitted_new
        chosen.append(name)
        level = reached
        found.append(FoundGroup(i, name, max(total - power, 0.0), gained, min(1.0, p * tries)))
        power = max(total, power)
    P, sd = extra_power(point, current, fitted, i) if chosen else (0.0, 0.0)
    return PlaceResidual(i, tuple(found), P, sd, current, fitted, knots, problem, upper)


def negligible_share(point: WorkingPoint, i: int) -> float:
    """Share of the bearing force at a place below which nothing is told of it."""
    return max(NEGLIGIBLE_FORCE_SHARE, LEANS * point.data.unsure(i))


def group_p_value(problem: Subproblem, fit: PathFit, names: tuple[str, ...], gained: float) -> float:
    """p-value of the nats gained by some columns."""
    return float(chdtrc(effective_dof(problem, fit, names), 2 * max(gained, 0.0)))


def fit_polynomial(
    problem: Subproblem, names: tuple[str, ...], knots: Array
) -> tuple[Subproblem, PathFit, tuple[str, ...]]:
    """The last extra columns, hat functions of one state, bound to a polynomial of degree 2 to DEGREE; its fit; names.

    Few parameters see a weak smooth law that is lost among the noise of free hat functions.
    """
    weights = _polynomials(problem, names, knots)
    bound = problem.combined(weights)
    return bound, fit_with_ridge(bound), bound.extra[len(problem.extra) - len(names) :]


def as_hat_functions(
    problem: Subproblem, bound: Subproblem, fit: PathFit, names: tuple[str, ...], knots: Array
) -> PathFit:
    """The fit of the bound problem in terms of the hat functions."""
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
    """(before + DEGREE - 1, extra) the earlier extra columns as they are, then polynomials of the hat functions."""
    u = 3.7 * knots / knots[-1]  # about in rms
    rows = [hermeval(u, np.eye(DEGREE + 1)[d]) / math.sqrt(math.factorial(d)) for d in range(2, DEGREE + 1)]
    own = np.stack(rows) / problem.gram.scales[-len(names) :]
    return np.asarray(block_diag(np.eye(len(problem.extra) - len(names)), own))


def fit_with_ridge(problem: Subproblem) -> PathFit:
    """Fit with a weak prior, RIDGE of the mean information of an extra column."""
    return problem.fit(ridge=ridge_information(problem), steps=6)


def ridge_information(problem: Subproblem) -> float:
    """The prior information that goes with RIDGE."""
    G = problem.gram.G.sum(axis=1)
    n = problem.gram.n.sum(axis=1)
    S = G[:, 0, 0] / n
    own = 2 * np.einsum("ikk->ik", G / S[:, None, None]).sum(axis=0)[1 + len(problem.base) :]
    return RIDGE * float(np.mean(own)) if own.size else 0.0


def effective_dof(problem: Subproblem, fit: PathFit, names: tuple[str, ...]) -> float:
    """Degrees of freedom of some columns: those that the base does not already span."""
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
    return float(max(1.0, np.sum(np.maximum(e, 0) / (np.maximum(e, 0) + RIDGE))))


def freed_gram(problem: Subproblem, fit: PathFit) -> tuple[Array, Array, tuple[str, ...]]:
    """Q (extra, extra), the Gram of the extra columns freed from the base, summed over bins in N^2/Hz units; their
    covariance; and their names."""
    G = problem.gram.G.sum(axis=(0, 1))
    b = len(problem.base)
    Gb, Ge, Gc = G[1 : 1 + b, 1 : 1 + b], G[1 + b :, 1 + b :], G[1 + b :, 1 : 1 + b]
    Q = Ge - Gc @ np.linalg.pinv(Gb, rcond=1e-9) @ Gc.T
    return Q, fit.covariance[b:, b:], problem.extra


def extra_power(point: WorkingPoint, problem: Subproblem, fit: PathFit, i: int) -> tuple[float, float]:
    """Unbiased mean square in N^2 of the extra terms' force at place i, and its standard deviation."""
    Q, cov, _ = freed_gram(problem, fit)
    if not len(Q):
        return 0.0, 0.0
    per_second = point.data.rate_hz / point.data.block / point.data.blocks
    theta = fit.delta[len(problem.base) :]
    QC = Q @ cov
    P = float(theta @ Q @ theta - np.trace(QC)) * per_second
    variance = 2 * np.trace(QC @ QC) + 4 * theta @ QC @ Q @ theta
    return P, float(np.sqrt(max(variance, 0.0))) * per_second


def _hidden(point: WorkingPoint, problem: Subproblem, fit: PathFit, i: int) -> float:
    """Power that a group which was not found could still have, 95 % (normal approximation)."""
    P, sd = extra_power(point, problem, fit, i)
    return max(P, 0.0) + 1.645 * sd


@dataclass(frozen=True, slots=True)
class MissingForce:
    """What is found at every place. bearing : (places,) N rms, 0 where nothing is judged; total of the missing force as
    a share of it."""

    residuals: tuple[PlaceResidual, ...]
    bearing: Array
    shares: tuple[DisturbanceForce, ...] = ()

    def beside(self, others: Sequence[Finding]) -> MissingForce:
        """The survey with findings that no state explains."""
        by_state = {r.place: sum(f.gain for f in r.found) for r in self.residuals}
        # a law that is missing also bends the spectrum of the inferred force: not a second finding
        kept = [
            s
            for s in others
            if s.effect not in SPECTRAL_EFFECTS or all(s.gain_nats > by_state.get(i, 0.0) for i in s.power_N2)
        ]
        return replace(self, shares=tuple(disturbance_forces(kept)))

    def looked_anywhere(self) -> bool:
        """Whether any place was judged: where a sensor is clipped none is."""
        return bool(self.residuals)

    def any_found(self) -> bool:
        return bool(self.shares) or any(r.found for r in self.residuals)

    def places_found(self) -> tuple[int, ...]:
        return tuple(r.place for r in self.residuals if r.found)

    def percent(self, point: WorkingPoint, places: tuple[int, ...] | None = None) -> float:
        """rms of the missing force over the rms bearing force, all places together or some."""
        return self.interval(places)[0]

    def interval(self, places: tuple[int, ...] | None = None) -> tuple[float, float, float]:
        """Value, low, high in per cent: 95 %; where nothing is found, high is what could hide there: all of it where
        nothing was looked at."""
        if not self.looked_anywhere() and not self.shares:
            return 0.0, 0.0, 100.0
        own = [r for r in self.residuals if places is None or r.place in places]
        scale = float(np.sum(self.bearing[list(range(self.bearing.size) if places is None else places)] ** 2))
        P = sum(r.P for r in own) + sum(s.power_N2 for s in self.shares if places is None or s.place in places)
        sd = float(np.sqrt(sum(r.sd**2 for r in own)))
        hidden = sum(r.upper for r in own if not r.found)
        low = P - 1.96 * sd if P > 0 else 0.0
        return tuple(100 * float(np.sqrt(max(z, 0.0) / scale)) for z in (P, low, P + 1.96 * sd + hidden))  # type: ignore[return-value]


def unjudged_messages(found: MissingForce) -> tuple[Message, ...]:
    """What to say of a record of which nothing is judged."""
    return () if found.looked_anywhere() else (UNJUDGED,)


def stiffness_orders(model: Model) -> tuple[float, ...]:
    """Shaft orders at which stiffness is expected to turn: 1, 2 and the ball pass."""
    known = kinematic("bpfo", model)
    return (1.0, 2.0) if known is None else (1.0, 2.0, float(known))


def survey(
    point: WorkingPoint, model: Model, only: tuple[int, ...] | None = None, others: Sequence[Finding] = (),
    seconds: float = SURVEY_SECONDS,
) -> MissingForce:  # fmt: skip
    """Every place (or some; the rest count as explained); `others` are findings that no state explains.

    seconds : of the record to look at.
    """
    point = point_on_part(point, seconds)
    found = map_processes(_questions(point, model, only))
    return MissingForce(tuple(found), _judged(point)).beside(others)


def survey_with(
    point: WorkingPoint, model: Model, others: Callable[[], list[Finding]], *more: Callable[[], Any]
) -> tuple[MissingForce, list[Finding], *tuple[Any, ...]]:
    """The survey of every place, on all of `point`, beside what `others` finds; that; and the answers to what else is
    asked: by two processes."""
    asked: list[Callable[[], Any]] = [others, *more, *_questions(point, model)]  # the longest, as they are, first
    suspects, *found = map_processes(asked)
    own = MissingForce(tuple(found[len(more) :]), _judged(point))
    return own.beside(suspects), suspects, *found[: len(more)]


def _judged(point: WorkingPoint) -> Array:
    """(places,) N rms, bearing force of the places that are judged, 0 at the others."""
    return np.where(np.isin(np.arange(len(point.data.places)), point.data.judged), point.bearing_force, 0.0)


def _questions(
    point: WorkingPoint, model: Model, only: tuple[int, ...] | None = None
) -> list[Callable[[], PlaceResidual]]:
    """What a survey asks at every place (or some), to be answered in any order."""
    places = [i for i in point.data.judged if only is None or i in only]
    tries = len(point.data.places) * len(black_box.GROUP_NAMES)
    return [partial(select_groups, point, i, stiffness_orders(model), tries) for i in places]
