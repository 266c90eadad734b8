"""Which effect is missing: every effect of the catalogue on trial, by held-out likelihood, with honest odds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import adequacy, amplitude, evidence, missing_force, screen
from .errors import DataError
from .evidence import Entry
from .features import ready
from .fitted import parameters, untold
from .heldout import heldout_nll
from .model import Model
from .model_fit import fit_model
from .model_uses import acting, on_trial, searched
from .periodic import PERIODIC
from .periodic_fit import found_beside
from .shape import Shape, shape_of
from .side_by_side import answers
from .suspects import suspects
from .whole import fit_whole, with_found
from .working_point import WorkingPoint, plain, thinned

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]
SIGNIFICANT = 1e-3  # p-value, after counting all that was tried, below which an effect is claimed
SAME_SHAPE = 0.2  # of the missing force (rms): more left than that in the same state means another law
SEARCH_SECONDS = 6.0
EXPLAINS = 0.3  # of the nats that smooth columns gain, for a second effect to be what is left
FOREMOST = 3  # of the ranking, judged on the largest amplitudes too
CLOSE = 10.0  # nats behind the first of the ranking, where the shape of what is left decides
REFINED, NEAR = 12, 0.3  # trials refined at most; share of the best gain at a bearing that earns it, everywhere
SURE = 30.0  # nats, from which a shaft that is not the rig file's is told
FAR = 0.2  # share of the best effect's gain under which it is not asked what searched numbers of another spot would do
EARNED = 5.0  # nats held out, of a law where no force is missing: ln of what a search tries
IDLE = "refused: no force is missing there, and fitted with the model it is not told from zero or predicts no better"
OTHERWISE = (
    "the caps answer each other otherwise than the shaft of the rig file lets them: its spring or the disc's mass is "
    "another, or a sensor has a wrong gain or is late"
)
SHAFT = "the shaft is "  # softer or stiffer than the rig file says
FAMILY = {
    "cubic": "odd in x", "quintic": "odd in x", "clearance": "odd in x", "hertz": "odd in x",
    "quadratic": "even in x", "stop": "even in x",
    "coulomb": "damping", "quadratic_damping": "damping", "displacement_damping": "damping", "bouc_wen": "damping",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """verdict : an effect's name, "complete" or "unknown". ranking : best first. shape : where verdict is "unknown"."""

    verdict: str
    ranking: tuple[Entry, ...]
    shape: Shape | None = None
    separates: str = ""
    messages: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As schemas/diagnose.json, with `separates` and `messages`."""
        out: dict[str, Any] = {
            "schema": 1,
            "verdict": self.verdict,
            "ranking": [e.to_json() for e in self.ranking],
            "separates": self.separates,
            "messages": list(self.messages),
        }
        return out if self.shape is None else out | {"shape": self.shape.to_json()}


def quiet(fraction: float, text: str) -> None:
    """No progress shown."""


def diagnose(model: Model, y: Array, rate_hz: float, progress: Progress | None = None) -> Diagnosis:
    """Name what the model lacks on a record y (n, channels of the model), SI, NaN where missing.

    Raises DataError if the record cannot answer.
    """
    say = progress or quiet
    say(0.0, "fit of the model as it is")
    whole = fit_whole(model, y, rate_hz)
    found = diagnose_point(whole.model, whole.point, y, say)
    return replace(found, messages=(*found.messages, *whole.messages))


def diagnose_point(model: Model, point: WorkingPoint, y: Array, say: Progress = quiet) -> Diagnosis:
    """The same from a model already fitted."""
    before, entries = _ranked(model, point, y, say)
    found = _verdict(model, point, before, entries, say)
    return _restored(model, point, y, before, found) if found.verdict == "sensor_clipping" else found


def _verdict(
    model: Model, point: WorkingPoint, before: missing_force.Survey, entries: list[Entry], say: Progress
) -> Diagnosis:  # fmt: skip
    """What the ranking comes to."""
    if not entries or entries[0].p_value > SIGNIFICANT or _negligible(point, entries[0]):
        return _nothing(point, before, tuple(entries))
    best = entries[0]
    if best.placed and best.effect != "crack" and _loss(entries)[1] > best.gain:
        return _nothing(point, before, tuple(entries))
    if not best.placed:
        if best.effect in PERIODIC:
            say(0.85, f"{best.effect} and the model fitted together")
            entries[0] = _beside(model, point, before, best)
        return Diagnosis(best.effect, tuple(entries), separates=evidence.separates(entries), messages=best.notes)
    return _law(model, point, before, entries, say)


def _restored(model: Model, point: WorkingPoint, y: Array, before: missing_force.Survey, found: Diagnosis) -> Diagnosis:
    """The finding of clipped channels with what is missing once what lies beyond their level is drawn."""
    best, *others = found.ranking
    rate_hz = point.data.rate_hz
    try:
        whole = fit_whole(with_found(model, best.settings), y[: int(missing_force.SURVEY_SECONDS * rate_hz)], rate_hz)
    except DataError:  # too little of the record is whole
        return found
    after = missing_force.survey(whole.point, whole.model, only=before.places_found())
    return replace(found, ranking=(replace(best, after_percent=after.percent(whole.point)), *others))


def _loss(entries: Sequence[Entry]) -> tuple[float, float]:
    """N/m that the shaft lacks in the mean, and nats, by a crack on trial: without anything that turns it is another
    shaft than the rig file's."""
    for entry in entries:
        loss = entry.parameters.get("disc.crack.loss")
        if loss is not None and loss.value and loss.sd:
            return loss.value, 0.5 * (loss.value / loss.sd) ** 2
    return 0.0, 0.0


