"""One effect of the catalogue on trial at one spot: its searched parameters, its gain, its cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from scipy.special import chdtrc

from estimator.arrays import Array
from estimator.effects.engine.strength import search_range
from estimator.effects.places import kinematic
from estimator.effects.places import places as canonical_places
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.located_law import (
    FORCE_KINDS,
    LocatedLaw,
    acted_on,
    natural_sizes,
    searched_parameters,
    start_value,
)
from estimator.likelihood.path.law_gain import (
    MIN_OWN_VALUES_GAIN_NATS,
    LawGain,
    base_fit,
    fitted_gain,
    independent_regressors,
)
from estimator.likelihood.path.path_fit import PathFit
from estimator.likelihood.path.subproblem import Subproblem, heldout_gain, subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.effect import Effect
from estimator.model.rig import Model

GRID = {1: 6, 2: 4, 3: 3}  # points per searched parameter, by their number
STEPS, REACH = 3, 0.4  # of Gauss-Newton in searched parameters; largest, of the value
LEAST = 0.5  # nats that a step is to bring
WORTH = 1e-3  # p-value of a trial whose searched parameters are tried at the other spots
NEAR, BEHIND = 0.5, 25.0  # share of the best effect's gain, nats behind it, under which the whole record is not needed
TURNING = ("_cos", "_sin")  # how amplitudes of what goes with the shaft angle end
IDLE = 0.45  # p-value on two fifths of a record from which on the whole of it makes nothing significant (0.6 %)


@dataclass(frozen=True, slots=True)
class Trial:
    """An effect at a spot, fitted. gain : nats on the record, or a part of it; df : parameters paid for.

    heldout : (folds,) nats, of a trial that is judged for good.

    values : name -> (value, sd), SI, amplitudes only by their own fit, those at their limits left out. spread : the
    same sds, of all amplitudes, as far as they are free.
    """

    effect: Effect
    spot: str
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
        """Of the gain, if nothing is there; before counting how many were tried."""
        return float(chdtrc(self.df, 2 * max(self.gain, 0.0)))


def spots(effect: Effect, model: Model, point: WorkingPoint) -> list[str]:
    """Canonical places where a force effect could be added: measured, and not in the model there already."""
    if effect.kind not in FORCE_KINDS or effect.name in PERIODIC_EFFECTS or effect.name == "pedestal":
        return []
    taken = {u.key for u in point.placed}
    return [
        s
        for s in canonical_places(effect, model)
        if f"{s}.{effect.name}" not in taken
        and acted_on(effect, s, point.data)
        and set(point.data.judged).issuperset(acted_on(effect, s, point.data))
    ]


def grid(effect: Effect, model: Model, point: WorkingPoint, i: int, loose: list[int]) -> list[Array]:
    """Parameter vectors to try, amplitudes 1, the searched ones over their natural range."""
    natural = natural_sizes(point.data, i, point.kL[i])
    p = np.array([1.0 if q.linear else start_value(q, natural, model) for q in effect.parameters])
    if not loose:
        return [p]
    axes = []
    for k in loose:
        low, high = search_range(effect.parameters[k], natural)
        count = GRID.get(len(loose), 3)
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


def best_at(point: WorkingPoint, model: Model, effect: Effect, spot: str) -> Trial | None:
    """The best trial of an effect at a spot over the grid of its searched parameters."""
    where = acted_on(effect, spot, point.data)
    loose = searched_parameters(effect, model)
    unknown = [k for k in loose if kinematic(effect.parameters[k].scale, model) is None]
    free = _amplitudes(effect, point)
    best: tuple[LawGain, LocatedLaw] | None = None
    base = base_fit(point, where)
    for p in grid(effect, model, point, where[0], unknown):
        placed = LocatedLaw(effect, f"{spot}.{effect.name}", where, p, free)
        got = fitted_gain(point, placed, against=base)
        if got is not None and (best is None or got.gain > best[0].gain):
            best = (got, placed)
    return None if best is None else _trial(effect, spot, *best, loose)


def _amplitudes(effect: Effect, point: WorkingPoint) -> tuple[bool, ...]:
    """Which parameters a law on trial is proportional to. Of those that go with the shaft angle none where no speed is
    known: at one angle all along, what turns cannot be told from what does not."""
    turns = bool(point.data.phase.any())
    return tuple(q.linear and (turns or not q.name.endswith(TURNING)) for q in effect.parameters)


def _trial(effect: Effect, spot: str, found: LawGain, placed: LocatedLaw, loose: list[int]) -> Trial:
    gained, problem, fit, spread = found
    values = {n.rsplit(".", 1)[1]: fit.value(n) for n in problem.extra}
    p = placed.p.copy()
    for k, q in enumerate(effect.parameters):
        if q.linear:
            p[k] = values.get(q.name, (0.0, 0.0))[0]
    placed = LocatedLaw(
        effect, placed.key, placed.at, p, tuple(q.linear or k in loose for k, q in enumerate(effect.parameters))
    )
    df = max(len(problem.extra) + len(loose), 1)
    if effect.kind == "shaft":  # by what turns: a mean loss alone is a shaft that is softer than the rig file says
        turning = [value / sd for name, (value, sd) in values.items() if name.endswith(TURNING)]
        gained, df = min(gained, 0.5 * float(np.sum(np.square(turning)))), max(len(turning), 1)
    return Trial(effect, spot, placed, gained, df, values, spread, problem, fit)


def contenders(trials: Sequence[Trial]) -> list[bool]:
    """Which trials on part of a record the whole of it could bring to the front, or to significance; and those of the
    runner-up, to be compared."""
    total: dict[str, float] = {}
    for t in trials:
        total[t.effect.name] = total.get(t.effect.name, 0.0) + max(t.gain, 0.0)
    best, second = sorted([0.0, 0.0, *total.values()])[:-3:-1]
    least = min(NEAR * best, best - BEHIND, second)
    return [t.p_value < IDLE and total[t.effect.name] >= least for t in trials]


def refined(point: WorkingPoint, model: Model, trial: Trial) -> Trial:
    """The trial after Gauss-Newton steps in its searched parameters, as long as they gain."""
    for _ in range(STEPS):
        further = _stepped(point, model, trial)
        if further is None or further.gain < trial.gain + LEAST:
            break
        trial = further
    return trial


def judged(trial: Trial) -> Trial:
    """The trial with its gain on held-out folds."""
    idle = np.full(6, min(trial.gain, 0.0) / 6)
    return replace(trial, heldout=heldout_gain(trial.problem) if trial.gain > 2.0 else idle)


def _stepped(point: WorkingPoint, model: Model, trial: Trial) -> Trial | None:
    """The trial after a Gauss-Newton step in its searched parameters; None where it would bring nothing."""
    placed = trial.placed
    kept = independent_regressors(point, placed)
    names = {t.name for t in kept}
    loose = [k for k in searched_parameters(trial.effect, model) if placed.name(k) in names]
    if not loose:
        return None
    fit = subproblem(point, placed.at, point.whitening.whiten(kept)).fit(steps=3)
    if sum(np.divide(*fit.value(placed.name(k))) ** 2 for k in loose) < 2 * LEAST:
        return None  # there already, as far as the nats go
    p = placed.p.copy()
    natural = natural_sizes(point.data, placed.at[0], point.kL[placed.at[0]])
    for k in loose:
        step = float(np.clip(fit.value(placed.name(k))[0], -REACH * abs(p[k]), REACH * abs(p[k])))
        p[k] = np.clip(p[k] + step, *search_range(trial.effect.parameters[k], natural))
    return again(point, model, replace(trial, placed=placed.with_values(p)))


def again(point: WorkingPoint, model: Model, found: Trial) -> Trial | None:
    """A trial found on part of the record, at the same searched parameters on the whole."""
    linear = [q.linear for q in found.effect.parameters]
    p = np.where(linear, 1.0, found.placed.p)
    placed = LocatedLaw(found.effect, found.placed.key, found.placed.at, p, _amplitudes(found.effect, point))
    got = fitted_gain(point, placed)
    return (
        None if got is None else _trial(found.effect, found.spot, got, placed, searched_parameters(found.effect, model))
    )


def borrowed(point: WorkingPoint, model: Model, trials: Sequence[Trial], spots: Sequence[str]) -> list[Trial]:
    """Trials of one effect, with the searched parameters of the best at every spot that has no better ones of its own:
    bearings are alike, and a part of the record may not tell a weak effect's.

    The best is tried with those of the others first: a law of much preload and of little are a few nats apart there.
    """
    out = {t.spot: t for t in trials}
    best = max(trials, key=lambda t: t.gain, default=None)
    loose = [] if best is None else searched_parameters(best.effect, model)
    if best is None or best.p_value > WORTH or not loose:
        return list(trials)

    def moved(trial: Trial, spot: str) -> Trial | None:
        at = acted_on(trial.effect, spot, point.data)
        placed = replace(trial.placed, key=f"{spot}.{trial.effect.name}", at=at)
        return again(point, model, replace(trial, spot=spot, placed=placed))

    def alike(one: Trial, other: Trial) -> bool:
        return bool(np.allclose(one.placed.p[loose], other.placed.p[loose]))

    others = [moved(t, best.spot) for t in trials if not alike(t, best)]
    best = max([best, *(t for t in others if t is not None)], key=lambda t: t.gain)
    out[best.spot] = best

    def lent(spot: str) -> Trial | None:
        own = out.get(spot)
        if own is not None and alike(own, best):
            return own
        new = moved(best, spot)
        return own if new is None or (own is not None and new.gain <= own.gain - MIN_OWN_VALUES_GAIN_NATS) else new

    return [t for t in map(lent, spots) if t is not None]


def tried(small: WorkingPoint, point: WorkingPoint, model: Model, effect: Effect, spot: str) -> Trial | None:
    """An effect at a spot, its searched parameters found on the part `small` of the record, judged on `point`."""
    if not searched_parameters(effect, model):
        return best_at(point, model, effect, spot)
    found = best_at(small, model, effect, spot)
    return None if found is None else again(point, model, found)
