"""Whether what one law leaves is another law's, of another family or of its own: two missing, not one unknown."""

from __future__ import annotations

from . import adequacy, missing_force, screen
from .evidence import Entry
from .model import Model
from .model_fit import fit_model
from .model_uses import acting, on_trial
from .ranking import SEARCH_SECONDS
from .working_point import WorkingPoint, plain, thinned

EXPLAINS = 0.3  # of the nats that smooth columns gain, for a second effect to be what is left
ROUNDS, TRIED = 6, 2  # of a fit of both; seconds that are fitted, as a coarse grid may put the wrong one first
FAMILY = {
    "cubic": "odd in x", "quintic": "odd in x", "clearance": "odd in x", "hertz": "odd in x",
    "quadratic": "even in x", "stop": "even in x",
    "coulomb": "damping", "quadratic_damping": "damping", "displacement_damping": "damping", "bouc_wen": "damping",
}  # fmt: skip
OF_X = ("odd in x", "even in x")


def another_explains(model: Model, point: WorkingPoint, left: missing_force.Survey, best: Entry) -> bool:
    """Whether a second effect, of another family, explains what the first leaves.

    At all its spots together it is to earn what smooth terms in the state of the first do: a one-sided stop has an odd
    half, which takes a part of what an odd law of the wrong shape leaves. Where the first has no single state, as
    hysteresis, it is its own state: beside an odd curve any odd law takes a part.
    """
    small = plain(point, SEARCH_SECONDS)
    family = FAMILY.get(best.effect, best.effect)
    found = {r.place: sum(f.gain for f in r.found) for r in left.residuals if r.found}
    smooth = adequacy.worth(point, best.effect, {i for p in best.placed for i in p.at})
    for effect in on_trial(model):
        if FAMILY.get(effect.name, effect.name) == family:
            continue
        earned, asked, seen = 0.0, sum(smooth.values()), False
        for spot in screen.spots(effect, model, point):
            on = acting(effect, spot, point.data)
            if not {*found, *smooth}.intersection(on):
                continue
            trial = screen.tried(small, point, model, effect, spot)
            if trial is not None:
                earned += max(trial.gain - trial.df, 0.0)
                asked += 0.0 if smooth else sum(adequacy.worth(point, effect.name, {*on}).values())
                here = sum(found.get(i, 0.0) for i in on)
                seen |= here > 0.0 and trial.gain > EXPLAINS * here
        if seen and earned >= asked:
            return True
    return False


def of_its_state(model: Model, before: WorkingPoint, after: WorkingPoint, best: Entry) -> str | None:
    """The law of the family of the first that leaves nothing of its state beside it, all numbers fitted together; any
    law of x beside one that is not odd in it, whose state is all of x.

    before : fit of the whole record without the first; after : with it, of a part. Of a curve that is no law any two of
    one state take a large part, but not all.
    """
    if best.effect not in adequacy.STATES:
        return None
    own = FAMILY[best.effect]
    alike = OF_X if own == "even in x" else (own,)
    places = {i for p in best.placed for i in p.at}
    found: dict[str, list[screen.Trial]] = {}
    small = plain(after, SEARCH_SECONDS)
    for effect in on_trial(model):
        if effect.name == best.effect or FAMILY.get(effect.name) not in alike:
            continue
        for spot in screen.spots(effect, model, after):
            if not places.issuperset(acting(effect, spot, after.data)):
                continue
            trial = screen.tried(small, after, model, effect, spot)
            if trial is not None and trial.p_value < adequacy.LEVEL:
                found.setdefault(effect.name, []).append(trial)
    base = {u.key for u in before.placed}
    firsts = [u for u in after.placed if u.key not in base]
    part = thinned(before, missing_force.SURVEY_SECONDS)
    for second in sorted(found, key=lambda name: -sum(t.gain for t in found[name]))[:TRIED]:
        laws = [*firsts, *(t.placed for t in found[second])]
        for point in (part,) if part is before else (part, before):
            both = fit_model(point.data, [*point.placed, *laws], start=point, rounds=ROUNDS)
            if adequacy.left(point, both, best.effect, places) != 0.0:  # a saturating spring, 4 %
                break
            laws = [u for u in both.placed if u.key not in base]
        else:
            return second
    return None
