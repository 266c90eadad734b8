"""Bias, scatter, coverage and the distance to the Cramer-Rao bound of the spectral estimator, side by side.

    ROTORSCOPE_SEEDS=50 pytest -m bench -s tests/bench/test_bench_estimator.py

With ROTORSCOPE_RECORDS=DIR and ROTORSCOPE_RESULTS=FILE records and results are kept and a run can be continued.
Records come from the integrator of tests/estimator/reference_rig.py, which shares nothing with the package. The bound
is that of the whole path observed without noise (Girsanov): the information in T seconds is T E[psi psi^T] / Q with
psi = (x, v, forces of the effects per unit) and Q = S / 2 the intensity of the force, known; moments from equipartition
m <v^2> = S / (4 c) = kL <x^2> + 3 kNL <x^2>^2. It uses no part of the estimator.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest
from kept_records import KNL, kept
from reference_rig import MASS, PLACES, RATE, TRUTH, rig_model

from estimator.identification.batch import fit_all_effects
from estimator.likelihood.path.uncertainty import joint_covariance

SEEDS = int(os.environ.get("ROTORSCOPE_SEEDS", "4"))
SECONDS = float(os.environ.get("ROTORSCOPE_SECONDS", "60"))
RESULTS = os.environ.get("ROTORSCOPE_RESULTS")
CASES = {  # case -> effects of the model; all but the first have the cubic term
    "linear": (),
    "cubic": ("cubic",),
    "coulomb": ("cubic", "coulomb"),
    "quadratic_damping": ("cubic", "quadratic_damping"),
}
HIDDEN = {"coulomb": 0.07, "quadratic_damping": 1e4}  # N, N s^2/m^2

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]


def moments(i: int, kNL: float, extra_damping: float = 0.0) -> tuple[float, float, float]:
    """<x^2>, <v^2> and Q at a place."""
    k, c, S = (TRUTH[key][i] for key in ("kL", "c", "S"))
    energy = S / (4 * (c + extra_damping))
    x2 = (-k + np.sqrt(k * k + 12 * kNL * energy)) / (6 * kNL) if kNL else energy / k
    return x2, energy / MASS, S / 2


def bound(i: int, kNL: float, effect: str | None) -> dict[str, float]:
    """Relative Cramer-Rao sd of each parameter of a place, Gaussian moments."""
    amplitude = HIDDEN.get(effect or "", 0.0)
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


Errors = dict[str, list[tuple[float, float]]]  # parameter -> (error, sd given) of each place, relative to the truth


def errors_of(case: str, seed: int) -> tuple[Errors, float]:
    """Errors of the fit of one record, and the seconds that it took."""
    y = kept(case, seed, SECONDS)
    begin = time.perf_counter()
    point = fit_all_effects(rig_model(*CASES[case]), y, RATE).point
    took = time.perf_counter() - begin
    truth = {"kNL": KNL, "fc": HIDDEN.get(case, 0.0), "cq": HIDDEN.get(case, 0.0)}
    names, out = point.fit.names, Errors()
    sd = np.sqrt(np.diag(joint_covariance(point))) * np.append(point.fit.scales, np.ones(4))
    values = {use.name(k): p for use in point.placed for k, p in enumerate(use.p)}
    for i, place in enumerate(PLACES):
        values |= {f"{place}.kL": point.kL[i], f"{place}.c": point.c[i]}
    for j, name in enumerate(names):
        i, key = next(i for i, p in enumerate(PLACES) if name.startswith(p)), name.split(".")[-1]
        true = float(TRUTH[key][i]) if key in TRUTH else truth[key]
        out.setdefault(key, []).append((float(values[name]) / true - 1, float(sd[j]) / true))
    for i in range(4):
        out.setdefault("S", []).append((float(point.S[i] / TRUTH["S"][i]) - 1, float(sd[len(names) + i])))
    return out, took


def all_errors(case: str) -> list[tuple[Errors, float]]:
    """Of every seed, from the file of results where it is there."""
    done: dict[str, tuple[Errors, float]] = {}
    if RESULTS is not None and Path(RESULTS).is_file():
        for row in map(json.loads, Path(RESULTS).read_text().splitlines()):
            done[row["key"]] = (row["errors"], row["seconds"])
    out = []
    for seed in range(SEEDS):
        key = f"{case}/{SECONDS:g}/{seed}"
        if key not in done:
            done[key] = errors_of(case, seed)
            if RESULTS is not None:
                errors, took = done[key]
                with Path(RESULTS).open("a") as f:
                    f.write(json.dumps({"key": key, "errors": errors, "seconds": took}) + "\n")
        out.append(done[key])
    return out


def row(key: str, e: np.ndarray, s: np.ndarray, b: np.ndarray) -> str:
    """A row of the table from errors, sd given and bounds, all in %."""
    known = np.isfinite(b).all()
    ratio = f"{np.sqrt(np.mean((e / b) ** 2)):.2f}" if known else ""
    bound = f"{np.median(b):.3g}" if known else ""
    return (
        f"| {key} | {e.mean():.3f} +- {e.std() / np.sqrt(e.size):.3f} | {e.std():.3g} | {np.median(s):.3g} | {bound} | "
        f"{ratio} | {100 * np.mean(np.abs(e) < 1.96 * s):.1f} |"
    )


@pytest.mark.parametrize("case", list(CASES))
def test_bias_scatter_coverage(case: str) -> None:
    kNL = 0.0 if case == "linear" else KNL
    bounds = [bound(i, kNL, case if case in HIDDEN else None) for i in range(4)]
    results = all_errors(case)
    print(
        f"\n{case}: {len(results)} records of {SECONDS:g} s, 4 places; fit {np.median([t for _, t in results]):.2f} s"
    )
    print("| parameter | bias % | scatter % | sd given % | bound % | rms / bound | 95 % covers |")
    print("|---|---|---|---|---|---|---|")
    for key in results[0][0]:
        e, s = 100 * np.array([errors[key] for errors, _ in results]).transpose(2, 0, 1)  # (records, places)
        b = 100 * np.broadcast_to([z.get(key, np.nan) for z in bounds], e.shape)
        print(row(key, e.ravel(), s.ravel(), b.ravel()))
        if key == "kNL":  # one value for the four places: their mean by precision
            w = 1 / s**2
            one = (w * e).sum(axis=1) / w.sum(axis=1)
            print(row("kNL, one for all places", one, w.sum(axis=1) ** -0.5, (1 / b**2).sum(axis=1) ** -0.5))
        assert abs(e.mean()) < 5 * e.std() / np.sqrt(e.size) + {"kL": 0.3, "kNL": 3.0, "c": 2.0}.get(key, 10.0)
    if kNL:
        cubic = [np.sqrt(15) * kNL * moments(i, kNL)[0] / TRUTH["kL"][i] for i in range(4)]
        print(f"rms of the cubic force over that of the linear one: {', '.join(f'{100 * z:.2f} %' for z in cubic)}")
