"""The spectral estimator beside the methods of others, on the same records.

    pip install -e .[rivals]
    ROTORSCOPE_SEEDS=10 pytest -m bench -s tests/bench/test_bench_rivals.py

Two tests: the rig of configs/tiwari_vyas_1997.toml (the integrator of tests/estimator/reference_rig.py), accelerations
at 25.6 kHz, 60 s; and the one-degree test of test_bench_duffing.py. No method knows anything of the truth but the
masses and, on the rig, the shaft. Slow rivals run on fewer records, whose number stands in the table
(ROTORSCOPE_SLOW_SEEDS), and on the rig on ten seconds of one place. With
ROTORSCOPE_RESULTS=FILE each result is appended to the file and read back from it, so that a run can be continued.
"""

from __future__ import annotations

import importlib.util
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rivals
import test_bench_duffing as duffing
from kept_records import kept
from reference_rig import MASS, PLACES, RATE, SHAFT, SHAFT_DAMPING, TRUTH, rig_model

from estimator.errors import DataError
from estimator.identification.batch import spectral
from estimator.identification.moments import fokker_planck, score_matching
from estimator.model.rig import Channel, EffectUse, Model
from estimator.signals.band_limit import BandLimitedMotion
from estimator.signals.band_limited_record import band_limit

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]
SEEDS = int(os.environ.get("ROTORSCOPE_SEEDS", "2"))
RESULTS = os.environ.get("ROTORSCOPE_RESULTS")
KNL = 1.3e18
BAND = (150.0, 8000.0)  # Hz, of the rig
KEYS = ("kL", "c", "kNL", "S")
EXACT = "(exact path)"  # the whole path without noise: the luck of the record
FIT_BY_METHOD = {
    "spectral": spectral.fit_spectral,
    "score matching": score_matching.fit_score_matching,
    "eq. (36), response form": fokker_planck.fit_fokker_planck,
}
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
    for method in methods:
        rows = [z for key, z in DONE.items() if key.startswith(f"{test}/{method}/")]
        if not rows:
            print(f"| {method} | not run | | | | | |")
            continue
        cells = []
        for k in KEYS:
            e = values([errors for errors, _, _ in rows], k)
            cells.append(f"{e.mean():.2f} +- {e.std():.2f}" if e.size else "-")
        seconds = float(np.median([s for _, s, _ in rows]))
        print(f"| {method} | {len(rows)} | {' | '.join(cells)} | {seconds:.2f} |")
        for note in sorted({n for _, _, n in rows if n}):
            print(f"|  | {note} | | | | | |")
    lost = []
    for method in (m for m in methods[1:] if m != EXACT):  # rms over the records that both have
        seeds = [key.rsplit("/", 1)[1] for key in DONE if key.startswith(f"{test}/{method}/")]
        for k in KEYS:
            ours, theirs = (values([DONE[f"{test}/{m}/{seed}"][0] for seed in seeds], k) for m in ("spectral", method))
            a, b = (float(np.sqrt(np.mean(e**2))) if e.size else np.inf for e in (ours, theirs))
            if b < a:
                lost.append(f"{k} to {method} (rms {b:.2f} % against {a:.2f} %, {len(seeds)} records)")
    if EXACT in methods:
        there = [m for m in ("spectral", "SFI", "regression") if any(k.startswith(f"{test}/{m}/") for k in DONE)]
        less = [f"{m} {apart(test, m)}" for m in there]
        print("Without the luck of the records (mean error less that of the exact path): " + "; ".join(less))
    print("We lose: " + ("; ".join(lost) if lost else "nowhere"))


def apart(test: str, method: str) -> str:
    """What a method's errors are beyond those of the exact path, in the mean, with the standard error."""
    words = []
    for k in ("kL", "kNL"):
        seeds = [key.rsplit("/", 1)[1] for key in DONE if key.startswith(f"{test}/{method}/")]
        d = np.array([values([DONE[f"{test}/{m}/{s}"][0] for s in seeds], k) for m in (method, EXACT)])
        d = d[0] - d[1]
        words.append(f"{k} {d.mean():+.2f} +- {d.std() / np.sqrt(d.size):.2f}")
    return ", ".join(words)


