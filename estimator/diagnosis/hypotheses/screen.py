"""What could be what a model lacks, the likeliest first: every effect on trial at every spot, and what is no law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from estimator.arrays import Array
from estimator.identification.finding import Finding
from estimator.identification.residual import missing_force
from estimator.identification.residual.missing_force import MissingForce
from estimator.identification.search import search
from estimator.likelihood.motion.law_smoothing import compile_law
from estimator.likelihood.motion.located_law import searched_parameters, trial_effects
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part, search_point
from estimator.model.rig import Model
from estimator.parallel import map_processes
from estimator.results import Message

from . import gate_amplitude, ranking
from . import trial as screen
from .ranking import Entry

Progress = Callable[[float, str], None]
SIGNIFICANT = 1e-3  # p-value, after counting all that was tried, below which an effect is claimed
SEARCH_SECONDS = 6.0
FOREMOST = 3  # of the ranking, judged on the largest amplitudes too
REFINED, NEAR = 12, 0.3  # trials refined at most; share of the best gain at a bearing that earns it, everywhere
FAR = 0.2  # share of the best effect's gain under which it is not asked what searched numbers of another spot would do


@dataclass(frozen=True, slots=True)
class Ranking:
    """part : of the record, which the trials are judged on first. before : what is missing there. suspects, trials :
    what is no law of a state, and every law at every spot. entries : what they come to, the likeliest first."""

    part: WorkingPoint
    before: MissingForce
    suspects: list[Finding]
    trials: list[screen.Trial]
    entries: list[Entry]


def ranked(model: Model, point: WorkingPoint, y: Array, say: Progress) -> Ranking:
    """What is missing, and what could be it, as part of the record has it."""
    say(0.15, "what can still be predicted")
    part = point_on_part(point, missing_force.SURVEY_S)
    before, others = missing_force.survey_with(part, model, lambda: search(model, point, y))
    trials = _trials(model, part, say)
    return Ranking(part, before, others, trials, ranking.entries(model, point, trials, before, others))


def on_whole(model: Model, point: WorkingPoint, found: Ranking, say: Progress) -> Ranking:
    """The same as all of the record has it, where that can tell more."""
    say(0.65, "the whole record")

    def whole(trial: screen.Trial, worth: bool, promising: bool) -> screen.Trial:
        again = screen.again(point, model, trial) if worth else None
        return trial if again is None else _judged(point, model, again, promising)

    worth = zip(screen.contenders(found.trials), _with_promise(model, found.trials), strict=True)
    asked = [partial(whole, trial, more, promising) for more, (trial, promising) in worth]
    trials = map_processes(asked, [t.effect for t in found.trials])
    entries = ranking.entries(model, point, trials, found.before, found.suspects)
    return replace(found, trials=trials, entries=entries)


def extrapolating(found: Ranking) -> list[Entry]:
    """The ranking with a law in front that is not refused on the largest amplitudes; those refused go to its end."""
    passed: list[Entry] = []
    refused: list[Entry] = []
    for number, entry in enumerate(found.entries):
        asked = not passed and number < FOREMOST and entry.p_value < SIGNIFICANT and gate_amplitude.judged(entry.effect)
        told = gate_amplitude.extrapolated(found.part, entry.placed) if asked and entry.placed else None
        if told is None:
            passed.append(entry)
        elif told.refused:
            text = f"refused: fitted to the smaller amplitudes it predicts the largest worse by {-told.gain:.0f} nats"
            note = Message("refused_large_motion", text)
            refused.append(replace(entry, amplitude_gain=told.gain, notes=(*entry.notes, note)))
        else:
            passed.append(replace(entry, amplitude_gain=told.gain))
    return passed + refused


def _trials(model: Model, part: WorkingPoint, say: Progress) -> list[screen.Trial]:
    """The best trial of every force effect at every spot, the most likely first; searched parameters refined for the
    promising ones."""
    small = search_point(part, SEARCH_SECONDS)
    pairs = [(e, s) for e in trial_effects(model) for s in screen.spots(e, model, part)]
    for effect, _ in pairs:
        if effect.force is not None:
            compile_law(effect, screen.grid(effect, model, part, 0, [])[0])

    def said(done: int) -> None:
        effect, spot = pairs[done - 1]
        say(0.25 + 0.3 * done / len(pairs), f"{effect.name} at {spot}")

    effects = [e for e, _ in pairs]
    tried = map_processes([partial(screen.tried, small, part, model, *pair) for pair in pairs], effects, said)
    by_effect: dict[str, list[screen.Trial]] = {}
    for t in tried:
        if t is not None:
            by_effect.setdefault(t.effect.name, []).append(t)

    gains = {name: sum(max(t.gain, 0.0) for t in own) for name, own in by_effect.items()}

    def lent(name: str) -> list[screen.Trial]:
        if gains[name] < FAR * max(gains.values()):
            return by_effect[name]
        return screen.borrowed(part, model, by_effect[name], [s for e, s in pairs if e.name == name])

    trials = [t for own in map_processes([partial(lent, name) for name in by_effect], effects) for t in own]
    trials.sort(key=lambda t: -t.gain)
    return map_processes([partial(_judged, part, model, *pair) for pair in _with_promise(model, trials)], effects)


def _judged(point: WorkingPoint, model: Model, trial: screen.Trial, promising: bool) -> screen.Trial:
    return screen.judged(screen.refined(point, model, trial) if promising else trial)


def _with_promise(model: Model, trials: list[screen.Trial]) -> list[tuple[screen.Trial, bool]]:
    """Every trial, and whether its searched parameters are worth to be refined."""
    promising = [t for t in promising_trials(trials) if searched_parameters(t.effect, model)][:REFINED]
    return [(trial, any(trial is t for t in promising)) for trial in trials]


def promising_trials(trials: list[screen.Trial]) -> list[screen.Trial]:
    """Those of effects that come near the best one at some bearing, all directions of it together."""
    sums: dict[tuple[str, str], float] = {}
    for t in trials:
        key = t.spot.split(".")[0], t.effect.name
        sums[key] = sums.get(key, 0.0) + max(t.gain, 0.0)
    best = {node: max(g for (n, _), g in sums.items() if n == node) for node, _ in sums}
    near = {effect for (node, effect), g in sums.items() if g > max(4.0, NEAR * best[node])}
    return [t for t in trials if t.gain > 2.0 and t.effect.name in near]
