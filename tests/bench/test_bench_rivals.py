"""The spectral estimator beside the methods of others, on the same records.

    pip install -e .[rivals]
    ROTORSCOPE_SEEDS=10 pytest -m bench -s tests/bench/test_bench_rivals.py

Two tests: the rig of configs/tiwari_vyas_1997.toml (the integrator of tests/estimator/reference_rig.py), accelerations
at 25.6 kHz, 60 s; and the one-degree test of test_bench_duffing.py. No method is told anything of the truth but the
masses and, on the rig, the shaft. Slow rivals run on fewer records, whose number stands in the table. With
ROTORSCOPE_RESULTS=FILE each result is appended to the file and read back from it, so that a run can be continued.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "estimator"))
sys.path.insert(0, str(Path(__file__).parent))

import rivals
import test_bench_duffing as duffing
from kept_records import kept
from reference_rig import MASS, PLACES, RATE, SHAFT, SHAFT_DAMPING, TRUTH, rig_model

from estimator import fokker_planck, score_matching, spectral
from estimator.bandlimit import band_limit
from estimator.errors import DataError
from estimator.model import Channel, EffectUse, Model

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]
SEEDS = int(os.environ.get("ROTORSCOPE_SEEDS", "2"))
RESULTS = os.environ.get("ROTORSCOPE_RESULTS")
KNL = 1.3e18
WIDE = (150.0, 11400.0)  # Hz, for a method that wants the whole path
KEYS = ("kL", "c", "kNL", "S")
OURS = {"spectral": spectral, "score matching": score_matching, "eq. (36), response form": fokker_planck}
SLOW = {"SFI": int(os.environ.get("ROTORSCOPE_SLOW_SEEDS", "1"))}

Result = dict[str, dict[str, float]]  # place -> errors in %


def known() -> dict[str, tuple[Result, float, str]]:
    """Results that an earlier run wrote."""
    if RESULTS is None or not Path(RESULTS).is_file():
        return {}
    rows = [json.loads(line) for line in Path(RESULTS).read_text().splitlines()]
    return {row["key"]: (row["errors"], row["seconds"], row["note"]) for row in rows}


def run(key: str, solve: Callable[[], dict[str, dict[str, float]]], truth: dict[str, dict[str, float]]) -> None:
    """Time a method on a record and keep its errors in %, once."""
    if key in DONE:
        return
    note, found = "", {}
    begin = time.perf_counter()
    try:
        found = solve()
    except (DataError, ValueError, np.linalg.LinAlgError) as e:
        note = str(e).splitlines()[0]
    seconds = time.perf_counter() - begin
    errors = {
        place: {k: 100 * (found[place].get(k, np.nan) / true[k] - 1) for k in KEYS}
        for place, true in truth.items()
        if place in found
    }
    DONE[key] = (errors, seconds, note)
    if RESULTS is not None:
        with Path(RESULTS).open("a") as f:
            f.write(json.dumps({"key": key, "errors": errors, "seconds": seconds, "note": note}) + "\n")


DONE: dict[str, tuple[Result, float, str]] = {}


def table(test: str, methods: list[str]) -> None:
    """bias +- scatter of each quantity; seconds for a record of all its places."""
    print(f"\n{test} (load {os.getloadavg()[0]:.1f})")
    print("| method | records | kL % | c % | kNL % | S % | s |\n|---|---|---|---|---|---|---|")
    rms: dict[str, dict[str, float]] = {}
    for method in methods:
        rows = [z for key, z in DONE.items() if key.startswith(f"{test}/{method}/")]
        if not rows:
            print(f"| {method} | not run | | | | | |")
            continue
        cells, rms[method] = [], {}
        for k in KEYS:
            e = np.array([place[k] for errors, _, _ in rows for place in errors.values()], float)
            e = e[np.isfinite(e)]
            if e.size:
                rms[method][k] = float(np.sqrt(np.mean(e**2)))
            cells.append(f"{e.mean():.2f} +- {e.std():.2f}" if e.size else "-")
        seconds = float(np.median([s for _, s, _ in rows]))
        print(f"| {method} | {len(rows)} | {' | '.join(cells)} | {seconds:.2f} |")
        for note in sorted({n for _, _, n in rows if n}):
            print(f"|  | {note} | | | | | |")
    lost = [
        f"{k} to {m} (rms {r[k]:.2f} % against {rms['spectral'][k]:.2f} %)"
        for m, r in rms.items()
        for k in r
        if m != "spectral" and r[k] < rms["spectral"][k]
    ]
    print("We lose: " + ("; ".join(lost) if lost else "nowhere"))


def plain(parameters: dict) -> dict[str, dict[str, float]]:
    """place -> {kL, c, kNL, S} from the parameters of one of our fits."""
    out: dict[str, dict[str, float]] = {}
    for name, p in parameters.items():
        place, key = name.rsplit(".", 1)[0].removesuffix(".cubic"), name.rsplit(".", 1)[1]
        out.setdefault(place, {})[key] = np.nan if p.value is None else p.value
    return out


def wanted(method: str, n: int) -> bool:
    package = rivals.PACKAGES.get(method)
    return n < SLOW.get(method, SEEDS) and (package is None or importlib.util.find_spec(package) is not None)


def test_two_bearing_rig() -> None:
    DONE.update(known())
    test, band = "two-bearing rig", (150.0, 8000.0)
    truth = {
        p: {"kL": TRUTH["kL"][i], "c": TRUTH["c"][i], "kNL": KNL, "S": TRUTH["S"][i]} for i, p in enumerate(PLACES)
    }
    model = rig_model("cubic", band=band)
    for seed in range(SEEDS):
        y = kept("cubic", seed)
        for method, module in OURS.items():
            run(f"{test}/{method}/{seed}", lambda m=module, y=y: plain(dict(m.fit(model, y, RATE).parameters)), truth)
        motion = band_limit(y, ["acceleration"] * 4, RATE, band)
        wide = band_limit(y, ["acceleration"] * 4, RATE, WIDE)
        places = {}
        for i, p in enumerate(PLACES):
            x, v, a = (getattr(motion, n)[i, motion.valid] for n in "xva")
            shaft = (SHAFT, SHAFT_DAMPING)
            places[p] = rivals.Place(x, v, a, y[:, i], wide.x[i, wide.valid], RATE, band, MASS, shaft)
        for method, solve in rivals.METHODS.items():
            if wanted(method, seed):
                some = dict(list(places.items())[: 1 if method in SLOW else 4])
                run(f"{test}/{method}/{seed}", lambda f=solve, z=some: {p: f(place) for p, place in z.items()}, truth)
    table(test, [*OURS, *rivals.METHODS])


@pytest.mark.parametrize("sigma", [0.5, 1.0])
@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_one_degree(noise: float, sigma: float) -> None:
    DONE.update(known())
    test = f"one degree, noise {100 * noise:g} %, linear rms {sigma:g}"
    band, whole = (10.0, 300.0), (10.0, 450.0)  # least squares on derivatives does better in the narrower one
    cubic = (EffectUse("cubic", {"bearing1.x": {}}),)
    models = {
        b: Model((Channel("d", "bearing1", "x", "displacement"),), b, "none", {"bearing1": 1.0}, effects=cubic)
        for b in (band, whole)
    }
    for seed in range(SEEDS):
        y, S = duffing.record(seed, noise, sigma)
        truth = {
            "bearing1.x": {
                "kL": duffing.TRUTH["kL"], "c": duffing.TRUTH["c"], "kNL": duffing.TRUTH["cubic.kNL"], "S": S
            }
        }  # fmt: skip
        for method, module in OURS.items():
            model = models[whole if method == "spectral" else band]
            run(
                f"{test}/{method}/{seed}",
                lambda f=module.fit, m=model, y=y: plain(dict(f(m, y[:, None], duffing.RATE).parameters)),
                truth,
            )
        motion = band_limit(y[:, None], ["displacement"], duffing.RATE, band)
        x, v, a = (getattr(motion, n)[0, motion.valid] for n in "xva")
        place = rivals.Place(x, v, a, y, y, duffing.RATE, band, 1.0)
        for method, solve in rivals.METHODS.items():
            if wanted(method, seed):
                run(f"{test}/{method}/{seed}", lambda f=solve, z=place: {"bearing1.x": f(z)}, truth)
    table(test, [*OURS, *rivals.METHODS])
