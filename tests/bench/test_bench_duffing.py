"""The one-degree test that the rival methods share: x'' + 2 zeta w x' + w^2 (x + x^3) = white force, 50 Hz, 3 %.

60 s, displacement sampled at 1 kHz with 1 and 5 % noise.

    ROTORSCOPE_SEEDS=40 pytest -m bench -s tests/bench/test_bench_duffing.py
"""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from numba import njit

from estimator.identification.batch import spectral
from estimator.model.rig import Channel, EffectUse, Model

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]
W, ZETA, RATE, STEPS, SECONDS = 2 * np.pi * 50.0, 0.03, 1000.0, 16, 60.0
SEEDS = int(os.environ.get("ROTORSCOPE_SEEDS", "10"))
KEYS = {"kL": "kL", "c": "c", "kNL": "cubic.kNL"}
TRUTH = {"kL": W**2, "c": 2 * ZETA * W, "cubic.kNL": W**2}


@njit(cache=True)
def _integrate(F, h, c, k, out):  # type: ignore[no-untyped-def]
    x, v = 0.0, 0.0
    for n in range(F.size):
        f = F[n]
        a1 = f - c * v - k * (x + x**3)
        v2, x2 = v + 0.5 * h * a1, x + 0.5 * h * v
        a2 = f - c * v2 - k * (x2 + x2**3)
        v3, x3 = v + 0.5 * h * a2, x + 0.5 * h * v2
        a3 = f - c * v3 - k * (x3 + x3**3)
        v4, x4 = v + h * a3, x + h * v3
        a4 = f - c * v4 - k * (x4 + x4**3)
        x += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        out[n] = x


def record(seed: int, noise: float, sigma: float) -> tuple[np.ndarray, float]:
    """Displacement at 1 kHz and S of the force; sigma : rms displacement that the linear system would have."""
    S = 4 * TRUTH["c"] * TRUTH["kL"] * sigma**2
    rng = np.random.default_rng(seed)
    F = rng.normal(size=int((SECONDS + 2) * RATE * STEPS)) * np.sqrt(S / 2 * RATE * STEPS)
    x = np.empty_like(F)
    _integrate(F, 1 / (RATE * STEPS), TRUTH["c"], TRUTH["kL"], x)
    x = x[::STEPS][int(2 * RATE) :]
    return x + noise * x.std() * rng.normal(size=x.size), S


@njit(cache=True)
def _path_sums(F, h, c, k, skip, out):  # type: ignore[no-untyped-def]
    """Adds psi (psi, F)^T of psi = (x, v, x^3) before each step."""
    path = np.zeros(F.size)
    _integrate(F, h, c, k, path)
    for n in range(skip, F.size - 1):
        x, v = path[n], (path[n] - path[n - 1]) / h  # after step n; v in its middle
        v += 0.5 * h * (F[n] - c * v - k * (x + x**3))
        psi = (x, v, x**3)
        for i in range(3):
            for j in range(3):
                out[i, j] += psi[i] * psi[j]
            out[i, 3] += psi[i] * F[n + 1]


def exact_path(seed: int, sigma: float) -> dict[str, float]:
    """kL, c, kNL of maximum likelihood from the whole path of a record without noise, all 16 kHz of it: what no
    method can know more than. Its error is the luck of the record."""
    S, fs = 4 * TRUTH["c"] * TRUTH["kL"] * sigma**2, RATE * STEPS
    F = np.random.default_rng(seed).normal(size=int((SECONDS + 2) * fs)) * np.sqrt(S / 2 * fs)
    sums = np.zeros((3, 4))
    _path_sums(F, 1 / fs, TRUTH["c"], TRUTH["kL"], int(2 * fs), sums)
    error = -np.linalg.solve(sums[:, :3], sums[:, 3])
    return {key: float(TRUTH[name] + e) for (key, name), e in zip(KEYS.items(), error, strict=True)}


@pytest.mark.parametrize("sigma", [0.25, 0.5, 0.7, 1.0])
@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_one_degree_of_freedom(noise: float, sigma: float) -> None:
    channel = (Channel("d", "bearing1", "x", "displacement"),)
    cubic = (EffectUse("cubic", {"bearing1.x": {}}),)
    model = Model(channel, (10.0, 450.0), "none", {"bearing1": 1.0}, effects=cubic)
    errors: dict[str, list[tuple[float, float]]] = {}
    begin = time.perf_counter()
    for seed in range(SEEDS):
        y, S = record(1000 + seed, noise, sigma)
        p = spectral.fit_spectral(model, y[:, None], RATE).parameters
        for key, true in (TRUTH | {"S": S}).items():
            found = p[f"bearing1.x.{key}"]
            value = (np.nan, np.nan) if found.value is None else (100 * (found.value / true - 1), 100 * found.sd / true)
            errors.setdefault(key, []).append(value)
    took = (time.perf_counter() - begin) / SEEDS
    cells = []
    for rows in errors.values():
        e, sd = np.array(rows).T
        covers = 100 * np.nanmean(np.abs(e) < 1.96 * sd)
        cells.append(f"{np.nanmean(e):+.2f} +- {np.nanstd(e):.2f} ({covers:.0f})")
    print(f"\n{SEEDS} records, {took:.2f} s each with the simulation; error % +- scatter (95 % interval covers %)")
    print(f"| noise, rms | {' | '.join(errors)} |\n| {100 * noise:g} %, {sigma:g} | {' | '.join(cells)} |")
    assert abs(np.nanmean([e for e, _ in errors["kL"]])) < 2.0
    assert abs(np.nanmean([e for e, _ in errors["cubic.kNL"]])) < 3.0
