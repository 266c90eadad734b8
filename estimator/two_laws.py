"""Whether what one law leaves is another law's, of another family or of its own: two missing, not one unknown."""

from __future__ import annotations

from functools import partial

from . import adequacy, missing_force, screen
from .evidence import Entry
from .model import Model
from .model_fit import FIRST_SECONDS, fit_model
from .model_uses import acting, on_trial
from .ranking import SEARCH_SECONDS
from .screen import Trial
from .side_by_side import answers
from .working_point import WorkingPoint, plain, thinned

Trials = dict[str, list[Trial]]
EXPLAINS = 0.3  # of the nats that smooth columns gain, for a second effect to be what is left
ROUNDS, TRIED = 6, 2  # of a fit of both; seconds that are fitted, as a coarse grid may put the wrong one first
FAMILY = {
    "cubic": "odd in x", "quintic": "odd in x", "clearance": "odd in x", "hertz": "odd in x",
    "quadratic": "even in x", "stop": "even in x",
    "coulomb": "damping", "quadratic_damping": "damping", "displacement_damping": "damping", "bouc_wen": "damping",
}  # fmt: skip
OF_X = ("odd in x", "even in x")


def beside(model: Model, after: WorkingPoint, left: missing_force.Survey, best: Entry) -> Trials:
    """Every other effect on trial where the first, fitted, acts or leaves something; by name, those that are any."""
    small = plain(after, SEARCH_SECONDS)
    places = _places(best).union(r.place for r in left.residuals if r.found)
    pairs = [
        (effect, spot)
        for effect in on_trial(model)
        if effect.name != best.effect
        for spot in screen.spots(effect, model, after)
        if places.intersection(acting(effect, spot, after.data))
    ]
    questions = [partial(screen.tried, small, after, model, *pair) for pair in pairs]
    found: Trials = {}
    for trial in answers(questions, [effect for effect, _ in pairs]):
        if trial is not None:
            found.setdefault(trial.effect.name, []).append(trial)
    return found


def another_explains(point: WorkingPoint, trials: Trials, left: missing_force.Survey, best: Entry) -> bool:
    """Whether a second effect, of another family, explains what the first leaves.

    At all its spots together it is to earn what smooth terms in the state of the first do: a one-sided stop has an odd
    half, which takes a part of what an odd law of the wrong shape leaves. Where the first has no single state, as
    hysteresis, it is its own state: beside an odd curve any odd law takes a part.
    """
    family = FAMILY.get(best.effect, best.effect)
    found = {r.place: sum(f.gain for f in r.found) for r in left.residuals if r.found}
    smooth = adequacy.worth(point, best.effect, _places(best))
    for name, own in trials.items():
        if FAMILY.get(name, name) == family:
            continue
        earned, asked, seen = 0.0, sum(smooth.values()), False
        for trial in own:
            on = trial.placed.at
            if not {*found, *smooth}.intersection(on):
                continue
            earned += max(trial.gain - trial.df, 0.0)
            asked += 0.0 if smooth else sum(adequacy.worth(point, name, {*on}).values())
            here = sum(found.get(i, 0.0) for i in on)
            seen |= here > 0.0 and trial.gain > EXPLAINS * here
        if seen and earned >= asked:
            return True
    return False


def of_its_state(
    before: tuple[WorkingPoint, WorkingPoint], after: WorkingPoint, trials: Trials, best: Entry
) -> str | None:  # fmt: skip
    """The law of the family of the first that leaves nothing of its state beside it, all numbers fitted together; any
    law of x beside one that is not odd in it, whose state is all of x.

    before : fits of a part and of the whole record without the first; after : with it, of the part. Of a curve that is
    no law any two of one state take a large part, but not all.
    """
    if best.effect not in adequacy.STATES:
        return None
    own = FAMILY[best.effect]
    alike = OF_X if own == "even in x" else (own,)
    places = _places(best)
    found = {
        name: [t for t in tried if places.issuperset(t.placed.at) and t.p_value < adequacy.LEVEL]
        for name, tried in trials.items()
        if FAMILY.get(name) in alike
    }
    part, whole = before
    base = {u.key for u in whole.placed}
    firsts = [u for u in after.placed if u.key not in base]
    gains = {name: sum(t.gain for t in tried) for name, tried in found.items() if tried}
    short = thinned(part, FIRST_SECONDS)
    stages = [point for point, longer in ((short, part), (part, whole)) if point is not longer]
    for second in sorted(gains, key=lambda name: -gains[name])[:TRIED]:
        laws, near = [*firsts, *(t.placed for t in found[second])], None
        for point in (*stages, whole):  # as long as nothing is left
            both = fit_model(point.data, [*point.placed, *laws], start=near or point, rounds=ROUNDS)
            if adequacy.left(point, both, best.effect, places) != 0.0:  # a saturating spring, 4 %
                break
            near, laws = both, [u for u in both.placed if u.key not in base]
        else:
            return second
    return None


def _places(entry: Entry) -> set[int]:
    return {i for p in entry.placed for i in p.at}
