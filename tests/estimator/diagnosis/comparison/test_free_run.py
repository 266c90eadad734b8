"""A measured force as the known input: parameters at their own bound, and a free run of the fitted model."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.diagnosis.comparison.free_run import resampled
from estimator.diagnosis.comparison.heldout import heldout_rmse
from estimator.identification.batch import spectral
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.model.rig import Channel, EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

RATE, PLACES = 25600.0, ("bearing1.x", "bearing2.x")


@pytest.fixture(scope="module")
def truth() -> Model:
    motion = tuple(Channel(f"a{i}", *p.split(".")) for i, p in enumerate(PLACES))
    force = tuple(Channel(f"f{i}", *p.split("."), "force") for i, p in enumerate(PLACES))
    linear = {p: {"kL": Setting(1e7), "c": Setting(60.0), "S": Setting(9e-5)} for p in PLACES}
    cubic = EffectUse("cubic", {p: {"kNL": Setting(1.3e18)} for p in PLACES})
    mass = {"disc": 0.515, "bearing1": 0.2, "bearing2": 0.2}
    return Model(
        motion + force,
        (150.0, 8000.0),
        "chain",
        mass,
        shaft_stiffness=155e3,
        shaft_damping=0.5,
        linear=linear,
        effects=(cubic,),
    )


@pytest.mark.slow
def test_a_measured_force_brings_the_parameters_to_its_own_bound(truth: Model) -> None:
    y = simulate(truth, RATE, 8.0, seed=1)
    blank = replace(truth, linear={}, effects=(EffectUse("cubic", {p: {} for p in PLACES}),))
    parameters = spectral.fit_spectral(blank, y[: int(6 * RATE)], RATE).parameters
    for place in PLACES:
        assert parameters[f"{place}.kL"].value == pytest.approx(1e7, rel=5e-4)
        assert parameters[f"{place}.c"].value == pytest.approx(60.0, rel=5e-3)
        assert parameters[f"{place}.cubic.kNL"].value == pytest.approx(1.3e18, rel=0.01)
    complete = heldout_rmse(blank, y, RATE)
    missing = heldout_rmse(replace(truth, linear={}, effects=()), y, RATE)
    for name, rms in zip(("a0", "a1"), y[:, :2].std(axis=0), strict=True):
        assert complete[name] < 0.005 * rms
        assert missing[name] > 5.0 * complete[name]


def test_resampling_of_a_band_limited_signal_is_exact() -> None:
    n = 400
    t = np.arange(n) / n
    fine = (np.arange(8 * n) + 0.5) / (8 * n)
    got = resampled(np.sin(2 * np.pi * 37 * t)[None], 8 * n, 0.5)[0]
    assert np.allclose(got, np.sin(2 * np.pi * 37 * fine), atol=1e-9)


@pytest.mark.slow
def test_friction_under_a_measured_force(truth: Model) -> None:
    """What the band leaves out of the motion is what the whole force makes of it, not the little that is unknown: with
    that, friction was 8 % low."""
    dry = EffectUse("coulomb", {p: {"fc": Setting(0.07)} for p in PLACES})
    y = simulate(replace(truth, effects=(dry,)), RATE, 6.0, seed=6)
    blank = replace(truth, effects=(EffectUse("coulomb", {p: {} for p in PLACES}),))
    for found in (spectral.fit_spectral(blank, y, RATE).parameters, fit_all_effects(blank, y, RATE).parameters):
        for place in PLACES:
            assert found[f"{place}.coulomb.fc"].value == pytest.approx(0.07, rel=0.015)
            assert found[f"{place}.c"].value == pytest.approx(60.0, rel=0.02)
