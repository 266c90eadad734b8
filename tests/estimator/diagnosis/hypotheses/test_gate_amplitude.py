"""Largest amplitudes held out: a law that extrapolates wrongly is refused, the right one and an idle one are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing, record
from numpy.typing import NDArray

from estimator.diagnosis.hypotheses.gate_amplitude import Extrapolation, extrapolated, upper_part
from estimator.diagnosis.hypotheses.trial import best_on_grid
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size
from estimator.identification.batch.grid_start import fit_record
from estimator.likelihood.motion.prepare import prepare
from estimator.model.rig import CustomLaw, EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

SECONDS = 10.0


def judged(rig: Model, y: NDArray[np.float64], effect: str) -> Extrapolation:
    point = fit_record(rig, prepare(rig, y, RATE))
    trial = best_on_grid(point, rig, CATALOGUE[effect], "bearing1.x")
    assert trial is not None
    found = extrapolated(point, (trial.placed,))
    assert found is not None
    return found


def saturating(rig: Model) -> NDArray[np.float64]:
    there = size(rig, "bearing1.x", RATE)
    law = CustomLaw("k*(g*tanh(x/g) - x)", None, {"k": "N/m", "g": "m"})
    values = {"k": Setting(0.8 * there.kL), "g": Setting(there.x)}
    hidden = EffectUse("soft", {p: dict(values) for p in ("bearing1.x", "bearing1.y")}, law)
    truth = replace(rig, effects=(*rig.effects, hidden))
    return simulate(truth, RATE, SECONDS, seed=6, noise=0.02, full_scale=490.5)


def test_a_fifth_power_in_place_of_a_saturating_spring_is_refused() -> None:
    rig = one_bearing()
    assert judged(rig, saturating(rig), "quintic").refused


@pytest.mark.parametrize("effect", ["clearance", "quadratic"])
def test_the_right_law_holds_on_the_largest_amplitudes(effect: str) -> None:
    rig = one_bearing()
    found = judged(rig, record(rig, effect, 0.06), effect)
    assert not found.refused
    assert found.gain > 10.0


def test_an_idle_law_is_within_what_chance_allows() -> None:
    rig = one_bearing()
    y = simulate(rig, RATE, SECONDS, seed=5, noise=0.02, full_scale=490.5)
    for effect in ("quintic", "quadratic"):
        found = judged(rig, y, effect)
        assert not found.refused
        assert abs(found.gain) < 10.0


def test_a_fifth_of_the_record_is_held_out_in_whole_windows() -> None:
    rig = one_bearing()
    y = simulate(rig, RATE, 5.0, seed=5, noise=0.02, full_scale=490.5)
    point = fit_record(rig, prepare(rig, y, RATE))
    mask = upper_part(point, 0)
    assert mask.mean() == pytest.approx(0.2, abs=0.01)
    x = point.data.x[0]
    assert x[mask].std() > 1.15 * x[~mask].std()