def _beside(model: Model, point: WorkingPoint, before: missing_force.Survey, entry: Entry) -> Entry:
    """The entry of a force of time alone, fitted together with the model: about a resonance it had spoiled the fit."""
    settings, after_point = found_beside(model, point, entry.settings)
    part = thinned(after_point, missing_force.SURVEY_SECONDS)
    del after_point
    after = missing_force.survey(part, model, only=before.places_found())
    return replace(evidence.with_settings(entry, settings), after_percent=after.percent(part))


def _law(
    model: Model, point: WorkingPoint, before: missing_force.Survey, entries: list[Entry], say: Progress
) -> Diagnosis:  # fmt: skip
    """The first of the ranking, if its law has the shape of what is missing, or one close behind that has."""
    left: dict[str, float] = {}
    idle: list[int] = []
    for k in _close(entries):
        name = entries[k].effect
        say(0.85, f"does {name} explain it?")
        entries[k], rest = _fits(model, point, before, entries[k], say)
        if rest is None:
            idle.append(k)
            continue
        left[name] = rest
        if not rest:
            ranking = (entries[k], *entries[:k], *entries[k + 1 :])
            said = (*_passed_over(left), *_clipped(entries))
            return Diagnosis(name, ranking, separates=evidence.separates(ranking), messages=said)
    if idle:
        found = _verdict(model, point, before, [e for k, e in enumerate(entries) if k not in idle], say)
        return replace(found, ranking=(*found.ranking, *(entries[k] for k in idle)))
    best = entries[0]
    return Diagnosis(
        "unknown",
        tuple(entries),
        shape_of(point, before, (best.placed[0].at[0], adequacy.state_of(best.effect))),
        messages=(
            f"{best.effect} comes nearest but leaves {100 * left[best.effect]:.0f} % of what a state explains of the "
            "missing force: no law of the catalogue has this shape",
            *_clipped(entries),
        ),
    )


def _clipped(entries: list[Entry]) -> tuple[str, ...]:
    """What to tell of clipped channels, beside a law that has more evidence than they could make."""
    return tuple(note for e in entries if e.effect == "sensor_clipping" for note in e.notes)


def _close(entries: list[Entry]) -> list[int]:
    """Numbers of the first of the ranking and of force laws so close behind that a law of the wrong shape may have
    passed them by its number of parameters."""
    least = entries[0].score - CLOSE
    return [
        k for k, e in enumerate(entries[:FOREMOST]) if e.placed and e.p_value < SIGNIFICANT and e.score > least
    ]  # fmt: skip


def _passed_over(left: dict[str, float]) -> tuple[str, ...]:
    """What was ahead, and why it is not the answer. left : of each effect judged, the last one named."""
    return tuple(
        f"{effect} was ahead by a few nats but leaves {100 * rest:.0f} % of what a state explains"
        for effect, rest in [*left.items()][:-1]
    )


def _fits(
    model: Model, point: WorkingPoint, before: missing_force.Survey, entry: Entry, say: Progress
) -> tuple[Entry, float | None]:  # fmt: skip
    """The entry fitted together with the model, and what it leaves of the missing force in its own state (rms): 0 if
    that is no more than a law of the right shape may leave. None where it is nothing, as laws that see noise as strong
    as the motion may seem to be something: no force is missing at its places, and it is not told from zero at any or
    predicts no better."""
    missing = bool({i for p in entry.placed for i in p.at}.intersection(before.places_found()))
    samples = point.data.blocks * point.data.block
    rounds = 2 if missing else 6
    after_point = fit_model(point.data, [*point.placed, *entry.placed], start=point, rounds=rounds)
    if not missing and (
        {use.key for use in entry.placed}.issubset(untold(after_point))
        or heldout_nll(after_point) > heldout_nll(point) - EARNED / samples
    ):
        return replace(entry, notes=(*entry.notes, IDLE)), None
    entry, after_point = _where_told(point, entry, after_point, rounds)
    joint = parameters(after_point)  # standard deviations by the curvature of the likelihood, gaps and corners too
    smooth = adequacy.left(point, after_point, entry.effect, {i for p in entry.placed for i in p.at})
    after_part = thinned(after_point, missing_force.SURVEY_SECONDS)
    del after_point
    after = missing_force.survey(after_part, model, only=before.places_found())
    values = {k: joint.get(k, p) for k, p in entry.parameters.items()}
    entry = replace(entry, after_percent=after.percent(after_part), parameters=values)
    left = _same_state_left(before, after, entry) if smooth is None else smooth
    wrong = left > adequacy.most_left(entry.effect, SAME_SHAPE) and not _another_explains(
        model, after_part, after, entry, say
    )
    return entry, left if wrong else 0.0


