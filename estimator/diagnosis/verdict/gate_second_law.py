"""Whether what one law leaves is another law's, of another family or of its own: two missing, not one unknown."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from estimator.diagnosis.hypotheses import gate_shape
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.hypotheses.screen import SEARCH_SECONDS
from estimator.diagnosis.hypotheses.trial import Trial, best_trial, open_locations
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.errors import NotFiniteError
from estimator.identification.residual.missing_force import MissingForce
from estimator.likelihood.fitting.gauss_newton import FIRST_PART_S, fit_model
from estimator.likelihood.motion.located_law import LocatedLaw, acted_on, trial_effects
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part, search_point
from estimator.model.effect import Effect
from estimator.model.rig import Model
from estimator.parallel import map_processes

Trials = dict[str, list[Trial]]
EXPLAINED_MIN_REL = 0.3  # of the nats that smooth columns gain, for a second effect to be what is left
PAIR_FIT_ROUNDS = 6  # of a fit of both
MAX_LAWS, MAX_PAIRS = 3, 2  # of a state, the likeliest, which others are tried beside; pairs of them that are fitted
PAIR_MISFIT_MAX_REL = (
    0.02  # of what is missing in the state of both (rms); beside a saturating spring the best leave 0.04
)
PAIR_MISFIT_MIN_P_VALUE = (
    0.05  # p-value of what they leave, from which it is nothing: a smooth odd curve left 0.03, p 0.02
)
X_FAMILIES = ("odd in x", "even in x")


def law_family(effect: Effect | None) -> str:
    """Family of laws that may take each other's part: "odd in x", "even in x" (in part, too), "damping".

    Any other law is its own family, by its name. "" of an effect that is no force law.
    """
    if effect is None:
        return ""
    if effect.kind == "force" and effect.state == "displacement":
        return "odd in x" if effect.parity == "odd" else "even in x"
    is_damping = effect.kind == "memory" or (effect.kind == "force" and effect.state in ("velocity", "both"))
    return "damping" if is_damping else effect.name


def is_odd_and_even(effect: Effect | None) -> bool:
    """Whether a law of displacement is partly odd and partly even: it may pass for two laws that are one of each."""
    return law_family(effect) == "even in x" and effect is not None and effect.parity == "mixed"


def others(model: Model, after: WorkingPoint, left: MissingForce, best: Entry) -> Trials:
    """Every effect of another family on trial where the first, fitted, acts or leaves something; by name, those that
    are any."""
    small, family = search_point(after, SEARCH_SECONDS), law_family(best.law)
    places = best.places.union(r.place for r in left.residuals if r.found)
    pairs = [
        (effect, location)
        for effect in trial_effects(model)
        if law_family(effect) != family
        for location in open_locations(effect, model, after)
        if places.intersection(acted_on(effect, location, after.data))
    ]
    questions = [partial(best_trial, small, after, model, *pair) for pair in pairs]
    found: Trials = {}
    for trial in map_processes(questions, [effect for effect, _ in pairs]):
        if trial is not None:
            found.setdefault(trial.effect.name, []).append(trial)
    return found


def another_explains(point: WorkingPoint, trials: Trials, left: MissingForce, best: Entry) -> bool:
    """Whether a second effect, of the trials `others`, explains what the first leaves.

    At all its locations together it has to gain what smooth terms in the state of the first do: a one-sided stop has an
    odd half, which takes a part of what an odd law of the wrong shape leaves. Where the first has no single state, as
    hysteresis, it is its own state: beside an odd curve any odd law takes a part.
    """
    found = {r.place: sum(f.gain_nats for f in r.found) for r in left.residuals if r.found}
    smooth = gate_shape.smooth_gains_nats(point, best.law, best.places)
    for own in trials.values():
        earned, asked, seen = 0.0, sum(smooth.values()), False
        for trial in own:
            on = trial.placed.at
            if not {*found, *smooth}.intersection(on):
                continue
            earned += max(trial.gain - trial.df, 0.0)
            asked += 0.0 if smooth else sum(gate_shape.smooth_gains_nats(point, trial.effect, {*on}).values())
            here = sum(found.get(i, 0.0) for i in on)
            seen |= here > 0.0 and trial.gain > EXPLAINED_MIN_REL * here
        if seen and earned >= asked:
            return True
    return False


def of_one_state(
    model: Model, part: WorkingPoint, whole: WorkingPoint, ranking: Sequence[Entry]
) -> tuple[str, str] | None:  # fmt: skip
    """The two laws of the state of the first of a ranking that leave nothing of it, all numbers fitted together, where
    neither does so by itself; the one that is ahead first: any of its family, or of x beside one that is even in it. Of
    a curve that is no law any two of one state take a large part, but not all.

    part, whole : the model fitted to a part of the record and to all of it.
    """
    first = ranking[0]
    if not gate_shape.polynomial_terms(first.law):
        return None
    own = law_family(first.law)
    alike = X_FAMILIES if own == "even in x" else (own,)
    sure = [e for e in ranking if law_family(e.law) in alike and e.p_value < THRESHOLDS.misfit_max_p_value][:MAX_LAWS]
    places = set().union(*(entry.places for entry in sure))
    short, kept = point_on_part(part, FIRST_PART_S), trial_effects(model)
    by_name = {effect.name: effect for effect in kept}
    begun: dict[frozenset[str], Begun] = {}
    for starts in map_processes([partial(_begun, model, short, entry, alike) for entry in sure], kept):
        for start in starts:
            if (
                own in (law_family(by_name[name]) for name in start.names)
                and start.nats > begun.get(start.names, NO_PAIR).nats
            ):
                begun[start.names] = start
    likeliest = sorted(begun.values(), key=lambda one: -one.nats)[:MAX_PAIRS]

    def by(point: WorkingPoint, start: Begun) -> Begun:
        try:
            both = fit_model(point.data, [*point.placed, *start.laws], start=point, rounds=PAIR_FIT_ROUNDS)
        except NotFiniteError:  # far from the rotor
            return start._replace(left=1.0)
        base = {u.key for u in point.placed}
        state = next((by_name[n] for n in start.names if law_family(by_name[n]) == "even in x"), first.law)
        left = gate_shape.misfit_rel(point, both, state, places, PAIR_MISFIT_MIN_P_VALUE) or 0.0
        return Begun(start.names, both.fit.log_likelihood, [u for u in both.placed if u.key not in base], left)

    fitted = map_processes([partial(by, short, start) for start in likeliest], kept)
    for both in sorted(fitted, key=lambda one: one.left):
        for point in (part,) if part is whole else (part, whole):
            both = by(point, both) if both.left <= PAIR_MISFIT_MAX_REL else both
        alone = [both._replace(laws=[u for u in both.laws if u.effect.name == name]) for name in both.names]
        if both.left <= PAIR_MISFIT_MAX_REL and all(by(part, one).left > PAIR_MISFIT_MAX_REL for one in alone):
            ahead = [e.effect for e in ranking if e.effect in both.names]
            behind = sorted(both.names.difference(ahead[:1]))
            return ahead[0], behind[0]
    return None


class Begun(NamedTuple):
    """Two laws and the nats of a fit with both. left : of what is missing in their state (rms)."""

    names: frozenset[str]
    nats: float
    laws: list[LocatedLaw]
    left: float = 1.0


NO_PAIR = Begun(frozenset(), -np.inf, [])


def _begun(model: Model, point: WorkingPoint, entry: Entry, alike: Sequence[str]) -> list[Begun]:
    """Every other law of some families at the places of one, beside it fitted by itself: with the numbers that either
    has without the other a fit of both may end far off."""
    try:
        after = fit_model(point.data, [*point.placed, *entry.placed], start=point, rounds=2)
    except NotFiniteError:
        return []
    small, places = search_point(after, SEARCH_SECONDS), entry.places
    own = {u.key for u in entry.placed}
    firsts = [u for u in after.placed if u.key in own]
    out = []
    for effect in trial_effects(model):
        if effect.name == entry.effect or law_family(effect) not in alike:
            continue
        locations = [
            s for s in open_locations(effect, model, after) if places.issuperset(acted_on(effect, s, after.data))
        ]
        tried = [best_trial(small, after, model, effect, location) for location in locations]
        found = [trial for trial in tried if trial is not None and trial.gain > 0.0]
        nats = after.fit.log_likelihood + sum(trial.gain for trial in found)
        if found:
            out.append(Begun(frozenset({entry.effect, effect.name}), nats, [*firsts, *(t.placed for t in found)]))
    return out
