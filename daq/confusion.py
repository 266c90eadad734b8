"""The confusion matrix of the diagnosis: hidden effects by our own simulator, what is named, in Markdown and JSON.

    python -m daq.confusion --rig configs/tiwari_vyas_1997.toml --out build/confusion --seconds 20 --seeds 1

One line of JSON per run is appended to OUT/runs.jsonl, so an interrupted matrix goes on where it stopped. The truth is
known only to this file; the diagnosis sees samples and the rig without the effect.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads only wait for each other

import numpy as np

from estimator.diagnose import diagnose
from estimator.effects import CATALOGUE
from estimator.effects.places import places
from estimator.effects.strength import size, strengths, with_effect
from estimator.errors import ModelError
from estimator.model import Model, Setting
from estimator.simulate import simulate

from .rig import load_rig

RATE_HZ = 25600.0
FRACTIONS = {"weak": 0.02, "strong": 0.06}
COMPLETE = "complete"


@dataclass(frozen=True, slots=True)
class Case:
    """One run: a hidden effect (or "complete"), its strength, where it acts, the seed."""

    effect: str
    strength: str
    at: str  # bearing1 | both
    seed: int

    @property
    def key(self) -> str:
        return f"{self.effect}/{self.strength}/{self.at}/{self.seed}"


def cases(
    effects: Iterable[str], strength_names: Iterable[str], at: Iterable[str], seeds: int, complete: int
) -> list[Case]:
    """Every run asked for; a complete model has only its seed."""
    out = [Case(COMPLETE, "-", "-", s) for s in range(complete)]
    for seed in range(seeds):
        out += [Case(e, s, a, seed) for e in effects for s in strength_names for a in at if not _single(e, a)]
    return out


def _single(effect: str, at: str) -> bool:
    """Effects of the whole rig or of one sensor have one place only."""
    kind = CATALOGUE[effect].kind
    return at == "both" and (kind in ("disc", "shaft", "sensor") or effect == "correlated_force")


def varied(model: Model, seed: int) -> tuple[Model, float]:
    """A complete model of its own for every seed: damping, stiffness, forces, and the sensor noise (m/s^2)."""
    rng = np.random.default_rng(1000 + seed)
    linear = {}
    for place, old in model.linear.items():
        new = dict(old)
        for name, low, high in (("kL", 0.8, 1.25), ("c", 0.4, 2.5), ("S", 0.6, 1.6)):
            new[name] = Setting((old[name].value or 0.0) * float(np.exp(rng.uniform(np.log(low), np.log(high)))))
        linear[place] = new
    return replace(model, linear=linear), float(np.exp(rng.uniform(np.log(0.005), np.log(0.1))))


def hidden(model: Model, case: Case, seconds: float) -> tuple[Model, Model, float]:
    """(what is simulated, what the diagnosis is given, sensor noise)."""
    if case.effect == COMPLETE:
        truth, noise = varied(model, case.seed)
        return truth, model, noise
    effect = CATALOGUE[case.effect]
    known = replace(model, effects=tuple(u for u in model.effects if u.name != case.effect))
    can = places(effect, model)
    first = [p for p in can if p.startswith("bearing1")] or list(can)
    if effect.kind == "sensor":
        first = first[:1]
    where = tuple(can) if case.at == "both" else tuple(first)
    values = strengths(effect, size(model, "bearing1.x", RATE_HZ), FRACTIONS[case.strength], model, seconds)
    return with_effect(known, effect, values, *where), known, 0.02


def run(model: Model, case: Case, seconds: float) -> dict[str, Any]:
    """Simulate and diagnose one case."""
    truth, known, noise = hidden(model, case, seconds)
    y = simulate(truth, RATE_HZ, seconds, seed=7000 + case.seed, noise=noise, full_scale=490.5)
    begin = time.process_time()
    found = diagnose(known, y, RATE_HZ)
    top = found.ranking[0] if found.ranking else None
    return {
        "key": case.key,
        "effect": case.effect,
        "strength": case.strength,
        "at": case.at,
        "seed": case.seed,
        "verdict": found.verdict,
        "named_at": list(top.at) if top else [],
        "gain": top.gain if top else 0.0,
        "p_value": top.p_value if top else 1.0,
        "runner_up": found.ranking[1].effect if len(found.ranking) > 1 else "",
        "before_percent": top.before_percent if top else 0.0,
        "after_percent": top.after_percent if top else 0.0,
        "cpu_seconds": time.process_time() - begin,
    }


def markdown(runs: list[Mapping[str, Any]], seconds: float) -> str:
    """The matrix as a table: hidden effect by strength, how often it was named, and what else was said."""
    lines = [
        f"{len(runs)} runs of {seconds:g} s at {RATE_HZ:g} Hz, int16 counts, sensor noise.",
        "",
        "| hidden | strength | at | named right | otherwise |",
        "|---|---|---|---|---|",
    ]
    groups: dict[tuple[str, str, str], list[str]] = {}
    for r in runs:
        groups.setdefault((r["effect"], r["strength"], r["at"]), []).append(r["verdict"])
    right = total = 0
    for (effect, strength, at), verdicts in sorted(groups.items()):
        good = sum(v == effect for v in verdicts)
        others = Counter(v for v in verdicts if v != effect)
        right, total = right + good, total + len(verdicts)
        told = ", ".join(f"{k} {n}" for k, n in others.most_common())
        lines.append(f"| {effect} | {strength} | {at} | {good}/{len(verdicts)} | {told} |")
    lines += ["", f"All: {right}/{total}."]
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Run what is missing of the matrix, then write OUT/confusion.md and OUT/confusion.json."""
    parser = argparse.ArgumentParser(prog="python -m daq.confusion", description=__doc__.splitlines()[0])
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--effects", default=",".join(CATALOGUE), help="names with commas")
    parser.add_argument("--strengths", default="weak,strong")
    parser.add_argument("--at", default="bearing1")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--complete", type=int, default=0, help="runs with nothing hidden")
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args(arguments)
    model = load_rig(given.rig).model
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "runs.jsonl"
    done = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    known = {r["key"] for r in done}
    effects = [e for e in given.effects.split(",") if e]
    for case in cases(effects, given.strengths.split(","), given.at.split(","), given.seeds, given.complete):
        if case.key in known:
            continue
        try:
            result = run(model, case, given.seconds)
        except ModelError as problem:  # not every strength of every effect leaves the rotor standing
            os.write(1, f"{case.key}: not simulated: {problem}\n".encode())
            continue
        done.append(result)
        with path.open("a") as out:
            out.write(json.dumps(result) + "\n")
        os.write(
            1, f"{case.key}: {result['verdict']} {result['gain']:.0f} nats, {result['cpu_seconds']:.0f} s\n".encode()
        )
    (given.out / "confusion.md").write_text(markdown(done, given.seconds))
    (given.out / "confusion.json").write_text(
        json.dumps({"schema": 1, "seconds": given.seconds, "runs": done}, indent=1)
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
