"""Accuracy of the paper's method and of score matching over 20 seeds. Prints the tables of docs/paper.md.

pytest tests/bench/test_bench_paper.py -m bench -s
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from reference_samples import boltzmann  # noqa: E402

from estimator.identification.moments import fokker_planck  # noqa: E402
from estimator.identification.moments.plane_moments import PlaneMoments  # noqa: E402
from estimator.identification.moments.planes import Cap, Plane, density_band, planes_of  # noqa: E402
from estimator.model.rig import Channel, EffectUse, Model, Setting  # noqa: E402
from estimator.signals.band_limited_record import band_limit  # noqa: E402

SEEDS = 20
SAMPLES = 1_000_000
KL, T, M3 = 1.0e7, 4.0e-7, 0.515
MU = 2.10
NAMES = ("kL", "kNL", "lambda", "mu")
Result = tuple[dict[str, float], np.ndarray]


def score(plane: Plane, x: np.ndarray, v: np.ndarray, form: str) -> Result:
    moments = PlaneMoments(plane, form)  # type: ignore[arg-type]
    size = len(x) // 64
    for at in range(0, len(x), size):
        part = slice(at, at + size)
        moments.add(x[part], v[part])
    return moments.values()


def table(errors: dict[str, list[np.ndarray]], covered: dict[str, list[np.ndarray]]) -> None:
    columns = next(iter(errors.values()))[0].shape[1]
    print(f"\n{'':28s}" + "".join(f"{n:>26s}" for n in NAMES[:columns]) + "     covered")
    for method, rows in errors.items():
        e = 100.0 * np.concatenate(rows)
        cells = "".join(f"{np.mean(c):+9.2f} {np.sqrt(np.mean(c**2)):7.2f} {np.max(np.abs(c)):8.2f}" for c in e.T)
        print(f"{method:28s}{cells}{100 * np.mean(covered[method]):9.1f} %")
    print("per cent: mean error, rms error, worst of all seeds and caps; share of 95 % intervals that cover")


@pytest.mark.bench
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("nonlinearity", [0.1, 0.2])
def test_strong_shaft_at_a_million_samples(nonlinearity: float) -> None:
    """ks = kL, mu = 2.10, masses unknown; rejection samples of the density, not the product's simulator."""
    lam = nonlinearity * KL / T
    mass = M3 / MU
    caps = tuple(Cap(f"bearing{i}.x", (1, 3), None) for i in (1, 2))
    plane = Plane("x", caps, ks=KL, a=0.5, b=-0.5)
    coupling = 0.5 * KL * np.array([[1.0, -1.0], [-1.0, 1.0]])
    methods: dict[str, Callable[[np.ndarray, np.ndarray], Result]] = {
        "eq. (36) midpoint": lambda x, v: fokker_planck.fokker_planck_parameters(plane, x, v, "midpoint", 30),
        "eq. (36) response": lambda x, v: fokker_planck.fokker_planck_parameters(plane, x, v, "response", 100),
        "score, density form": lambda x, v: score(plane, x, v, "density"),
        "score, velocity form": lambda x, v: score(plane, x, v, "velocity"),
    }
    errors: dict[str, list[np.ndarray]] = {m: [] for m in methods}
    covered: dict[str, list[np.ndarray]] = {m: [] for m in methods}
    truth = np.array([KL, lam * KL, lam, mass] * 2)
    for seed in range(SEEDS):
        x = boltzmann(SAMPLES, np.full(2, KL), np.full(2, lam * KL), coupling, T, seed)
        v = np.random.default_rng(seed + 1000).standard_normal(x.shape) * np.sqrt(T / mass)
        for method, run in methods.items():
            values, cov = run(x, v)
            found = np.array(list(values.values()))
            covered[method].append(np.abs(found - truth) < 1.96 * np.sqrt(np.diag(cov)))
            error = found / truth - 1.0
            error[[3, 7]] = truth[[3, 7]] / found[[3, 7]] - 1.0  # mu = m3/m
            errors[method].append(error.reshape(2, 4))
    print(f"\nstrong shaft, {SAMPLES:,} samples, {SEEDS} seeds, kNL E[x^2]/kL about {nonlinearity}")
    table(errors, covered)
    rms = {m: np.sqrt(np.mean(np.concatenate(e) ** 2, axis=0)) for m, e in errors.items()}
    response, matched = rms["eq. (36) response"], rms["score, density form"]
    assert response[3] < 0.03
    assert response[0] < 0.04
    assert matched[3] < 0.01
    assert matched[0] < 0.015
    assert matched[2] < 0.08
    for method in ("eq. (36) response", "score, density form"):
        assert 0.88 < np.mean(covered[method]) < 0.995