def values(results: list[Result], key: str) -> np.ndarray:
    """Errors of one quantity in %, all places, what was found."""
    e = np.array([place[key] for errors in results for place in errors.values()], float)
    return e[np.isfinite(e)]


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
    test = "two-bearing rig"
    truth = {
        p: {"kL": TRUTH["kL"][i], "c": TRUTH["c"][i], "kNL": KNL, "S": TRUTH["S"][i]} for i, p in enumerate(PLACES)
    }
    model = rig_model("cubic", band=BAND)
    for seed in range(SEEDS):
        y = kept("cubic", seed)
        for method, fit in FIT_BY_METHOD.items():
            run(f"{test}/{method}/{seed}", lambda f=fit, y=y: plain(dict(f(model, y, RATE).parameters)), truth)
        motion = band_limit(y, ["acceleration"] * 4, RATE, BAND)
        places = {p: place_of_rig(motion, y, i) for i, p in enumerate(PLACES)}
        for method, solve in rivals.METHODS.items():
            if method not in SLOW and wanted(method, seed):
                run(f"{test}/{method}/{seed}", lambda f=solve, z=places: {p: f(at) for p, at in z.items()}, truth)
    table(test, [*FIT_BY_METHOD, *(m for m in rivals.METHODS if m not in SLOW)])


def place_of_rig(motion: BandLimitedMotion, y: np.ndarray, i: int) -> rivals.Place:
    x, v, a = (getattr(motion, n)[i, motion.valid] for n in "xva")
    return rivals.Place(x, v, a, y[:, i], x, RATE, BAND, MASS, (SHAFT, SHAFT_DAMPING))


def test_ten_seconds_of_one_place_of_the_rig() -> None:
    """For what would take hours on all of it."""
    DONE.update(known())
    test, p = "10 s of one place of the rig", PLACES[0]
    truth = {p: {"kL": TRUTH["kL"][0], "c": TRUTH["c"][0], "kNL": KNL, "S": TRUTH["S"][0]}}
    for seed in range(max(SLOW.values())):
        y = kept("cubic", seed)[: int(10 * RATE)]
        run(
            f"{test}/spectral/{seed}",
            lambda y=y: plain(dict(spectral.fit_spectral(rig_model("cubic"), y, RATE).parameters)),
            truth,
        )
        motion = band_limit(y, ["acceleration"] * 4, RATE, BAND)
        for method in SLOW:
            if wanted(method, seed):
                run(
                    f"{test}/{method}/{seed}",
                    lambda f=rivals.METHODS[method], y=y, m=motion: {p: f(place_of_rig(m, y, 0))},
                    truth,
                )
    table(test, ["spectral", *SLOW])


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
        for method, fit in FIT_BY_METHOD.items():
            model = models[whole if method == "spectral" else band]
            run(
                f"{test}/{method}/{seed}",
                lambda f=fit, m=model, y=y: plain(dict(f(m, y[:, None], duffing.RATE).parameters)),
                truth,
            )
        motion = band_limit(y[:, None], ["displacement"], duffing.RATE, band)
        x, v, a = (getattr(motion, n)[0, motion.valid] for n in "xva")
        place = rivals.Place(x, v, a, y, y, duffing.RATE, band, 1.0)
        for method, solve in rivals.METHODS.items():
            if wanted(method, seed):
                run(f"{test}/{method}/{seed}", lambda f=solve, z=place: {"bearing1.x": f(z)}, truth)
        run(f"{test}/{EXACT}/{seed}", lambda n=seed: {"bearing1.x": duffing.exact_path(n, sigma)}, truth)
    table(test, [*FIT_BY_METHOD, *rivals.METHODS, EXACT])
