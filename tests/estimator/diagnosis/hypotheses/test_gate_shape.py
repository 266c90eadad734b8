"""Whether a law has the shape of what is missing: one of another state is seen, the right one leaves nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing, record
from numpy.typing import NDArray

from estimator.diagnosis.hypotheses import gate_shape
from estimator.diagnosis.hypotheses.trial import best_on_grid
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size
from estimator.identification.batch.grid_start import fit_record
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.prepare import prepare
from estimator.model.rig import CustomLaw, EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

SECONDS = 10.0


def left(rig: Model, y: NDArray[np.float64], effect: str) -> float:
    point = fit_record(rig, prepare(rig, y, RATE))
    trial = best_on_grid(point, rig, CATALOGUE[effect], "bearing1.x")
    assert trial is not None
    after = fit_model(point.data, [*point.placed, trial.placed], start=point, rounds=2)
    found = gate_shape.misfit_rel(point, after, CATALOGUE[effect], {0})
    assert found is not None
    return found


def one_sided_drag(rig: Model) -> NDArray[np.float64]:
    """Of one direction of the velocity: half of it is odd, as a drag that the catalogue has, half even."""
    there = size(rig, "bearing1.x", RATE)
    law = CustomLaw("d*v*maximum(v, 0)", None, {"d": "N s^2/m^2"})
    values = {"d": Setting(0.1 * there.kL * there.x / there.v**2)}
    truth = replace(rig, effects=(*rig.effects, EffectUse("one_way", {"bearing1.x": values}, law)))
    return simulate(truth, RATE, SECONDS, seed=6, noise=0.02, full_scale=490.5)


@pytest.mark.parametrize("effect", ["quadratic", "quadratic_damping"])
def test_a_drag_of_one_direction_is_neither_a_one_sided_spring_nor_a_drag(effect: str) -> None:
    rig = one_bearing()
    assert left(rig, one_sided_drag(rig), effect) > THRESHOLDS.other_terms_misfit_min_rel


@pytest.mark.parametrize("effect", ["quadratic", "stop", "coulomb", "quadratic_damping"])
def test_the_right_law_leaves_nothing_even_in_the_velocity(effect: str) -> None:
    rig = one_bearing()
    assert left(rig, record(rig, effect, 0.06), effect) < THRESHOLDS.misfit_max_rel


def test_what_is_left_is_measured_by_what_the_law_explains_where_that_is_more() -> None:
    """A Hertz contact joins two directions: beside a cubic, which does most of what terms of one direction do, 0.18 of
    1.6 % of the force was 39 % of that, and the contact was refused."""
    rig = one_bearing()
    point = fit_record(rig, prepare(rig, record(rig, "stop", 0.06), RATE))
    power, _, _ = gate_shape.polynomial_power(point, 0, "x", tuple(range(2, 10)))
    plain = gate_shape.misfit_rel(point, point, CATALOGUE["stop"], {0})
    assert plain == pytest.approx(1.0)
    assert gate_shape.misfit_rel(point, point, CATALOGUE["stop"], {0}, least=0.5 * power) == plain
    assert gate_shape.misfit_rel(point, point, CATALOGUE["stop"], {0}, least=25.0 * power) == pytest.approx(
        0.2, rel=0.01
    )