def _where_told(
    point: WorkingPoint, entry: Entry, after_point: WorkingPoint, rounds: int
) -> tuple[Entry, WorkingPoint]:
    """The entry and its fit without bearings where the law, fitted at all of them together, is not told from zero and
    predicts no better: on trial by themselves they win by what they share with the one that has it, as where the
    forces at the two are coherent."""
    silent = set(untold(after_point))
    idle = [n for n in entry.at if all(use.key in silent for use in entry.placed if use.key.split(".")[0] == n)]
    if not idle or len(idle) == len(entry.at):
        return entry, after_point
    fewer = evidence.without(entry, idle)
    less = fit_model(point.data, [*point.placed, *fewer.placed], start=point, rounds=rounds)
    samples = point.data.blocks * point.data.block
    if heldout_nll(less) > heldout_nll(after_point) + EARNED / samples:
        return entry, after_point
    return fewer, less


def _ranked(
    model: Model, point: WorkingPoint, y: Array, say: Progress
) -> tuple[missing_force.Survey, list[Entry]]:  # fmt: skip
    """What is missing, and what could be it, the likeliest first."""
    say(0.15, "what can still be predicted")
    part = thinned(point, missing_force.SURVEY_SECONDS)
    before, others = missing_force.surveyed(part, model, lambda: suspects(model, point, y))
    trials = _screen(model, point, part, say)
    entries = evidence.entries(model, point, trials, before, others)
    say(0.8, "largest amplitudes")
    return before, _extrapolating(part, entries)


def _extrapolating(point: WorkingPoint, entries: list[Entry]) -> list[Entry]:
    """The ranking with a law in front that is not refused on the largest amplitudes; those refused go to its end."""
    passed: list[Entry] = []
    refused: list[Entry] = []
    for number, entry in enumerate(entries):
        on_trial = not passed and number < FOREMOST and entry.p_value < SIGNIFICANT and amplitude.judged(entry.effect)
        found = amplitude.extrapolated(point, entry.placed) if on_trial and entry.placed else None
        if found is None:
            passed.append(entry)
        elif found.refused:
            note = f"refused: fitted to the smaller motion it makes the largest worse by {-found.gain:.0f} nats"
            refused.append(replace(entry, amplitude_gain=found.gain, notes=(*entry.notes, note)))
        else:
            passed.append(replace(entry, amplitude_gain=found.gain))
    return passed + refused


def _negligible(point: WorkingPoint, best: Entry) -> bool:
    """Whether a force law, however certain, explains less than any simulation, filter or ceiling leaves behind."""
    least = max((missing_force.negligible(point, i) for use in best.placed for i in use.at), default=0.0)
    return best.explained_percent < 100 * least


def _nothing(point: WorkingPoint, before: missing_force.Survey, entries: tuple[Entry, ...]) -> Diagnosis:
    loss, nats = _loss(entries)
    shaft = []
    if nats > SURE and point.data.disc is not None:
        how = "softer (or its disc heavier)" if loss > 0 else "stiffer (or its disc lighter)"
        percent = 100 * abs(loss) / point.data.disc.K
        by = f"{percent:.2g} +- {percent / np.sqrt(2 * nats):.1g} %"
        shaft = [f"{SHAFT}{how} than the rig file says, by {by}: give its true stiffness there"]
    if before.any_found() and before.percent(point) >= 100 * missing_force.NEGLIGIBLE:
        said = [
            *shaft,
            "the residual force can be predicted, but no effect of the catalogue does it significantly",
            *dict.fromkeys(s.region for s in before.shares),
        ]
        if any(f.group == "other_bearing" for r in before.residuals for f in r.found):
            said.append(OTHERWISE)
        return Diagnosis("unknown", entries, shape_of(point, before), messages=tuple(said))
    if not before.looked_anywhere():
        return Diagnosis("unknown", entries, messages=(*shaft, missing_force.UNJUDGED))
    forces = [_beside_forces(point)] if point.data.measured_force else []
    return Diagnosis("complete", entries, messages=(*shaft, *forces))


