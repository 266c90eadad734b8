"""Two effects hidden together, drawn by number: what `improve` adds to the model without both, and what is left.

Pair n is drawn from n alone: two different effects, each at bearing1 or at both. A longer list begins as a shorter one.
Imbalance and a bow are not drawn together: they load the caps alike at every speed, as the catalogue says of them.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.diagnosis.verdict import Improvement, improve
from estimator.effects import CATALOGUE, places
from estimator.model import Model

from .hidden import (
    FORCE_SHARES,
    HIDDEN_PLACES,
    NO_HIDDEN_EFFECT,
    NOISE_RMS,
    RATE_HZ,
    has_one_place,
    numbers,
    record,
    with_hidden,
)

NOBODY_TELLS = {"imbalance", "bow"}
IMPROVE_STEPS = 2
PAIR_STRENGTH = "strong"


@dataclass(frozen=True, slots=True)
class Pair:
    """One run. at : name of each of the two effects -> bearing1 | both. seed : its number."""

    at: dict[str, str]
    seed: int

    @property
    def key(self) -> str:
        return f"{'+'.join(f'{name}@{where}' for name, where in self.at.items())}/{PAIR_STRENGTH}/{self.seed}"


def pairs(model: Model, effects: Iterable[str], number: int) -> list[Pair]:
    """Pairs 0 to number - 1 of those effects that can act on the rig; none where these are fewer than two."""
    able = [e for e in dict.fromkeys(effects) if places(CATALOGUE[e], model)]
    return [_drawn(able, seed) for seed in range(number)] if len(able) > 1 else []


def _drawn(effects: list[str], seed: int) -> Pair:
    rng = np.random.default_rng(9000 + seed)
    while True:
        two = [effects[k] for k in rng.choice(len(effects), 2, replace=False)]
        if set(two) != NOBODY_TELLS or len(effects) == len(two):
            where = [HIDDEN_PLACES[k] for k in rng.integers(len(HIDDEN_PLACES), size=2)]
            return Pair(
                {e: HIDDEN_PLACES[0] if has_one_place(e, w) else w for e, w in zip(two, where, strict=True)}, seed
            )


def run_pair(
    model: Model, pair: Pair, seconds: float, improve: Callable[..., Improvement] = improve
) -> dict[str, Any]:  # fmt: skip
    """Simulate a pair and improve the model without it. improve : from the model, samples and rate."""
    truth, known = with_hidden(model, pair.at, FORCE_SHARES[PAIR_STRENGTH], seconds)
    y = record(truth, seconds, pair.seed, NOISE_RMS)
    begin = time.process_time()
    ladder = improve(known, y, RATE_HZ)
    spent = time.process_time() - begin
    given = [u.name for u in known.effects]
    return {
        "key": pair.key,
        "pair": pair.at,
        "strength": PAIR_STRENGTH,
        "seed": pair.seed,
        "seconds": seconds,
        "hidden_at": {u.name: sorted(u.at) for u in truth.effects if u.name in pair.at},
        "steps": [found.verdict for found in ladder.diagnoses[: len(ladder.rungs) - 1]],
        "added_at": {u.name: sorted(u.at) for u in ladder.model.effects if u.name not in given},
        "verdict": ladder.last.verdict,
        "before_percent": ladder.rungs[0].missing[0],
        "after_percent": ladder.rungs[-1].missing[0],
        "cpu_seconds": spent,
        "numbers": numbers(truth, ladder.parameters),
        "messages": [m.text for m in ladder.messages],
    }


def markdown(runs: Sequence[Mapping[str, Any]], seconds: float) -> str:
    """A line a pair, and the counts; empty without pairs."""
    if not runs:
        return ""
    lines = [
        f"{len(runs)} pairs hidden together, both strong, {seconds:g} s.",
        "",
        "| pair | hidden | added by `improve`, in order | missing force, % | numbers covered | at the end |",
        "|---" * 6 + "|",
    ]
    for r in sorted(runs, key=lambda r: r["seed"]):
        both = ", ".join(f"{name} ({where})" for name, where in r["pair"].items())
        scores = [z for _, z in r["numbers"].values()]
        covered = f"{sum(abs(z) < 1.96 for z in scores)}/{len(scores)}"
        force = f"{r['before_percent']:.2f} -> {r['after_percent']:.2f}"
        lines.append(f"| {r['seed']} | {both} | {', '.join(r['steps'])} | {force} | {covered} | {r['verdict']} |")
    count = Counter(len(set(r["pair"]) & set(r["steps"][:IMPROVE_STEPS])) for r in runs)
    ends = sum(r["verdict"] == NO_HIDDEN_EFFECT for r in runs)
    more = sum(bool(set(r["steps"]) - set(r["pair"])) for r in runs)
    elsewhere = sum(any(set(at) != set(r["added_at"].get(e, at)) for e, at in r["hidden_at"].items()) for r in runs)
    fallen = [r["after_percent"] < 0.2 * r["before_percent"] for r in runs if r["before_percent"] > 0.0]
    lines += [
        "",
        f"Both within two steps: {count[2]}/{len(runs)}; one of them: {count[1]}, none: {count[0]}. Something else was "
        f'added in {more}, one of the two at other places in {elsewhere}. "complete" at the end: {ends}. '
        f"Missing force falls by 80 % or more: {sum(fallen)}/"
        f"{len(fallen)}. Numbers covered: true values, also of the model's own effects, within the 95 % interval then.",
    ]
    return "\n".join(lines) + "\n"
