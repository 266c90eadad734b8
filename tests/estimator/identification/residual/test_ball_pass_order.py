"""The ball-pass order of a record: without geometry, the speed by a tacho alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden_effects import RATE, one_bearing

from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import with_effect
from estimator.identification.batch import spectral
from estimator.model.rig import Channel, EffectUse
from estimator.simulation.shaft_speed import ShaftSpeed
from estimator.simulation.simulator import simulate


def test_a_fit_takes_the_order_from_the_record_and_says_how_sure_it_is_of_the_phase() -> None:
    """Without speed_rpm it began at the usual 2.1, and ended there; held, the order left the amplitudes half of their
    standard deviation."""
    rig = one_bearing()
    tacho = Channel("tacho", "", "", "tacho")
    rig = replace(rig, channels=(rig.channels[0], tacho), effects=(), bearing=None, speed_rpm=None)
    hidden = {"k_cos": 5e5, "k_sin": -4e5, "order": 5.0932}
    truth = with_effect(replace(rig, speed_rpm=2850.0), CATALOGUE["ball_pass"], hidden, "bearing1.x")
    y = simulate(truth, RATE, 4.0, seed=1, noise=0.02, speed=ShaftSpeed(2850.0))
    found = spectral.fit_spectral(
        replace(rig, effects=(EffectUse("ball_pass", {"bearing1.x": {}}),)), y, RATE
    ).parameters
    for name, value in hidden.items():
        got = found[f"bearing1.x.ball_pass.{name}"]
        assert got.value == pytest.approx(value, abs=4 * got.sd)
    sd = {name: found[f"bearing1.x.ball_pass.{name}"].sd for name in hidden}
    assert sd["order"] > 0.0
    assert sd["k_sin"] != pytest.approx(sd["k_cos"], rel=0.1)  # one of them is along the phase
