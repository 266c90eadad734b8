"""Screening: every effect on trial at every location, and every finding that is no law, the likeliest first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.identification.finding import Finding
from estimator.identification.residual.missing_force import MissingForce
from estimator.likelihood.motion.law_smoothing import compile_law
from estimator.likelihood.motion.located_law import searched_parameters, trial_effects
from estimator.likelihood.path.working_point import WorkingPoint, search_point
from estimator.model.rig import Model
from estimator.parallel import map_processes

from . import ranking
from .ranking import Entry
from .trial import (
    Trial,
    are_contenders,
    best_trial,
    open_locations,
    parameter_grid,
    refined_trial,
    repeated_trial,
    with_borrowed_parameters,
    with_heldout_gain,
)

Progress = Callable[[float, str], None]


def quiet(fraction: float, text: str) -> None:
    """No progress shown."""


@dataclass(frozen=True, slots=True)
class Ranking:
    """A ranking of causes.

    missing, findings : what the model leaves over. trials : every law at every location. entries : by effect, the
    likeliest first.
    """

    missing: MissingForce
    findings: tuple[Finding, ...]
    trials: list[Trial]
    entries: list[Entry]


def rank_on_part(
    model: Model, part: WorkingPoint, missing: MissingForce, findings: tuple[Finding, ...], say: Progress
) -> Ranking:  # fmt: skip
    """The ranking of the causes of the missing force, from the part of the record that was surveyed."""
    trials = _trials(model, part, say)
    return Ranking(missing, findings, trials, ranking.ranked_entries(model, part, trials, missing, findings))


def rank_on_record(model: Model, point: WorkingPoint, found: Ranking, say: Progress) -> Ranking:
    """The ranking from all of the record, where the rest of it can change the ranking."""
    say(0.65, "the whole record")

    def whole(trial: Trial, contends: bool, promising: bool) -> Trial:
        again = repeated_trial(point, model, trial) if contends else None
        return trial if again is None else _judged(point, model, again, promising)

    contenders = zip(are_contenders(found.trials), _with_promise(model, found.trials), strict=True)
    asked = [partial(whole, trial, contends, promising) for contends, (trial, promising) in contenders]
    trials = map_processes(asked, [t.effect for t in found.trials])
    entries = ranking.ranked_entries(model, point, trials, found.missing, found.findings)
    return replace(found, trials=trials, entries=entries)


def _trials(model: Model, part: WorkingPoint, say: Progress) -> list[Trial]:
    """The best trial of every force effect at every location, the likeliest first.

    Searched parameters of promising trials are refined.
    """
    small = search_point(part, THRESHOLDS.search_seconds)
    pairs = [(e, s) for e in trial_effects(model) for s in open_locations(e, model, part)]
    for effect, _ in pairs:
        if effect.force is not None:
            compile_law(effect, parameter_grid(effect, model, part, 0, [])[0])

    def said(done: int) -> None:
        effect, location = pairs[done - 1]
        say(0.25 + 0.3 * done / len(pairs), f"{effect.name} at {location}")

    effects = [e for e, _ in pairs]
    tried = map_processes([partial(best_trial, small, part, model, *pair) for pair in pairs], effects, said)
    by_effect: dict[str, list[Trial]] = {}
    for t in tried:
        if t is not None:
            by_effect.setdefault(t.effect.name, []).append(t)

    gains = {name: sum(max(t.gain, 0.0) for t in own) for name, own in by_effect.items()}

    def lent(name: str) -> list[Trial]:
        if gains[name] < THRESHOLDS.borrowed_min_gain_rel * max(gains.values()):
            return by_effect[name]
        return with_borrowed_parameters(part, model, by_effect[name], [s for e, s in pairs if e.name == name])

    trials = [t for own in map_processes([partial(lent, name) for name in by_effect], effects) for t in own]
    trials.sort(key=lambda t: -t.gain)
    return map_processes([partial(_judged, part, model, *pair) for pair in _with_promise(model, trials)], effects)


def _judged(point: WorkingPoint, model: Model, trial: Trial, promising: bool) -> Trial:
    return with_heldout_gain(refined_trial(point, model, trial) if promising else trial)


def _with_promise(model: Model, trials: list[Trial]) -> list[tuple[Trial, bool]]:
    """Every trial, and whether its searched parameters are to be refined."""
    promising = [t for t in promising_trials(trials) if searched_parameters(t.effect, model)][
        : THRESHOLDS.max_refined_trials
    ]
    return [(trial, any(trial is t for t in promising)) for trial in trials]


def promising_trials(trials: list[Trial]) -> list[Trial]:
    """Trials of effects whose gain at some bearing, summed over its directions, comes near that of the best effect."""
    sums: dict[tuple[str, str], float] = {}
    for t in trials:
        key = t.location.split(".")[0], t.effect.name
        sums[key] = sums.get(key, 0.0) + max(t.gain, 0.0)
    best = {node: max(g for (n, _), g in sums.items() if n == node) for node, _ in sums}
    near = {effect for (node, effect), g in sums.items() if g > max(4.0, THRESHOLDS.refined_min_gain_rel * best[node])}
    return [t for t in trials if t.gain > 2.0 and t.effect.name in near]
