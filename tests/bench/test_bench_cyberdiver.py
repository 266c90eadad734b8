"""Force law of a real structure from its motion, against a force machine (CyberDiver, arXiv 2503.20702, CC BY-SA 4.0).

    ROTORSCOPE_DATA=DIR pytest -m bench -s tests/bench/test_bench_cyberdiver.py    (DIR holds cyberdiver/)

A body and a nose joined by a programmed spring fall, hit water and ring: one transient, no stationary random response,
so the output-only likelihood does not apply and is not used. What applies is the force balance itself, with the
acceleration of the body measured: in free flight the only force on it is the spring's, m a = -f(x) (an accelerometer
does not feel gravity). The mass follows from the 5 N/mm run and its static curve; the 15 N/mm and the "10 N" runs are
then predictions. Samples where the accelerometer clips (the impact) are left out.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]
FREE_FLIGHT_S = (0.39, 0.53)  # between release and impact, in the time of the records
G = 9.80665


def flight(data: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x (m), v (m/s) of the spring and a (m/s^2) of the body."""
    d = np.load(data / f"{name}.npz")
    t, a = d["time_us"] * 1e-6, d["acc_g"][:, 1] * G
    k = (t >= FREE_FLIGHT_S[0]) & (t < FREE_FLIGHT_S[1]) & (np.abs(a) < 15.5 * G) & (d["mode"] == 4)
    return d["position_mm"][k] * 1e-3, d["velocity_mmps"][k] * 1e-3, a[k]


def static(data: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Compression (m) and force (N) of the force machine, its three trials."""
    d = np.genfromtxt(data / "static_force_tests" / f"static_force_test_{name}.csv", delimiter=",", skip_header=1)
    x, f = np.concatenate([d[:, i] for i in (0, 2, 4)]), np.concatenate([d[:, i] for i in (1, 3, 5)])
    k = np.isfinite(x) & np.isfinite(f)
    return -x[k] * 1e-3, -f[k]


def slope(x: np.ndarray, f: np.ndarray, *others: np.ndarray) -> float:
    return float(np.linalg.lstsq(np.stack([x, *others, np.ones_like(x)], axis=1), f, rcond=None)[0][0])


def test_programmed_springs_against_the_force_machine() -> None:
    root = os.environ.get("ROTORSCOPE_DATA")
    if root is None:
        pytest.skip("ROTORSCOPE_DATA is not set")
    data = Path(root) / "cyberdiver"
    x5, f5 = static(data, "5npmm")
    here = (x5 > 0.1e-3) & (x5 < 2.3e-3)  # what the flights cover
    k5 = slope(x5[here], f5[here])
    over_mass = [-slope(x, a, v) for x, v, a in (flight(data, f"5npmm_4mps_trial{i}") for i in (1, 2))]
    mass = k5 / np.mean(over_mass)
    print(f"\nmass {mass:.3f} kg from {k5 / 1e3:.2f} N/mm (static) and the 5 N/mm flights")
    x15, f15 = static(data, "15npmm")
    here = (x15 > 0.1e-3) & (x15 < 1.0e-3)
    k15 = slope(x15[here], f15[here])
    for i in (1, 2):
        x, v, a = flight(data, f"15npmm_4mps_trial{i}")
        found = -mass * slope(x, a, v)
        print(f"15 N/mm trial {i}: {found / 1e3:.2f} N/mm in flight, {k15 / 1e3:.2f} by the force machine")
        assert found == pytest.approx(k15, rel=0.06)
    xs, fs = static(data, "10n_threshold")
    plateau = float(np.median(fs[xs > 1.2e-3]))
    here = (xs > 0.1e-3) & (xs < 0.5e-3)
    stiff = slope(xs[here], fs[here])
    for i in (1, 2):
        x, v, a = flight(data, f"10nthreshold_4mps_trial{i}")
        small, large = np.abs(x) < 0.5e-3, (x > 0.8e-3) & (x < 1.3e-3)
        found, high = -mass * slope(x[small], a[small], v[small]), float(np.mean(-mass * a[large]))
        print(
            f"10 N trial {i}: {found / 1e3:.2f} N/mm under 0.5 mm (force machine {stiff / 1e3:.2f}), "
            f"{high:.2f} N beyond 0.8 mm ({plateau:.2f})"
        )
        assert found == pytest.approx(stiff, rel=0.10)
        assert high == pytest.approx(plateau, rel=0.10)
