"""A measured force: noise in the force channels, the path that the laws act along."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator.identification.batch import spectral
from estimator.model.rig import Channel, EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

Floats = NDArray[np.float64]
RATE, PLACES, SECONDS = 25600.0, ("bearing1.x", "bearing2.x"), 8.0
MOTION = tuple(Channel(f"a{i}", *p.split(".")) for i, p in enumerate(PLACES))
FORCE = tuple(Channel(f"f{i}", *p.split("."), "force") for i, p in enumerate(PLACES))
TRUTH = {"kL": 1e7, "c": 60.0, "cubic.kNL": 1.3e18}


def rig(*channels: Channel, known: bool = False, **more: tuple[str, float]) -> Model:
    linear = {p: {"kL": Setting(1e7), "c": Setting(60.0), "S": Setting(9e-5)} for p in PLACES} if known else {}
    laws = {"cubic": ("kNL", 1.3e18)} | more
    uses = tuple(EffectUse(e, {p: {k: Setting(z)} if known else {} for p in PLACES}) for e, (k, z) in laws.items())
    mass = {"disc": 0.515, "bearing1": 0.2, "bearing2": 0.2}
    return Model(
        channels, (150.0, 8000.0), "chain", mass, shaft_stiffness=155e3, shaft_damping=0.5, linear=linear, effects=uses
    )


@pytest.fixture(scope="module")
def noisy() -> Floats:
    """(n, 4): accelerations with 0.1 m/s^2, forces with 0.1 N of noise; the force is 1.1 N rms."""
    y = simulate(rig(*MOTION, *FORCE, known=True), RATE, SECONDS, seed=5)
    return y + 0.1 * np.random.default_rng(0).normal(size=y.shape)


def test_noise_of_the_force_sensors_pulls_the_damping_no_further_than_it_says(noisy: Floats) -> None:
    """Another quarter of the force: c is 6 % too large."""
    y = noisy + [0.0, 0.0, 0.25, 0.25] * np.random.default_rng(1).normal(size=noisy.shape)
    found = spectral.fit_spectral(rig(*MOTION, *FORCE), y, RATE).parameters
    for place in PLACES:
        for key, true in TRUTH.items():
            p = found[f"{place}.{key}"]
            assert p.value is not None
            assert p.sd is not None
            assert abs(p.value - true) < 3.5 * p.sd
    assert found["bearing1.x.c"].sd < 0.08 * 60.0  # type: ignore[operator]


@pytest.mark.slow
def test_beside_a_gap_too(noisy: Floats) -> None:
    y = noisy.copy()
    y[int(3.1 * RATE) : int(3.15 * RATE)] = np.nan
    whole, broken = (spectral.fit_spectral(rig(*MOTION, *FORCE), z, RATE).parameters for z in (noisy, y))
    for place in PLACES:
        for key in TRUTH:
            p, q = whole[f"{place}.{key}"], broken[f"{place}.{key}"]
            assert p.value is not None
            assert p.sd is not None
            assert q.value == pytest.approx(p.value, abs=0.7 * p.sd)


@pytest.mark.slow
def test_an_offset_of_the_sensors_is_nothing_to_the_laws(noisy: Floats) -> None:
    """Where the record begins the filter makes a stroke of it, a hundred times the motion: its cubic filled the path
    with 126 N, the next round diverged and `fit` ended with an error of the linear algebra."""
    free = rig(*MOTION, *FORCE)
    with np.errstate(over="raise"):
        plain, lifted = (spectral.fit_spectral(free, noisy + [z, z, 0.0, 0.0], RATE).parameters for z in (0.0, 300.0))
    for key, p in plain.items():
        assert lifted[key].value == pytest.approx(p.value, abs=0.3 * p.sd)


@pytest.mark.slow
def test_a_law_that_pushes_the_cap_off_its_centre() -> None:
    """Where the cap goes no accelerometer shows; it follows from the law. Without it kNL was 48 % too small."""
    kq = ("kq", 3e12)
    y = simulate(rig(*MOTION, *FORCE, known=True, quadratic=kq), RATE, 6.0, seed=3)
    y += [0.02, 0.02, 0.001, 0.001] * np.random.default_rng(0).normal(size=y.shape)
    found = spectral.fit_spectral(rig(*MOTION, *FORCE, quadratic=kq), y, RATE).parameters
    for place in PLACES:
        assert found[f"{place}.kL"].value == pytest.approx(1e7, rel=5e-4)
        assert found[f"{place}.cubic.kNL"].value == pytest.approx(1.3e18, rel=0.015)
        assert found[f"{place}.quadratic.kq"].value == pytest.approx(3e12, rel=3e-3)
