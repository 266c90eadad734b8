"""What could be what a model lacks, the likeliest first: every effect on trial at every spot, and what is no law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from . import amplitude, evidence, missing_force, screen
from .evidence import Entry
from .features import ready
from .model import Model
from .model_uses import on_trial, searched
from .side_by_side import answers
from .suspects import suspects
from .working_point import WorkingPoint, plain, thinned

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]
SIGNIFICANT = 1e-3  # p-value, after counting all that was tried, below which an effect is claimed
SEARCH_SECONDS = 6.0
FOREMOST = 3  # of the ranking, judged on the largest amplitudes too
REFINED, NEAR = 12, 0.3  # trials refined at most; share of the best gain at a bearing that earns it, everywhere
FAR = 0.2  # share of the best effect's gain under which it is not asked what searched numbers of another spot would do


def ranked(
    model: Model, point: WorkingPoint, y: Array, say: Progress
) -> tuple[missing_force.Survey, list[Entry]]:  # fmt: skip
    """What is missing, and what could be it, the likeliest first."""
    say(0.15, "what can still be predicted")
    part = thinned(point, missing_force.SURVEY_SECONDS)
    before, others = missing_force.surveyed(part, model, lambda: suspects(model, point, y))
    trials = _trials(model, point, part, say)
    entries = evidence.entries(model, point, trials, before, others)
    say(0.8, "largest amplitudes")
    return before, _extrapolating(part, entries)


def _extrapolating(point: WorkingPoint, entries: list[Entry]) -> list[Entry]:
    """The ranking with a law in front that is not refused on the largest amplitudes; those refused go to its end."""
    passed: list[Entry] = []
    refused: list[Entry] = []
    for number, entry in enumerate(entries):
        asked = not passed and number < FOREMOST and entry.p_value < SIGNIFICANT and amplitude.judged(entry.effect)
        found = amplitude.extrapolated(point, entry.placed) if asked and entry.placed else None
        if found is None:
            passed.append(entry)
        elif found.refused:
            note = f"refused: fitted to the smaller motion it makes the largest worse by {-found.gain:.0f} nats"
            refused.append(replace(entry, amplitude_gain=found.gain, notes=(*entry.notes, note)))
        else:
            passed.append(replace(entry, amplitude_gain=found.gain))
    return passed + refused


def _trials(model: Model, point: WorkingPoint, part: WorkingPoint, say: Progress) -> list[screen.Trial]:
    """The best trial of every force effect at every spot on part of the record, on the whole of it where that can tell
    more; searched parameters refined for the promising ones."""
    small = plain(part, SEARCH_SECONDS)
    pairs = [(e, s) for e in on_trial(model) for s in screen.spots(e, model, point)]
    for effect, _ in pairs:
        if effect.force is not None:
            ready(effect, screen.grid(effect, model, point, 0, [])[0])

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