def rig() -> Model:
    """configs/tiwari_vyas_1997.toml, read by hand."""
    text = tomllib.loads((Path(__file__).parents[2] / "configs" / "tiwari_vyas_1997.toml").read_text())
    linear = {
        f"{node}.{d}": {k: Setting(value) for k, value in values.items()}
        for node, by in text["model"]["linear"].items()
        for d, values in by.items()
    }
    channels = tuple(Channel(c["name"], c["node"], c["direction"]) for c in text["channel"])
    spring = text["rig"]["shaft_spring"]
    cubic = EffectUse("cubic", {p: {"kNL": Setting(text["model"]["cubic"]["kNL"])} for p in linear})
    return Model(
        channels, (150.0, 8000.0), "chain", text["rig"]["mass"], shaft_stiffness=spring["stiffness"],
        shaft_damping=spring["damping"], speed_rpm=2100.0,
        linear=linear, effects=(cubic,),
    )  # fmt: skip


@pytest.mark.bench
@pytest.mark.timeout(1800)
def test_records_of_the_rig() -> None:
    """20 s of the shipped rig, accelerations with sensor noise, masses given: what a user's record gives."""
    from estimator.simulation.simulator import simulate

    model = rig()
    methods = ("eq. (36) response", "score, density form", "score, velocity form")
    errors: dict[str, list[np.ndarray]] = {m: [] for m in methods}
    covered: dict[str, list[np.ndarray]] = {m: [] for m in methods}
    for seed in range(SEEDS):
        y = simulate(model, 25600.0, 20.0, seed, noise=0.02, full_scale=490.5)
        band = density_band(model)[0]
        motion = band_limit(y, ["acceleration"] * 4, 25600.0, band)
        x, v = (z.T[motion.valid] for z in (motion.x, motion.v))
        for plane in planes_of(model):
            columns = [i for i, p in enumerate(model.places) if p.endswith(plane.direction)]
            kL = np.array([model.linear[cap.place]["kL"].value for cap in plane.caps], float)
            truth = np.concatenate([[k, 1.3e18, 1.3e18 / k] for k in kL])
            for method in methods:
                if method.startswith("eq"):
                    values, cov = fokker_planck.fokker_planck_parameters(
                        plane, x[:, columns], v[:, columns], "response", 60
                    )
                else:
                    values, cov = score(plane, x[:, columns], v[:, columns], method.split()[1])
                found = np.array(list(values.values()))
                errors[method].append((found / truth - 1.0).reshape(2, 3))
                covered[method].append(np.abs(found - truth) < 1.96 * np.sqrt(np.diag(cov)))
    print(f"\nthe shipped rig, 20 s at 25.6 kHz, {SEEDS} seeds, kNL E[x^2]/kL about 0.005")
    table(errors, covered)
    rms = {m: np.sqrt(np.mean(np.concatenate(e) ** 2, axis=0)) for m, e in errors.items()}
    assert rms["score, velocity form"][0] < 0.005
    assert rms["score, velocity form"][0] < 0.3 * rms["eq. (36) response"][0]
    assert rms["score, velocity form"][1] < 0.3 * rms["eq. (36) response"][1]
