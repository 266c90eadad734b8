"""Effects on clean rigs, found by `rotorscope improve`: python -m tests.foreign.clean. `campaign` has surroundings.

The product is asked through its commands alone, as a user would; the record comes from a simulator of another make.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .hidden import CATALOGUE, FORMS, OF_FORCE, OF_SENSOR, OUTSIDE, SPECTRA
from .record import Case, made, rig_file

WHOLE_KINDS: dict[str, tuple[str, ...]] = {
    "catalogue": CATALOGUE, "outside": (*OUTSIDE, *SPECTRA), "forms": tuple(FORMS), "pairs": ("",),
}  # fmt: skip
ONE_PLACE = (*OF_SENSOR, *OF_FORCE, *SPECTRA, "crack", "imbalance", "bow")


def cases(
    kinds: list[str], seeds: range, strengths: list[str], seconds: float, growth: float, varied: bool
) -> Iterator[Case]:
    """All cases of the kinds asked for: names of effects (+ between several), complete, outside, forms, catalogue,
    pairs."""
    for seed in seeds:
        for kind in kinds:
            if kind == "complete":
                yield Case({}, "-", seed, seconds, growth, varied)
                continue
            rng = np.random.default_rng([seed, 4])
            for name in WHOLE_KINDS.get(kind, (kind,)):
                for strength in strengths:
                    chosen = name.split("+") if name else [str(n) for n in rng.choice(CATALOGUE, 2, replace=False)]
                    at = {n: "bearing1" if n in ONE_PLACE or rng.uniform() < 0.5 else "both" for n in chosen}
                    yield Case(at, strength, seed, seconds, growth, varied)


def run(case: Case, folder: Path) -> dict[str, Any]:
    """What the product says of a case."""
    bench, base, y = made(case)
    rig, truth = bench.rig, bench.truth
    path = folder / case.key.replace("/", "_")
    path.mkdir(parents=True, exist_ok=True)
    (path / "rig.toml").write_text(rig_file(rig, base))
    truth_file = {"hidden": case.hidden, "rig": rig, "truth": truth}
    (path / "truth.json").write_text(json.dumps(truth_file, indent=1, default=float))
    names = [*rig["channels"], *(c.replace("b", "f") for c in rig["channels"] if rig["forced"])]
    channels = dict(zip(names, y.T, strict=True))
    np.savez(path / "record.npz", rate_hz=rig["rate"], **channels)
    del y, channels
    _rotorscope("import", path / "record.npz", "--rig", path / "rig.toml", "--out", path / "record.mcap")
    (path / "record.npz").unlink()
    start_s = time.perf_counter()
    found = _rotorscope("improve", path / "record.mcap", "--rig", path / "rig.toml", "--out", path / "better.toml")
    said = {
        "key": case.key, "base": base, "recorder": rig["recorder"], "shaft": rig["shaft"],
        "stiff": rig["ks"] > 0.1 * min(rig["kL"].values()), "seconds": time.perf_counter() - start_s,
    }  # fmt: skip
    if "ladder" not in found:
        return said | {"error": found.get("error", "")}
    added = [name for name in found["ladder"][-1]["effects"] if name not in base]
    off = {
        name: (p["value"] - truth[name]) / p["sd"]
        for name, p in found["parameters"].items()
        if name in truth and p["value"] is not None and p["sd"]
        and not (rig["forced"] and name.endswith(".S"))  # there it is what is left beside the measured force
    }  # fmt: skip
    return said | {
        "hidden": list(case.hidden), "added": added, "verdict": found["verdict"],
        "percent": [round(r["missing_force_percent"]["value"], 2) for r in found["ladder"]],
        "off": {k: round(v, 1) for k, v in off.items()}, "messages": found["messages"],
    }  # fmt: skip


def _rotorscope(*words: object) -> dict[str, Any]:
    command = [sys.executable, "-m", "daq", *map(str, words), "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        out: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        return {"error": done.stderr.strip()[-500:]}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    known = "catalogue, complete, outside, forms, pairs or names of effects (+ between several), by commas"
    parser.add_argument("--kinds", default="catalogue", help=known)
    parser.add_argument("--seeds", default="0:1", help="first:end")
    parser.add_argument("--strengths", default="weak,strong")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--growth", type=float, default=1.0)
    parser.add_argument("--varied", action="store_true", help="other shafts, rates, sets of channels, sensors")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "runs.jsonl"
    done = {json.loads(line)["key"] for line in path.read_text().splitlines()} if path.exists() else set()
    kinds, strengths = given.kinds.split(","), given.strengths.split(",")
    seeds = range(*map(int, given.seeds.split(":")))
    for case in cases(kinds, seeds, strengths, given.seconds, given.growth, given.varied):
        if case.key in done:
            continue
        result = run(case, given.out)
        with path.open("a") as lines:
            lines.write(json.dumps(result) + "\n")
        print(line_of(result), flush=True)


def line_of(result: dict[str, Any]) -> str:
    """One run for the eye: the missing force along the ladder, what was added, and the worst number in its sds."""
    shaft = "stiff" if result["stiff"] else "soft"
    shaft = shaft if result["shaft"] == "chain" else result["shaft"]
    head = f"{result['key']:45s} {result['recorder']:13s} {shaft:5s} {result['seconds']:4.0f} s  "
    if "error" in result:
        return head + str(result["error"])
    worst = max((abs(z) for z in result["off"].values()), default=0.0)
    added = ", ".join(result["added"]) or "-"
    fall = " -> ".join(f"{p:.2f}" for p in result["percent"])
    return f"{head}{fall} %  {added}  {result['verdict']}  {worst:.1f} sd"


if __name__ == "__main__":
    main()
