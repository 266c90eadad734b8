"""A pedestal added without numbers begins where the spectrum of the force suggests."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden_effects import one_bearing

from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import with_effect
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.model.rig import EffectUse, Setting
from estimator.simulation.simulator import simulate


@pytest.mark.slow
def test_a_weak_pedestal_far_from_the_usual_numbers_is_found() -> None:
    """From the usual numbers the fit ended tens of nats below the truth, at 6.4 kHz."""
    rate = 20480.0
    rig = one_bearing()
    rig = replace(
        rig,
        channels=tuple(replace(c, kind="displacement") for c in rig.channels[:1]),
        mass={"bearing1": 0.15},
        band=(236.0, 8294.0),
        linear={"bearing1.x": {"kL": Setting(14.2e6), "c": Setting(117.7), "S": Setting(3.57e-4)}},
        effects=(),
    )
    truth = with_effect(rig, CATALOGUE["pedestal"], {"mass": 0.295, "frequency": 4683.0, "damping": 0.05}, "bearing1.x")
    y = simulate(truth, rate, 10.0, seed=113, noise=5e-10)
    grown = replace(rig, effects=(EffectUse("pedestal", {"bearing1.x": {}}),))
    found, right = (fit_all_effects(model, y, rate) for model in (grown, truth))
    assert found.point.fit.log_likelihood > right.point.fit.log_likelihood - 0.1
    frequency = found.parameters["bearing1.x.pedestal.frequency"]
    assert abs(frequency.value - 4683.0) < 4 * frequency.sd


def test_a_heavy_pedestal_at_the_resonance_is_found() -> None:
    """A model without it has one broad resonance for two narrow ones: from its damping, four times too large, the
    search ended 11000 nats off, and adding the pedestal found "no resonance inside the band"."""
    rig = one_bearing()
    rig = replace(rig, channels=rig.channels[:1], linear={"bearing1.x": rig.linear["bearing1.x"]}, effects=())
    truth = with_effect(rig, CATALOGUE["pedestal"], {"mass": 1.0, "frequency": 900.0, "damping": 0.05}, "bearing1.x")
    y = simulate(truth, 25600.0, 6.0, seed=2, noise=0.02)
    found = fit_all_effects(replace(rig, effects=(EffectUse("pedestal", {"bearing1.x": {}}),)), y, 25600.0).parameters
    for name, value in (("pedestal.mass", 1.0), ("pedestal.frequency", 900.0), ("kL", 10e6), ("c", 60.0)):
        got = found[f"bearing1.x.{name}"]
        assert got.value == pytest.approx(value, abs=4 * got.sd)
