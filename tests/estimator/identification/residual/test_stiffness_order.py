"""A ball-pass order that the geometry does not give is found in the record: bearings slip, geometry may be unknown."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hidden_effects import RATE, SECONDS, one_bearing

from estimator.diagnosis.hypotheses import ranking
from estimator.diagnosis.hypotheses.trial import best_on_grid
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.identification.batch import spectral as spectral
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.residual import stiffness_order
from estimator.identification.residual.missing_force import MissingForce
from estimator.model.rig import EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

WHERE = ("bearing1.x", "bearing1.y")


@pytest.fixture(scope="module")
def rig() -> Model:
    return one_bearing()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "order"), [("ball_pass", 2.137), ("ball_pass", 3.6)])
@pytest.mark.parametrize("geometry", [True, False])
def test_an_order_that_slips_is_found_and_fitted(rig: Model, name: str, order: float, geometry: bool) -> None:
    rig = rig if geometry else replace(rig, bearing=None)
    law = CATALOGUE[name]
    truth = strengths(law, size(rig, "bearing1.x", RATE), 0.03, rig, SECONDS) | {"order": order}
    y = simulate(with_effect(rig, law, truth, *WHERE), RATE, SECONDS, seed=2, noise=0.02, full_scale=490.5)
    before = fit_all_effects(rig, y, RATE)
    assert before.model.ball_pass_order == pytest.approx(order, abs=3e-4)
    assert ("the geometry says 2.1000" in before.messages[0].text) == bool(geometry)
    added = replace(rig, effects=(*rig.effects, EffectUse(name, {"bearing1": {}})))
    fit = spectral.fit_spectral(added, y, RATE)
    for key, value in truth.items():
        p = fit.parameters[f"bearing1.x.{name}.{key}"]
        assert abs((p.value or 0.0) - value) < 4.0 * (p.sd or 0.0), (key, p, value)


def test_nothing_turns_in_a_complete_record(rig: Model) -> None:
    y = simulate(rig, RATE, SECONDS, seed=3, noise=0.02, full_scale=490.5)
    whole = fit_all_effects(rig, y, RATE)
    assert stiffness_order.find_stiffness_order(whole.point) is None
    assert whole.model.ball_pass_order is None
    assert not whole.messages


def test_an_order_that_is_given_is_not_sought(rig: Model) -> None:
    assert stiffness_order.lacks_stiffness_order(rig)
    assert not stiffness_order.lacks_stiffness_order(replace(rig, speed_rpm=None))
    assert not stiffness_order.lacks_stiffness_order(replace(rig, ball_pass_order=2.1))
    typed = {place: {"order": Setting(2.1)} for place in WHERE}
    assert not stiffness_order.lacks_stiffness_order(replace(rig, effects=(EffectUse("ball_pass", typed),)))
    assert stiffness_order.lacks_stiffness_order(replace(rig, effects=(EffectUse("ball_pass", {"bearing1": {}}),)))


def test_the_order_is_as_certain_as_it_says() -> None:
    """Force and motion that are white, and a strong law: 60 orders anywhere between the bins."""
    rng = np.random.default_rng(4)
    n, rate, speed = 1 << 16, 12800.0, 300.0
    t = np.arange(n) / rate
    data = SimpleNamespace(
        speed=speed, rate_hz=rate, phase=speed * t, t=t, places=("a",), measured_force_psd=np.zeros(1), lines=()
    )
    scores = []
    for order in rng.uniform(2.1, 3.9, 60):
        x = rng.normal(size=n)
        force = rng.normal(size=n) + 0.3 * np.cos(order * data.phase) * x
        found = stiffness_order.find_stiffness_order(
            SimpleNamespace(data=SimpleNamespace(**vars(data), x=[x]), force=[force])
        )  # type: ignore[arg-type]
        assert found is not None
        scores.append((found.order - order) / found.sd)
    assert 0.7 < float(np.sqrt(np.mean(np.square(scores)))) < 1.3
    assert max(map(abs, scores)) < 4.0


def test_an_order_taken_from_the_record_pays_for_all_that_were_looked_at(rig: Model) -> None:
    """One of 78 complete models had a line of 35 nats among its products, one of 62,000, and a ball pass of 21."""
    point = fit_all_effects(rig, simulate(rig, RATE, 4.0, seed=2, noise=0.02, full_scale=490.5), RATE).point
    trial = best_on_grid(point, rig, CATALOGUE["ball_pass"], "bearing1.x")
    assert trial is not None
    some = replace(trial, gain=25.0)
    survey = MissingForce((), point.bearing_force)
    given, found = (
        ranking.ranked_entries(replace(rig, order_found=known), point, [some], survey)[0].p_value
        for known in (False, True)
    )
    assert found == pytest.approx(given * stiffness_order.order_trials(point))
    assert stiffness_order.order_trials(point) == pytest.approx(29.7 * point.data.speed / (2 * np.pi) * 4.0, rel=0.2)
