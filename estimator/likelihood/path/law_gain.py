"""The gain in nats of a law with given searched parameters: its amplitudes fitted together with the model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.errors import NotFiniteError
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.likelihood.motion.motion_record import TIME_FOLDS
from estimator.likelihood.response.regressor_set import Regressor, orthogonalised, regressors, with_second_order
from estimator.likelihood.thresholds import LIMITS
from estimator.model.effect import EffectParameter

from .path_fit import PathFit
from .subproblem import Subproblem, subproblem
from .working_point import WorkingPoint

ALL_FOLDS = np.arange(TIME_FOLDS)


def independent_regressors(point: WorkingPoint, placed: LocatedLaw, linear_only: bool = False) -> list[Regressor]:
    """The regressors of a law on trial, without what the regressors of the model span. linear_only : of amplitudes."""
    found = regressors(placed, point.data, point.lin, linear_only)
    found = with_second_order(found, placed, point.fluctuations)
    return [t for t in (orthogonalised(t, point.spans) for t in found) if t is not None]


class LawGain(NamedTuple):
    """The gain of a law on trial.

    gain : nats; 0 where every amplitude is at its limit. problem, fit : with the amplitudes inside their limits.
    spread : by name, standard deviation of every amplitude, SI units.
    """

    gain: float
    problem: Subproblem
    fit: PathFit
    spread: dict[str, float]


class BaseFit(NamedTuple):
    """The model without a law on trial, fitted at some places. level : log-likelihood, nats."""

    problem: Subproblem
    fit: PathFit
    level: float


def base_fit(point: WorkingPoint, places: tuple[int, ...]) -> BaseFit:
    """The fit of the model alone at these places, to which a law on trial is compared."""
    plain = subproblem(point, places)
    fit = plain.fit(steps=3)
    return BaseFit(plain, fit, plain.likelihood(fit, ALL_FOLDS))


def fitted_gain(point: WorkingPoint, placed: LocatedLaw, against: BaseFit | None = None) -> LawGain | None:
    """The gain of a law at given searched parameters, its amplitudes within their limits.

    An amplitude that most such laws do without is left out where it gains less than it costs: beside it the others are
    poorly known where no data are, as a curvature beside a rate of change.

    None where the model spans its regressors already, or where its force is not finite. against : result of
    `base_fit`; None: it is computed.
    """
    try:
        kept = independent_regressors(point, placed, linear_only=True)
    except NotFiniteError:
        return None
    if not kept:
        return None
    problem = subproblem(point, placed.at, point.whitening.whiten(kept))
    plain, base, level = against or base_fit(point, placed.at)
    declared = {placed.name(k): q for k, q in enumerate(placed.effect.parameters)}
    spread: dict[str, float] = {}
    while problem.extra:
        fit = problem.fit(steps=3)
        spread = spread or {n.rsplit(".", 1)[1]: fit.value(n)[1] for n in problem.extra}
        inside = tuple(n for n in problem.extra if _is_needed(declared[n], *fit.value(n)))
        if inside == problem.extra:
            return LawGain(gain=problem.likelihood(fit, ALL_FOLDS) - level, problem=problem, fit=fit, spread=spread)
        problem = problem.only(inside)
    return LawGain(gain=0.0, problem=plain, fit=base, spread=spread)


def _is_needed(q: EffectParameter, value: float, sd: float) -> bool:
    """Whether an amplitude is within its limits, and gains more than its cost if the law is possible without it."""
    return q.low <= value <= q.high and (q.share > 0.0 or value**2 > 2.0 * LIMITS.optional_cost_nats * sd**2)
