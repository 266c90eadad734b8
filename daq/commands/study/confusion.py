"""The confusion matrix of the diagnosis: effects hidden by the simulator against verdicts, in Markdown and JSON.

A correct verdict is added to the rig without values, as a user would add it, and fitted. The matrix gives the force
that is then missing, and the share of the gain to the likelihood of the true model (fitted from the true values).

    rotorscope confusion configs/tiwari_vyas_1997.toml --out build/confusion --seconds 20 --seeds 1

One line of JSON per run is appended to OUT/runs.jsonl, so an interrupted matrix goes on where it stopped. The truth is
known only to this file; the diagnosis sees samples and the rig without the effect.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.base.console.output import Output, write_whole
from daq.base.contract.errors import ConfigError
from daq.rig.problems import did_you_mean
from daq.rig.rig import load_rig
from estimator.diagnosis.comparison import heldout_nll
from estimator.diagnosis.verdict import BearingJudgement, judge_bearing, rung
from estimator.effects import CATALOGUE
from estimator.errors import ModelError
from estimator.identification.batch import FullFit, fit_all_effects
from estimator.model import EffectUse, Model

from . import hidden_pairs
from .hidden import FORCE_SHARES, HIDDEN_PLACES, NO_HIDDEN_EFFECT, RATE_HZ, Case, cases, hidden, numbers, record
from .hidden_pairs import Pair, pairs, run_pair

MIN_DISTANCE_NATS = 20.0  # nats between two models under which their difference is mostly chance


def run(
    model: Model, case: Case, seconds: float, diagnose: Callable[..., BearingJudgement] = judge_bearing
) -> dict[str, Any]:  # fmt: skip
    """Simulate and diagnose one case. diagnose : from the fitted model, its working point and the samples."""
    truth, known, noise = hidden(model, case, seconds)
    y = record(truth, seconds, case.seed, noise)
    begin = time.process_time()
    fitted = fit_all_effects(known, y, RATE_HZ)
    found = diagnose(fitted.model, fitted.point, y)
    spent = time.process_time() - begin
    top = found.ranking[0] if found.ranking else None
    right = found.verdict == case.effect != NO_HIDDEN_EFFECT
    return {
        "key": case.key,
        "effect": case.effect,
        "strength": case.strength,
        "at": case.at,
        "seed": case.seed,
        "seconds": seconds,
        "verdict": found.verdict,
        "named_at": list(top.at) if top else [],
        "gain": top.gain if top else 0.0,
        "p_value": top.p_value if top else 1.0,
        "runner_up": found.ranking[1].effect if len(found.ranking) > 1 else "",
        "before_percent": top.before_percent if top else 0.0,
        "after_percent": top.after_percent if top else 0.0,
        "cpu_seconds": spent,
        "numbers": numbers(truth, top.parameters) if top and right else {},
        "added": added(fitted, known, truth, case.effect, top.at, y) if top and right else {},
    }


def added(
    fitted: FullFit, known: Model, truth: Model, effect: str, at: Sequence[str], y: NDArray[np.float64]
) -> dict[str, float]:
    """Missing force that is left, %, and nats to_go, when an effect is added to a model at places without a number.

    to_go, of `gap` between the model as it was and the true one, is what the likelihood still lacks after it.
    """
    grown = replace(known, effects=(*known.effects, EffectUse(effect, {place: {} for place in at})))
    after = fit_all_effects(grown, y, RATE_HZ)
    before, best = heldout_nll(fitted.point), heldout_nll(fit_all_effects(truth, y, RATE_HZ).point)
    end = rung(after.model, after.point, y)
    return {
        "missing_percent": end.missing[0],
        "gap": (before - best) * len(y),
        "to_go": (end.heldout_nll - best) * len(y),
    }


def markdown(runs: Sequence[Mapping[str, Any]], seconds: float) -> str:
    """The matrix as a table: hidden effect, how often it was named by strength and place, and what else was said; empty
    without runs."""
    if not runs:
        return ""
    columns = sorted({(r["strength"], r["at"]) for r in runs}, key=lambda c: (c[0] == "strong", c))
    heads = ["named right" if c == ("-", "-") else f"{c[0]}, {c[1]}" for c in columns]
    lines = [
        f"{len(runs)} runs of {seconds:g} s at {RATE_HZ:g} Hz, int16 counts, sensor noise.",
        "",
        f"| hidden | {' | '.join(heads)} | numbers covered | force falls | gap closed | otherwise |",
        "|---" * (len(heads) + 5) + "|",
    ]
    verdicts: dict[str, dict[tuple[str, str], list[str]]] = {}
    for r in runs:
        verdicts.setdefault(r["effect"], {}).setdefault((r["strength"], r["at"]), []).append(r["verdict"])
    right = 0
    for effect, by in sorted(verdicts.items()):
        cells = [f"{by[c].count(effect)}/{len(by[c])}" if c in by else "" for c in columns]
        others = Counter(v for said in by.values() for v in said if v != effect)
        right += sum(said.count(effect) for said in by.values())
        other_verdicts = ", ".join(f"{k} {n}" for k, n in others.most_common())
        scores = [z for r in runs if r["effect"] == effect for _, z in r.get("numbers", {}).values()]
        covered = f"{sum(abs(z) < 1.96 for z in scores)}/{len(scores)}" if scores else ""
        force, gap = ended([r for r in runs if r["effect"] == effect and r.get("added")])
        lines.append(f"| {effect} | {' | '.join(cells)} | {covered} | {force} | {gap} | {other_verdicts} |")
    lines += [
        "",
        f"All: {right}/{len(runs)}. Numbers covered: true values within the 95 % interval of the diagnosis. Force "
        "falls: runs where the missing force falls by 80 % or more when the effect is added. Gap closed: runs where "
        "the held-out likelihood comes within 5 % of the gap to the true model, where that is over "
        f"{MIN_DISTANCE_NATS:g} nats.",
    ]
    return "\n".join(lines) + "\n"


def ended(runs: Sequence[Mapping[str, Any]]) -> tuple[str, str]:
    """(force falls, gap closed), each "in so many/of so many" runs with `added`; empty where there is none."""
    fallen = [r["added"]["missing_percent"] < 0.2 * r["before_percent"] for r in runs if r["before_percent"] > 0.0]
    closed = [r["added"]["to_go"] < 0.05 * r["added"]["gap"] for r in runs if r["added"]["gap"] > MIN_DISTANCE_NATS]
    force, gap = (f"{sum(true)}/{len(true)}" if true else "" for true in (fallen, closed))
    return force, gap


def confusion(
    output: Output, rig_path: Path, out: Path, effects: Sequence[str], strengths_: Sequence[str], at: Sequence[str],
    seeds: int, complete: int, two: int, seconds: float,
    run_case: Callable[..., dict[str, Any]] = run, run_pair: Callable[..., dict[str, Any]] = run_pair,
) -> None:  # fmt: skip
    """Run what is missing of the matrix in the folder `out`, then write confusion.md and confusion.json there.

    two : number of runs with two effects hidden together. run_case, run_pair : simulate one run and judge it.
    """
    for given, there, what in (
        (effects, list(CATALOGUE), "effect"), (strengths_, list(FORCE_SHARES), "strength"),
        (at, list(HIDDEN_PLACES), "place"),
    ):  # fmt: skip
        for name in given:
            if name not in there:
                raise ConfigError(f'"{name}" is no {what}; {did_you_mean(name, there, "there are")}')
    if two and len(set(effects)) == 1:
        raise ConfigError(f"--pairs: {effects[0]} alone makes no pair; give --effects two names, or none for all")
    model = load_rig(rig_path).model
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be made: {error.strerror}; choose another --out") from error
    path = out / "runs.jsonl"
    done = read_runs(path, seconds)
    known = {r["key"] for r in done}
    pool = effects or list(CATALOGUE)
    asked: list[Case | Pair] = [*cases(pool, strengths_, at, seeds, complete), *pairs(model, pool, two)]
    todo = [c for c in asked if c.key not in known]
    if done:
        output.note(f"{path}: {len(done)} runs are there already; {len(todo)} to do")
    with output.progress("confusion matrix") as progress:
        for number, case in enumerate(todo):
            progress(number / len(todo), f"{case.key} ({number + 1} of {len(todo)})")
            try:
                result = run_case(model, case, seconds) if isinstance(case, Case) else run_pair(model, case, seconds)
            except ModelError as problem:  # not every strength of every effect leaves the rotor standing
                output.note(f"{case.key}: not simulated: {problem}")
                continue
            done.append(result)
            with path.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(result) + "\n")
    together = [r for r in done if "pair" in r]
    tables = [markdown([r for r in done if "pair" not in r], seconds), hidden_pairs.markdown(together, seconds)]
    text = "\n".join(filter(None, tables))
    write_whole(out / "confusion.md", text)
    value = {"schema": 1, "seconds": seconds, "runs": done}
    write_whole(out / "confusion.json", json.dumps(value, indent=1) + "\n")
    output.result(value, text)


def read_runs(path: Path, seconds: float) -> list[dict[str, Any]]:
    """The runs of an earlier call; ConfigError if they are of another length or cannot be read."""
    if not path.exists():
        return []
    runs = []
    for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
        try:
            one: dict[str, Any] = json.loads(line)
            if one.get("seconds", seconds) != seconds:
                raise ConfigError(f"{path}, line {number}: a run of {one['seconds']:g} s; choose another --out")
            runs.append(one)
        except (ValueError, AttributeError) as problem:
            raise ConfigError(f"{path}, line {number}: not a run: {problem}; remove the line") from problem
    return runs
