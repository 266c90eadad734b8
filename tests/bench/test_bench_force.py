"""A measured force: bias, scatter, coverage beside the input-output Cramer-Rao bound; a free run on held-out data.

    ROTORSCOPE_SEEDS=30 ROTORSCOPE_SECONDS=12 pytest -m bench -s tests/bench/test_bench_force.py

Records are those of forced_rig.py: force and acceleration at all four places, white sensor noise, int16 counts. The
bound is that of the accelerations given the true force: the derivative of the response by each parameter, from runs of
the same integrator with the parameter moved up and down, against the noise of the accelerometers and that of the force
sensors as it comes through the linear rotor. It uses no part of the estimator. With ROTORSCOPE_RESULTS=FILE results are
kept and a run can be continued.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import forced_rig as rig
import numpy as np
import pytest
from reference_rig import DISC, MASS, PLACES, RATE, SHAFT, SHAFT_DAMPING, rig_model
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.signal import upfirdn

from estimator.diagnosis.comparison.free_run import simulation_rmse
from estimator.diagnosis.comparison.heldout import FITTED_SHARE, heldout_rmse
from estimator.identification.batch import fit_spectral
from estimator.model.rig import Channel, EffectUse, Model, Setting

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]
SEEDS = int(os.environ.get("ROTORSCOPE_SEEDS", "3"))
SECONDS = float(os.environ.get("ROTORSCOPE_SECONDS", "12"))
RESULTS = os.environ.get("ROTORSCOPE_RESULTS")
BAND = (150.0, 8000.0)
LEVELS = (0.001, 0.05)  # N rms, of each force sensor; the force is 1 N rms
RUNS = 4  # records
BOUND_S = 8.0  # of a record, that the bound is taken from


def model() -> Model:
    """What is fitted: masses and shaft known, nothing else."""
    blank = rig_model("cubic", band=BAND)
    forces = tuple(Channel("f" + c.name, c.node, c.direction, "force") for c in blank.channels)
    return replace(blank, channels=blank.channels + forces)


def true_model() -> Model:
    values = dict(zip(PLACES, rig.truth().reshape(4, 3).tolist(), strict=True))
    linear = {p: {"kL": Setting(k), "c": Setting(c), "S": Setting(1e-9)} for p, (k, c, _) in values.items()}
    cubic = EffectUse("cubic", {p: {"kNL": Setting(kNL)} for p, (_, _, kNL) in values.items()})
    return replace(model(), linear=linear, effects=(cubic,))


@cache
def sensitivities() -> np.ndarray:
    """(2 planes, 6 parameters, 2 caps, n): relative derivatives of the accelerations, from runs up and down.

    The planes do not act on each other, so both are moved at once.
    """
    force, true = rig.white(BOUND_S, 77), rig.truth()
    out = []
    for k in range(6):  # kL, c, kNL of the first cap, then of the second
        step = np.zeros(12)
        step[[3 * (2 * (k // 3) + plane) + k % 3 for plane in range(2)]] = (1e-3, 1e-2, 1e-2)[k % 3]
        up, down = (rig.respond(force, true * (1 + s * step))[0] for s in (1, -1))
        out.append((up - down) / (2 * step.max()))
    z = np.array(out)[:, int(rig.LEAD_S * RATE) :]
    return np.array([z[:, :, [plane, 2 + plane]].transpose(0, 2, 1) for plane in range(2)])


def bound(force_noise: float) -> np.ndarray:
    """(12,) relative sd of each parameter, as in rig.truth()."""
    N, S = (
        (rms**2 + count**2 / 12) / (RATE / 2) for rms, count in ((rig.NOISE, rig.COUNT), (force_noise, rig.FORCE_COUNT))
    )
    out = np.empty((2, 2, 3))
    for plane, z in enumerate(sensitivities()):
        n = z.shape[2]
        f = np.fft.rfftfreq(n, 1 / RATE)
        used = (f >= BAND[0]) & (f <= BAND[1])
        w, taper = 2 * np.pi * f[used], np.hanning(n)
        D = np.fft.rfft(z * taper)[:, :, used] * np.sqrt(2 / (RATE * (taper @ taper)))
        p = rig.truth().reshape(4, 3)[[plane, 2 + plane]]
        dynamic = np.zeros((w.size, 3, 3), complex)  # two caps and the disc between them
        shaft = SHAFT + 1j * w * SHAFT_DAMPING
        for i in range(2):
            dynamic[:, i, i] = p[i, 0] + 1j * w * p[i, 1] - w**2 * MASS + shaft
            dynamic[:, i, 2] = dynamic[:, 2, i] = -shaft
        dynamic[:, 2, 2] = 2 * shaft - w**2 * DISC
        seen = -(w**2)[:, None, None] * np.linalg.inv(dynamic)[:, :2, :2]
        noise = N * np.eye(2) + S * seen @ seen.conj().transpose(0, 2, 1)
        whitened = np.einsum("fij,pjf->fpi", np.linalg.inv(noise), D)
        information = 2 * SECONDS * np.einsum("qif,fpi->pq", D.conj(), whitened).real * RATE / n
        out[:, plane] = np.sqrt(np.diag(np.linalg.inv(information))).reshape(2, 3)
    return out.reshape(4, 3).ravel()


Result = dict[str, list[float]]


def result_of(y: np.ndarray, run: bool) -> Result:
    """Relative errors and sd given; with `run` the rms errors of fitted and true model run on the held-out part."""
    begin = time.process_time()
    found = fit_spectral(model(), y, RATE).parameters
    took = time.process_time() - begin
    own, true = [found[f"{p}.{k}"] for p in PLACES for k in ("kL", "c", "cubic.kNL")], rig.truth()
    value, sd = (np.array(z, dtype=float) for z in zip(*((p.value, p.sd) for p in own), strict=True))
    out = {"error": (value / true - 1).tolist(), "sd": (sd / true).tolist(), "seconds": [took]}
    if not run:
        return out
    fitted = heldout_rmse(model(), y, RATE)
    ideal = simulation_rmse(true_model(), y, RATE, float(np.max(2 * MASS / true[1::3])), FITTED_SHARE)
    runs = {"fitted": list(fitted.values()), "true model": list(ideal.values())}
    return out | runs | {"motion": y[:, :4].std(axis=0).tolist()}


def results() -> dict[float, list[Result]]:
    """Of every level and seed, from the file of results where it is there."""
    done: dict[str, Result] = {}
    if RESULTS is not None and Path(RESULTS).is_file():
        for row in map(json.loads, Path(RESULTS).read_text().splitlines()):
            done[row.pop("key")] = row
    for seed in range(SEEDS):
        for level in LEVELS:
            key = f"{level:g}/{SECONDS:g}/{seed}"
            if key not in done:
                done[key] = result_of(rig.measured(SECONDS, 3000 + seed, level), seed < RUNS)
                if RESULTS is not None:
                    with Path(RESULTS).open("a") as f:
                        f.write(json.dumps({"key": key} | done[key]) + "\n")
    return {level: [done[f"{level:g}/{SECONDS:g}/{seed}"] for seed in range(SEEDS)] for level in LEVELS}


def table(found: list[Result], limit: np.ndarray) -> None:
    """Errors beside the bound (12,)."""
    e, sd = (100 * np.array([r[key] for r in found]) for key in ("error", "sd"))
    b = np.broadcast_to(100 * limit, e.shape)
    print("| parameter | bias % | scatter % | sd given % | bound % | rms / bound | 95 % covers |")
    print("|---|---|---|---|---|---|---|")
    for j, key in enumerate(rig.KEYS):
        x, s, z = e[:, j::3], sd[:, j::3], b[:, j::3]
        print(
            f"| {key} | {x.mean():.5f} +- {x.std() / np.sqrt(x.size):.5f} | {x.std():.3g} | {np.median(s):.3g} | "
            f"{np.median(z):.3g} | {np.sqrt(np.mean((x / z) ** 2)):.2f} | {100 * np.mean(np.abs(x) < 1.96 * s):.1f} |"
        )
        assert abs(x.mean()) < 5 * x.std() / np.sqrt(x.size)


def test_the_integrator_beside_another() -> None:
    """scipy's DOP853 under a spline through the same force, 5 ms from rest."""
    white = rig.white(0.0, 5)[:200]
    a, _ = rig.respond(white, rig.truth())
    t = np.arange(len(a)) / RATE
    dense = upfirdn(rig.taps(32), white, up=32, axis=0)[rig.REACH * 32 :]
    force = CubicSpline(np.arange(len(dense)) / (32 * RATE), dense)

    def slope(at: float, state: np.ndarray) -> np.ndarray:
        out = np.empty(6)
        rig.accelerate(state[:6].copy(), state[6:].copy(), force(at), rig.truth().reshape(4, 3), out)
        return np.concatenate([state[6:], out])

    path = solve_ivp(slope, (0, t[-1]), np.zeros(12), "DOP853", t, rtol=1e-9, atol=1e-18, max_step=0.5 / RATE)
    other = np.array([slope(at, z)[6:10] for at, z in zip(t, path.y.T, strict=True)])
    apart = np.sqrt(np.mean((a - other) ** 2) / np.mean(a**2))
    print(f"\naccelerations of the two integrators differ by {apart:.1e} of their rms")
    assert apart < 2e-6


def test_measured_force() -> None:
    for level, found in results().items():
        cpu = np.median([r["seconds"] for r in found])
        print(f"\nforce sensors {level:g} N rms: {SEEDS} records of {SECONDS:g} s, 4 places; fit {cpu:.1f} s of CPU")
        table(found, bound(level))
        run, true, motion = (
            np.array([r[key] for r in found if key in r]) for key in ("fitted", "true model", "motion")
        )
        print(
            f"free run held out, {len(run)} records: {run.mean():.5f} m/s^2, true model {true.mean():.5f}, of "
            f"{motion.mean():.2f} rms; ratio {np.mean(run / true):.5f}, largest {np.max(run / true):.5f}"
        )
        assert np.max(run / true) < 1.05
