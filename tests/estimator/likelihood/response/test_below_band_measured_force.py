"""What laws see below the band where the force is measured: an independent integrator says what is there."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from numba import njit
from scipy.signal import resample

from estimator.diagnosis.comparison.comparison import compare
from estimator.effects import CATALOGUE
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.response.below_band import with_below_band_motion
from estimator.model.rig import Channel, EffectUse, Model
from estimator.signals.band_limit import out_of_band_sd

RATE, SECONDS, BAND, FINER = 1000.0, 40.0, (10.0, 400.0), 20
MASS, KL, C = 1.0, (100 * np.pi) ** 2, 6 * np.pi
K5 = 3e26  # N/m^5: 6 % of the bearing force


@njit(cache=True)
def _integrated(force, k5, h):  # type: ignore[no-untyped-def]
    """(n,) x and a of the oscillator, Runge-Kutta of order 4 on force at every half step."""
    n = force.size // 2
    out = np.empty((2, n))
    x = v = 0.0
    for i in range(n):
        f0, f1, f2 = force[2 * i], force[(2 * i + 1) % force.size], force[(2 * i + 2) % force.size]
        a1 = (f0 - KL * x - C * v - k5 * x**5) / MASS
        out[0, i], out[1, i] = x, a1
        x2, v2 = x + h / 2 * v, v + h / 2 * a1
        a2 = (f1 - KL * x2 - C * v2 - k5 * x2**5) / MASS
        x3, v3 = x + h / 2 * v2, v + h / 2 * a2
        a3 = (f1 - KL * x3 - C * v3 - k5 * x3**5) / MASS
        x4, v4 = x + h * v3, v + h * a3
        a4 = (f2 - KL * x4 - C * v4 - k5 * x4**5) / MASS
        x += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return out


@lru_cache(maxsize=2)
def record(k5: float) -> tuple[np.ndarray, np.ndarray]:
    """(n,) displacement, and (n, 2) what its accelerometer and the sensor of its force say, which has an offset."""
    rng = np.random.default_rng(3)
    n = int(RATE * SECONDS)
    white = np.fft.irfft(np.where(np.fft.rfftfreq(n, 1 / RATE) < 450.0, np.fft.rfft(rng.normal(size=n)), 0.0), n)
    force = 0.055 * white
    x, a = _integrated(resample(force, 2 * FINER * n), k5, 1 / (RATE * FINER))[:, ::FINER]
    return x, np.stack([a, force + 3.0], axis=1)


def rig(effects: tuple[EffectUse, ...] = ()) -> Model:
    channels = Channel("a", "bearing1", "x", "acceleration"), Channel("f", "bearing1", "x", "force")
    return Model(channels, BAND, "none", {"bearing1": MASS}, effects=effects)


@pytest.mark.parametrize("k5", [0.0, K5])
def test_the_force_gives_the_motion_that_the_accelerometer_does_not(k5: float) -> None:
    x, y = record(k5)
    data = prepare(rig(), y, RATE)
    rows = np.round(data.t * RATE).astype(int)
    law = LocatedLaw(CATALOGUE["quintic"], "bearing1.x.quintic", (0,), np.array([k5]), free=(True,))
    seen = with_below_band_motion(data, np.array([KL]), np.array([C]), [law]).displacement(0)
    left = x[rows] - data.x[0]
    assert left.std() > 0.06 * x.std()
    assert (x[rows] - seen).std() < 0.25 * left.std(), "but what drifts"


def test_what_is_said_to_be_left_out_is() -> None:
    x, y = record(0.0)
    data = prepare(rig(), y, RATE)
    rows = np.round(data.t * RATE).astype(int)
    seen = with_below_band_motion(data, np.array([KL]), np.array([C]), []).displacement(0)
    one = np.array([MASS]), np.array([C]), np.array([KL]), np.zeros(1), BAND, RATE, ("acceleration",)
    np.testing.assert_allclose(out_of_band_sd(*one, data.measured_force_psd)[0, 0], (x[rows] - seen).std(), rtol=0.5)


def test_a_resonance_below_the_band_is_none_of_its_business() -> None:
    data = prepare(replace(rig(), band=(60.0, 400.0)), record(0.0)[1], RATE)
    assert data.below_band_force is not None
    let_go = with_below_band_motion(data, np.array([KL]), np.array([C]), [])
    assert let_go.below_band_force is None
    assert let_go.slow is None


def test_a_strong_law_beside_a_measured_force_has_its_number_and_leaves_nothing() -> None:
    y = record(K5)[1] + np.random.default_rng(4).normal(size=(int(RATE * SECONDS), 2)) * (1e-4, 5e-5)
    model = replace(rig((EffectUse("quintic", {"bearing1.x": {}}),)), band=(20.0, 400.0))
    found = compare(model, y, RATE)
    assert found.missing[0] == 0.0, "0.2 % without"
    parameters = found.parameters
    assert parameters["bearing1.x.quintic.k5"].value == pytest.approx(K5, rel=1.5e-3), "1.2 % small without"
    assert parameters["bearing1.x.kL"].value == pytest.approx(KL, rel=5e-5)
