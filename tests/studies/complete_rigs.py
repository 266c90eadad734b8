"""Complete rigs drawn at random: what `compare` and `diagnose` claim of a model that lacks nothing.

    python -m tests.studies.complete_rigs --count 200 --out build/complete_rigs

One line of JSON per rig is appended to OUT/runs.jsonl; a second call goes on where the first one stopped. A claim is
a verdict that names an effect or the rig file, or a message that lays something to the shaft or to a mass. An "unknown"
and a "complete" that `compare` does not share are counted beside the claims.
Noise of the sensors is in every record, so a verdict that names it is true.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from estimator import CATALOGUE, Channel, DataError, EffectUse, Model, ModelError, Setting, compare, diagnose, simulate

SECONDS = 20.0
CLAIMS = frozenset({"rig_file", "caps_coupled_otherwise"})  # codes of messages that blame the rig file
NOISE = next(name for name, effect in CATALOGUE.items() if effect.kind == "sensor" and name.endswith("noise"))


def drawn_rig(seed: int) -> tuple[Model, float, float]:
    """A complete rig with all its values, the rate in Hz, and the sensor noise, m/s^2 rms.

    Caps of 0.1 to 8 kg, bearings at 250 to 2500 Hz with 0.6 to 6 % of damping, the disc at 0.03 to 0.8 of that.
    """
    rng = np.random.default_rng([20261127, seed])

    def log_uniform(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    cap, bearing_hz, disc_ratio = log_uniform(0.1, 8.0), log_uniform(250.0, 2500.0), log_uniform(0.03, 0.8)
    shaft = ("chain", "beam")[int(rng.integers(2))]
    disc = cap * log_uniform(0.5, 5.0)
    disc_w = 2 * np.pi * disc_ratio * bearing_hz
    stiffness = disc * disc_w**2 / (2.0 if shaft == "chain" else 4.0)
    shaft_damping = 2 * log_uniform(1e-3, 2e-2) * stiffness / disc_w
    rate_hz = float(round(bearing_hz * log_uniform(8.0, 20.0) / 100) * 100)
    low = bearing_hz * log_uniform(0.05, 0.4)
    high = rate_hz * rng.uniform(0.28, 0.42)
    directions = "x" if rng.random() < 0.6 else "xy"
    mass = {"disc": disc}
    linear: dict[str, dict[str, Setting]] = {}
    cubic: dict[str, dict[str, Setting]] = {}
    is_cubic = rng.random() < 0.5
    for node in ("bearing1", "bearing2"):
        mass[node] = cap * log_uniform(0.8, 1.25)
        for direction in directions:
            w = 2 * np.pi * bearing_hz * log_uniform(0.9, 1.1)
            k, c = mass[node] * w**2, 2 * log_uniform(0.006, 0.06) * mass[node] * w
            x_rms = log_uniform(2e-8, 2e-6)
            linear[f"{node}.{direction}"] = {
                "kL": Setting(k), "c": Setting(c), "S": Setting(4.0 * k * c * x_rms**2)
            }  # fmt: skip
            cubic[f"{node}.{direction}"] = {"kNL": Setting(rng.uniform(0.005, 0.02) * k / x_rms**2)}
    model = Model(
        tuple(Channel(f"b{p[7]}{p[-1]}", *p.split(".")) for p in linear),
        band=(low, high), shaft=shaft, mass=mass, shaft_stiffness=stiffness, shaft_damping=shaft_damping,
        speed_rpm=60 * bearing_hz * log_uniform(0.01, 0.1), linear=linear,
        effects=(EffectUse("cubic", cubic),) if is_cubic else (), name=f"rig {seed}",
    )  # fmt: skip
    strongest = max(np.sqrt(v["S"].value * rate_hz / 2) / mass[p[:8]] for p, v in linear.items())  # type: ignore[operator]
    return model, rate_hz, float(strongest * log_uniform(3e-4, 1e-2))


def named_rig(seed: int) -> tuple[Model, float, float]:
    """The four caps of Tiwari and Vyas with a band from 30 Hz: the disc resonates at 123 Hz inside the band."""
    from dataclasses import replace

    from tests.golden.records import four_caps

    rig = four_caps()
    return replace(rig, band=(30.0, 8000.0)), 25600.0, 0.02


def as_user(model: Model) -> Model:
    """The rig file before a fit: masses and shaft, no stiffness, no damping, no force, no size of a law."""
    from dataclasses import replace

    blank = tuple(EffectUse(u.name, {place: {} for place in u.at}) for u in model.effects)
    return replace(model, linear={}, effects=blank)


def run(seed: int, *, named: bool = False, seconds: float = SECONDS) -> dict[str, Any]:
    """What compare and diagnose say of one rig."""
    truth, rate_hz, noise = (named_rig if named else drawn_rig)(seed)
    w = {p: np.sqrt(v["kL"].value / truth.mass[p[:8]]) / 2 / np.pi for p, v in truth.linear.items()}  # type: ignore[operator]
    disc_hz = np.sqrt(truth.shaft_stiffness * (2 if truth.shaft == "chain" else 4) / truth.mass["disc"]) / 2 / np.pi
    out: dict[str, Any] = {
        "seed": seed, "shaft": truth.shaft, "cap_kg": truth.mass["bearing1"], "bearing_hz": w["bearing1.x"],
        "disc_hz": float(disc_hz), "band": truth.band, "rate_hz": rate_hz, "cubic": bool(truth.effects),
        "channels": len(truth.channels),
    }  # fmt: skip
    begin = time.process_time()
    try:
        y = simulate(truth, rate_hz, seconds, seed=seed, noise=noise)
        model = as_user(truth)
        compared = compare(model, y, rate_hz)
        found = diagnose(model, y, rate_hz)
    except (DataError, ModelError) as problem:
        return out | {"verdict": "refused", "claims": False, "text": str(problem)[:200]}
    codes = [m.code for m in found.messages]
    claims = found.verdict not in ("complete", "unknown", NOISE) or bool(CLAIMS.intersection(codes))
    top = found.ranking[0] if found.ranking else None
    errors = {}
    for place, settings in truth.linear.items():
        for name in ("kL", "c"):
            p = compared.parameters.get(f"{place}.{name}")
            if p is not None and p.value is not None and p.sd:
                errors[f"{place}.{name}"] = (p.value - settings[name].value) / p.sd  # type: ignore[operator]
    return out | {
        "verdict": found.verdict, "adequate": compared.adequate, "missing": compared.missing, "claims": claims,
        "where": [asdict(w) for w in compared.where][:3],
        "top": None if top is None else [top.effect, list(top.at), top.gain, top.p_value, top.explained_percent],
        "codes": codes, "text": " / ".join(m.text for m in found.messages)[:400], "z": errors,
        "cpu_s": time.process_time() - begin,
    }  # fmt: skip


def line(r: dict[str, Any]) -> str:
    """One rig as a line of the table."""
    rig = (
        f"{r['seed']:4d} {r['shaft']:5s} {r['channels']} ch {'cubic' if r['cubic'] else '     '} {r['cap_kg']:5.2f} kg "
        f"bearing {r['bearing_hz']:5.0f} disc {r['disc_hz']:5.0f} band {r['band'][0]:4.0f}-{r['band'][1]:5.0f} Hz"
    )
    if r["verdict"] == "refused":
        return f"{rig} | refused: {r['text']}"
    z = max((abs(v) for v in r["z"].values()), default=0.0)
    return (
        f"{rig} | {r['verdict']:20s} {'adequate' if r['adequate'] else 'NOT adequate'} {r['missing'][0]:.2f} % "
        f"z {z:.1f} {'CLAIM' if r['claims'] else ''} {','.join(r['codes'])} {r['top']}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--named", action="store_true", help="the rig whose disc rings at 123 Hz in the band")
    parser.add_argument("--out", type=Path, default=Path("build/complete_rigs"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / ("named.jsonl" if given.named else "runs.jsonl")
    done = {r["seed"]: r for r in map(json.loads, path.read_text().splitlines())} if path.exists() else {}
    for seed in range(given.first, given.first + given.count):
        if seed not in done:
            done[seed] = run(seed, named=given.named)
            with path.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(done[seed]) + "\n")
        print(line(done[seed]), flush=True)
    asked = [done[s] for s in range(given.first, given.first + given.count)]
    judged = [r for r in asked if r["verdict"] != "refused"]
    wrong = sum(r["claims"] for r in judged)
    complete = sum(r["verdict"] in ("complete", NOISE) and r["adequate"] for r in judged)
    unknown = sum(r["verdict"] == "unknown" for r in judged)
    apart = sum(r["verdict"] == "complete" and not r["adequate"] for r in judged)
    print(
        f"{wrong} of {len(judged)} complete rigs claim something; {complete} complete, {unknown} unknown, "
        f"{apart} complete but not adequate; {len(asked) - len(judged)} refused"
    )


if __name__ == "__main__":
    main()