def about_the_shaft(messages: Sequence[str]) -> str:
    """The message by which a diagnosis lays what is left to the rig file's shaft, or to a sensor, and to no law."""
    return next((text for text in messages if text == OTHERWISE or text.startswith(SHAFT)), "")


def _beside_forces(point: WorkingPoint) -> str:
    """What is not tried where the force is measured."""
    known = [p for p, S in zip(point.data.places, point.data.driven, strict=True) if S > 0.0]
    return (
        f"the force at {', '.join(known)} is measured: its colour, and what it shares with another, are its own and "
        "nothing that the model lacks"
    )


def _screen(model: Model, point: WorkingPoint, part: WorkingPoint, say: Progress) -> list[screen.Trial]:
    """The best trial of every force effect at every spot on part of the record, on the whole of it where that can tell
    more; searched parameters refined for the promising ones."""
    small = plain(part, SEARCH_SECONDS)
    pairs = [(e, s) for e in on_trial(model) for s in screen.spots(e, model, point)]
    for effect, _ in pairs:
        if effect.force is not None:
            ready(effect)

    def said(done: int) -> None:
        effect, spot = pairs[done - 1]
        say(0.25 + 0.35 * done / len(pairs), f"{effect.name} at {spot}")

    effects = [e for e, _ in pairs]
    tried = answers([partial(screen.tried, small, part, model, *pair) for pair in pairs], effects, said)
    by_effect: dict[str, list[screen.Trial]] = {}
    for t in tried:
        if t is not None:
            by_effect.setdefault(t.effect.name, []).append(t)

    gains = {name: sum(max(t.gain, 0.0) for t in own) for name, own in by_effect.items()}

    def lent(name: str) -> list[screen.Trial]:
        if gains[name] < FAR * max(gains.values()):
            return by_effect[name]
        return screen.borrowed(part, model, by_effect[name], [s for e, s in pairs if e.name == name])

    say(0.6, "the whole record")
    trials = [t for own in answers([partial(lent, name) for name in by_effect], effects) for t in own]
    trials.sort(key=lambda t: -t.gain)
    promising = [t for t in _promising(trials) if searched(t.effect, model)][:REFINED]

    def whole(trial: screen.Trial, worth: bool) -> screen.Trial:
        near = any(trial is t for t in promising)
        found = screen.refined(part, model, trial) if near else trial
        if worth and part is not point:
            again = screen.again(point, model, found)
            found = found if again is None else screen.refined(point, model, again) if near else again
        return screen.judged(found)

    worth = zip(trials, screen.contenders(trials), strict=True)
    return answers([partial(whole, *pair) for pair in worth], effects)


def _promising(trials: list[screen.Trial]) -> list[screen.Trial]:
    """Those of effects that come near the best one at some bearing, all directions of it together."""
    sums: dict[tuple[str, str], float] = {}
    for t in trials:
        key = t.spot.split(".")[0], t.effect.name
        sums[key] = sums.get(key, 0.0) + max(t.gain, 0.0)
    best = {node: max(g for (n, _), g in sums.items() if n == node) for node, _ in sums}
    near = {effect for (node, effect), g in sums.items() if g > max(4.0, NEAR * best[node])}
    return [t for t in trials if t.gain > 2.0 and t.effect.name in near]


def _same_state_left(before: missing_force.Survey, after: missing_force.Survey, best: Entry) -> float:
    """rms left over rms before, in the state where the effect explains most: 0 if its law has the right shape.

    States that it does not touch belong to something else that is missing too.
    """
    places = {i for p in best.placed for i in p.at}
    was, rest = _by_state(before, places), _by_state(after, places)
    if not was:
        return 0.0
    state = max(was, key=lambda g: was[g] - rest.get(g, 0.0))
    return float(np.sqrt(min(max(rest.get(state, 0.0), 0.0) / was[state], 1.0))) if was[state] > 0 else 0.0


def _by_state(found: missing_force.Survey, places: set[int]) -> dict[str, float]:
    out: dict[str, float] = {}
    for r in found.residuals:
        for f in r.found if r.place in places else ():
            out[f.group] = out.get(f.group, 0.0) + f.power
    return out


def _another_explains(
    model: Model, point: WorkingPoint, left: missing_force.Survey, best: Entry, say: Progress
) -> bool:
    """Whether a second effect, of another family, explains what the first leaves: two missing, not one unknown.

    At all its spots together it is to earn what smooth terms in the state of the first do: a one-sided stop has an odd
    half, which takes a part of what an odd law of the wrong shape leaves. Where the first has no single state, as
    hysteresis, it is its own state: beside an odd curve any odd law takes a part.
    """
    say(0.93, "one effect or two?")
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
