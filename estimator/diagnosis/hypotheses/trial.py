"""One effect of the catalogue on trial at one location: its searched parameters, its gain, its cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from scipy.special import chdtrc

from estimator.arrays import Array
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects.engine.strength import search_range
from estimator.effects.places import kinematic
from estimator.effects.places import places as canonical_places
from estimator.likelihood.motion.located_law import (
    FORCE_KINDS,
    LocatedLaw,
    acted_on,
    natural_sizes,
    searched_parameters,
    start_value,
)
from estimator.likelihood.path.law_gain import LawGain, base_fit, fitted_gain, independent_regressors
from estimator.likelihood.path.path_fit import PathFit
from estimator.likelihood.path.subproblem import Subproblem, heldout_gain, subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.thresholds import LIMITS as LIKELIHOOD_LIMITS
from estimator.model.effect import Effect
from estimator.model.rig import Model

GRID_POINTS = {1: 6, 2: 4, 3: 3}  # points per searched parameter, by the number of searched parameters
SHAFT_ANGLE_SUFFIXES = ("_cos", "_sin")  # of amplitudes that vary with the shaft angle


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """An effect at a location, fitted to a record or a part of it.

    effect : of the catalogue or the user. location : canonical place. placed : the law with its values. gain : nats.
    df : parameters paid for. values : name -> (value, sd), SI, of amplitudes inside their limits. spread : name -> sd
    of all amplitudes, as far as they are free. problem, fit : the least-squares problem and its solution. heldout :
    (folds,) nats, of a trial that is judged.
    """

    effect: Effect
    location: str
    placed: LocatedLaw
    gain: float
    df: int
    values: dict[str, tuple[float, float]]
    spread: dict[str, float]
    problem: Subproblem
    fit: PathFit
    heldout: Array = field(default_factory=lambda: np.zeros(6))

    @property
    def p_value(self) -> float:
        """p-value of the gain if the effect is absent, before correction for the number of trials."""
        return float(chdtrc(self.df, 2 * max(self.gain, 0.0)))


def open_locations(effect: Effect, model: Model, point: WorkingPoint) -> list[str]:
    """Canonical places where a force effect could be added: measured, and not in the model there already.

    A law that refines another one needs that law there: what it adds is what counts.
    """
    if effect.kind not in FORCE_KINDS or effect.found_by != "law":
        return []
    taken = {u.key for u in point.placed}
    return [
        s
        for s in canonical_places(effect, model)
        if f"{s}.{effect.name}" not in taken
        and (effect.refines is None or f"{s}.{effect.refines}" in taken)
        and acted_on(effect, s, point.data)
    ]


def parameter_grid(effect: Effect, model: Model, point: WorkingPoint, i: int, loose: list[int]) -> list[Array]:
    """Parameter vectors to try, amplitudes 1, the searched ones over their natural range."""
    natural = natural_sizes(point.data, i, point.kL[i])
    p = np.array([1.0 if q.linear else start_value(q, natural, model) for q in effect.parameters])
    if not loose:
        return [p]
    axes = []
    for k in loose:
        low, high = search_range(effect.parameters[k], natural)
        count = GRID_POINTS.get(len(loose), 3)
        if low > 0:
            axes.append(np.geomspace(max(low, high / 60), high * 0.8, count))
        elif high > 0:
            up = np.geomspace(high / 40, high * 0.8, count)
            axes.append(np.concatenate([-up[up < -low][::-1], up]) if low < 0 else np.concatenate([[0.0], up]))
        else:
            axes.append(np.linspace(low, high, count))
    out = []
    for values in product(*axes):
        q = p.copy()
        q[loose] = values
        out.append(q)
    return out


def best_on_grid(point: WorkingPoint, model: Model, effect: Effect, location: str) -> Trial | None:
    """The best trial of an effect at a location over the grid of its searched parameters."""
    where = acted_on(effect, location, point.data)
    loose = searched_parameters(effect, model)
    unknown = [k for k in loose if kinematic(effect.parameters[k].scale, model) is None]
    free = _amplitudes(effect, point)
    best: tuple[LawGain, LocatedLaw] | None = None
    base = base_fit(point, where)
    for p in parameter_grid(effect, model, point, where[0], unknown):
        placed = LocatedLaw(effect=effect, key=f"{location}.{effect.name}", at=where, p=p, free=free)
        got = fitted_gain(point, placed, against=base)
        if got is not None and (best is None or got.gain > best[0].gain):
            best = (got, placed)
    return None if best is None else _trial(effect, location, *best, loose)


def _amplitudes(effect: Effect, point: WorkingPoint) -> tuple[bool, ...]:
    """Which parameters of a law on trial are amplitudes. Without a known speed none of a term in the shaft angle is: at
    one constant angle such a term is not identifiable beside the others."""
    turns = bool(point.data.phase.any())
    return tuple(q.linear and (turns or not q.name.endswith(SHAFT_ANGLE_SUFFIXES)) for q in effect.parameters)


def _trial(effect: Effect, location: str, found: LawGain, placed: LocatedLaw, loose: list[int]) -> Trial:
    gained, problem, fit, spread = found
    values = {n.rsplit(".", 1)[1]: fit.value(n) for n in problem.extra}
    p = placed.p.copy()
    for k, q in enumerate(effect.parameters):
        if q.linear:
            p[k] = values.get(q.name, (0.0, 0.0))[0]
    free = [(q.linear and (q.share > 0.0 or q.name in values)) or k in loose for k, q in enumerate(effect.parameters)]
    placed = replace(placed, p=p, free=tuple(free))
    df = max(len(problem.extra) + len(loose), 1)
    if effect.kind == "shaft":  # by terms in the shaft angle: a mean loss alone is a shaft softer than in the rig file
        by_angle = [value / sd for name, (value, sd) in values.items() if name.endswith(SHAFT_ANGLE_SUFFIXES)]
        gained, df = min(gained, 0.5 * float(np.sum(np.square(by_angle)))), max(len(by_angle), 1)
    return Trial(
        effect=effect, location=location, placed=placed, gain=gained, df=df, values=values, spread=spread,
        problem=problem, fit=fit,
    )  # fmt: skip


def are_contenders(trials: Sequence[Trial]) -> list[bool]:
    """Which trials on part of a record could become the best or significant on the whole record.

    Trials of the runner-up count too, for comparison.
    """
    total: dict[str, float] = {}
    for t in trials:
        total[t.effect.name] = total.get(t.effect.name, 0.0) + max(t.gain, 0.0)
    best, second = sorted([0.0, 0.0, *total.values()])[:-3:-1]
    least = min(THRESHOLDS.contender_min_gain_rel * best, best - THRESHOLDS.contender_max_behind_nats, second)
    return [t.p_value < THRESHOLDS.contender_max_p_value and total[t.effect.name] >= least for t in trials]


def refined_trial(point: WorkingPoint, model: Model, trial: Trial) -> Trial:
    """The trial after Gauss-Newton steps in its searched parameters, as long as they gain."""
    for _ in range(THRESHOLDS.max_steps):
        further = _stepped(point, model, trial)
        if further is None or further.gain < trial.gain + THRESHOLDS.step_min_gain_nats:
            break
        trial = further
    return trial


def with_heldout_gain(trial: Trial) -> Trial:
    """The trial with its gain on held-out folds."""
    idle = np.full(6, min(trial.gain, 0.0) / 6)
    return replace(trial, heldout=heldout_gain(trial.problem) if trial.gain > 2.0 else idle)


def _stepped(point: WorkingPoint, model: Model, trial: Trial) -> Trial | None:
    """The trial after a Gauss-Newton step in its searched parameters; None where the step gains nothing."""
    placed = trial.placed
    kept = independent_regressors(point, placed)
    names = {t.name for t in kept}
    loose = [k for k in searched_parameters(trial.effect, model) if placed.name(k) in names]
    if not loose:
        return None
    fit = subproblem(point, placed.at, point.whitening.whiten(kept)).fit(steps=3)
    if sum(np.divide(*fit.value(placed.name(k))) ** 2 for k in loose) < 2 * THRESHOLDS.step_min_gain_nats:
        return None  # there already, as far as the nats go
    p = placed.p.copy()
    natural = natural_sizes(point.data, placed.at[0], point.kL[placed.at[0]])
    for k in loose:
        step = float(
            np.clip(
                fit.value(placed.name(k))[0], -THRESHOLDS.max_step_rel * abs(p[k]), THRESHOLDS.max_step_rel * abs(p[k])
            )
        )
        p[k] = np.clip(p[k] + step, *search_range(trial.effect.parameters[k], natural))
    return repeated_trial(point, model, replace(trial, placed=placed.with_values(p)))


def repeated_trial(point: WorkingPoint, model: Model, found: Trial) -> Trial | None:
    """A trial fitted again on another part of the record, at the searched parameters found; None if the fit fails."""
    linear = [q.linear for q in found.effect.parameters]
    p = np.where(linear, 1.0, found.placed.p)
    placed = replace(found.placed, p=p, free=_amplitudes(found.effect, point))
    got = fitted_gain(point, placed)
    if got is None:
        return None
    return _trial(found.effect, found.location, got, placed, searched_parameters(found.effect, model))


def with_borrowed_parameters(
    point: WorkingPoint, model: Model, trials: Sequence[Trial], locations: Sequence[str]
) -> list[Trial]:
    """Trials of one effect, with the searched parameters of the best trial where a location has no better ones.

    Bearings are alike, and part of the record may not identify the parameters of a weak effect.

    The best is tried with those of the others first: a law of much preload and of little are a few nats apart there.
    """
    out = {t.location: t for t in trials}
    best = max(trials, key=lambda t: t.gain, default=None)
    loose = [] if best is None else searched_parameters(best.effect, model)
    if best is None or best.p_value > THRESHOLDS.borrowed_max_p_value or not loose:
        return list(trials)

    def moved(trial: Trial, location: str) -> Trial | None:
        at = acted_on(trial.effect, location, point.data)
        placed = replace(trial.placed, key=f"{location}.{trial.effect.name}", at=at)
        return repeated_trial(point, model, replace(trial, location=location, placed=placed))

    def are_equal(one: Trial, other: Trial) -> bool:
        return bool(np.allclose(one.placed.p[loose], other.placed.p[loose]))

    others = [moved(t, best.location) for t in trials if not are_equal(t, best)]
    best = max([best, *(t for t in others if t is not None)], key=lambda t: t.gain)
    out[best.location] = best

    def lent(location: str) -> Trial | None:
        old = out.get(location)
        if old is not None and are_equal(old, best):
            return old
        new = moved(best, location)
        least = -np.inf if old is None else old.gain - LIKELIHOOD_LIMITS.min_own_values_gain_nats
        return old if new is None or new.gain <= least else new

    return [t for t in map(lent, locations) if t is not None]


def best_trial(small: WorkingPoint, point: WorkingPoint, model: Model, effect: Effect, location: str) -> Trial | None:
    """An effect at a location, its searched parameters found on the part `small` of the record, judged on `point`."""
    if not searched_parameters(effect, model):
        return best_on_grid(point, model, effect, location)
    found = best_on_grid(small, model, effect, location)
    return None if found is None else repeated_trial(point, model, found)
