"""Bias, scatter, coverage and the distance to the Cramer-Rao bound of the spectral estimator, side by side.

    ROTORSCOPE_SEEDS=50 pytest -m bench -s tests/bench/test_bench_estimator.py

Records come from the integrator of tests/estimator/reference_rig.py, which shares nothing with the package. The bound
is that of the whole path observed without noise (Girsanov): the information in T seconds is T E[psi psi^T] / Q with
psi = (x, v, forces of the effects per unit) and Q = S / 2 the intensity of the force, known; moments from equipartition
m <v^2> = S / (4 c) = kL <x^2> + 3 kNL <x^2>^2. It uses no part of the estimator.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "estimator"))

from reference_rig import COULOMB, MASS, PLACES, QUADRATIC_DAMPING, RATE, TRUTH, rig_model, rig_record

from estimator import spectral

SEEDS = int(os.environ.get("ROTORSCOPE_SEEDS", "4"))
SECONDS = float(os.environ.get("ROTORSCOPE_SECONDS", "60"))
KNL = 1.3e18

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]


def moments(i: int, kNL: float, extra_damping: float = 0.0) -> tuple[float, float, float]:
    """<x^2>, <v^2> and Q at a place."""
    k, c, S = (TRUTH[key][i] for key in ("kL", "c", "S"))
    energy = S / (4 * (c + extra_damping))
    x2 = (-k + np.sqrt(k * k + 12 * kNL * energy)) / (6 * kNL) if kNL else energy / k
    return x2, energy / MASS, S / 2


def bound(i: int, kNL: float, effect: str | None) -> dict[str, float]:
    """Relative Cramer-Rao sd of each parameter of a place, Gaussian moments."""
    amplitude = {"coulomb": 0.07, "quadratic_damping": 1e4, None: 0.0}[effect]
    c = 0.0
    for _ in range(50):  # mean extra damping of the effect at the level that it leaves
        x2, v2, Q = moments(i, kNL, c)
        sd = np.sqrt(v2)
        c = {"coulomb": np.sqrt(2 / np.pi) / sd, "quadratic_damping": np.sqrt(8 / np.pi) * sd, None: 0.0}[
            effect
        ] * amplitude
    z = np.random.default_rng(0).normal(size=(2, 400000))
    x, v = np.sqrt(x2) * z[0], np.sqrt(v2) * z[1]
    psi = {"kL": x, "c": v}
    if kNL:
        psi["kNL"] = x**3
    if effect == "coulomb":
        psi["fc"] = np.sign(v)
    if effect == "quadratic_damping":
        psi["cq"] = v * np.abs(v)
    rows = np.array(list(psi.values()))
    information = SECONDS / Q * rows @ rows.T / x.size
    sd = np.sqrt(np.diag(np.linalg.inv(information)))
    truth = {"kL": TRUTH["kL"][i], "c": TRUTH["c"][i], "kNL": KNL, "fc": amplitude, "cq": amplitude}
    return {key: float(s / truth[key]) for key, s in zip(psi, sd, strict=True)}


@pytest.mark.parametrize(
    ("effects", "kNL", "column", "value"),
    [
        ((), 0.0, None, 0.0),
        (("cubic",), KNL, None, 0.0),
        (("cubic", "coulomb"), KNL, COULOMB, 0.07),
        (("cubic", "quadratic_damping"), KNL, QUADRATIC_DAMPING, 1e4),
    ],
    ids=["linear", "cubic", "coulomb", "quadratic damping"],
)
def test_bias_scatter_coverage(effects: tuple[str, ...], kNL: float, column: int | None, value: float) -> None:
    hidden = np.zeros((4, 7))
    if column is not None:
        hidden[:, column] = value
    truth = {"kNL": KNL, "fc": value, "cq": value}
    errors: dict[str, list[tuple[float, float, float]]] = {}
    took = []
    extra = next((e for e in effects if e != "cubic"), None)
    bounds = [bound(i, kNL, extra) for i in range(4)]
    for seed in range(SEEDS):
        y = rig_record(SECONDS, seed=1000 + seed, kNL=kNL, hidden=hidden)
        begin = time.perf_counter()
        solution = spectral.analyse(rig_model(*effects), y, RATE)
        took.append(time.perf_counter() - begin)
        sd = np.sqrt(np.diag(solution.covariance))
        for j, name in enumerate(solution.balance.names):
            i, key = next(i for i, p in enumerate(PLACES) if name.startswith(p)), name.split(".")[-1]
            true = TRUTH[key][i] if key in TRUTH else truth[key]
            errors.setdefault(key, []).append((solution.values[name] / true - 1, sd[j] / true, bounds[i][key]))
        for i in range(4):
            log_sd = sd[len(solution.balance.names) + i]
            errors.setdefault("S", []).append((solution.point.S[i] / TRUTH["S"][i] - 1, log_sd, np.nan))
    name = " + ".join(effects) or "linear"
    print(f"\n{name}: {SEEDS} records of {SECONDS:g} s, 4 places; fit {np.median(took):.2f} s")
    print("            bias %  scatter %  sd given %  bound %  ratio  covers")
    for key, rows in errors.items():
        e, s, b = 100 * np.array(rows).T
        scatter = np.sqrt(np.mean((e / b) ** 2)) if np.isfinite(b).all() else np.nan
        print(
            f"{key:4s} {e.mean():7.3f} +-{e.std() / np.sqrt(e.size):5.3f} {e.std():10.3f} {np.median(s):11.3f} "
            f"{np.median(b):8.3f} {scatter:6.2f} {np.mean(np.abs(e) < 1.96 * s):7.2f}"
        )
        assert abs(e.mean()) < 5 * e.std() / np.sqrt(e.size) + {"kL": 0.3, "kNL": 3.0, "c": 2.0}.get(key, 10.0)


def regression(y: np.ndarray) -> dict[str, float]:
    """Least squares of m a on v, x, x^3 in the band: what sparse regression on derivatives does at best."""
    from estimator.bandlimit import band_limit

    motion = band_limit(y, ["acceleration"] * 4, RATE, (150.0, 8000.0))
    out = {}
    for i, place in enumerate(PLACES):
        a, v, x = (getattr(motion, n)[i, motion.valid] for n in "avx")
        columns = np.stack([x / x.std(), v / v.std(), x**3 / x.std() ** 3])
        solved = np.linalg.solve(columns @ columns.T, columns @ (-MASS * a))
        out |= {f"{place}.kL": solved[0] / x.std(), f"{place}.c": solved[1] / v.std()}
        out[f"{place}.cubic.kNL"] = solved[2] / x.std() ** 3
    return out


def test_beside_other_methods_on_the_same_records() -> None:
    """The two-bearing rig, cubic: errors of kL, c, kNL by each method of this repository and a plain regression."""
    from estimator import fokker_planck, score_matching

    def values(parameters: dict) -> dict[str, float]:
        return {k: (np.nan if p.value is None else p.value) for k, p in parameters.items()}

    methods = {
        "spectral": lambda y: values(dict(spectral.fit(rig_model("cubic"), y, RATE).parameters)),
        "score matching": lambda y: values(dict(score_matching.fit(rig_model("cubic"), y, RATE).parameters)),
        "eq. (36)": lambda y: values(dict(fokker_planck.fit(rig_model("cubic"), y, RATE).parameters)),
        "regression": regression,
    }
    print(f"\n{max(2, SEEDS // 2)} records of {SECONDS:g} s; rms error over places and records, %")
    errors: dict[str, dict[str, list[float]]] = {m: {} for m in methods}
    took = dict.fromkeys(methods, 0.0)
    for seed in range(max(2, SEEDS // 2)):
        y = rig_record(SECONDS, seed=2000 + seed, kNL=KNL)
        for method, run in methods.items():
            begin = time.perf_counter()
            try:
                found = run(y)
            except ValueError as e:
                print(f"{method}: {e}")
                found = {}
            took[method] += time.perf_counter() - begin
            for i, place in enumerate(PLACES):
                for key, true in (("kL", TRUTH["kL"][i]), ("c", TRUTH["c"][i]), ("cubic.kNL", KNL)):
                    errors[method].setdefault(key, []).append(100 * (found.get(f"{place}.{key}", np.nan) / true - 1))
    for method, by in errors.items():
        words = [
            f"{key} {np.sqrt(np.nanmean(np.square(e))) if np.isfinite(e).any() else np.nan:8.2f}"
            for key, e in by.items()
        ]
        print(f"{method:15s} {'  '.join(words)}   {took[method] / max(2, SEEDS // 2):6.2f} s")
    ours = {k: np.sqrt(np.nanmean(np.square(e))) for k, e in errors["spectral"].items()}
    for method, by in errors.items():
        if method != "spectral":
            for key, e in by.items():
                assert not np.isfinite(e).any() or ours[key] <= np.sqrt(np.nanmean(np.square(e)))
