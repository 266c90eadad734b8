"""An effect added without numbers ends where a fit from the true numbers ends."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden_effects import RATE, ROOT, one_bearing

from daq.rig.rig import Rig, load_rig
from estimator.diagnosis.comparison.heldout import heldout_nll
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.identification.batch import spectral
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.model.rig import EffectUse
from estimator.simulation.simulator import simulate

SECONDS = 15.0
WAVY = """
[[model.custom]]
name = "wavy"
expression = "A*(sin(v/b)+g*sin(2.3*v/b)+h*sin(3.4*v/b))"
at = "bearing1"
parameters = { A = { value = 0.02, unit = "N" }, b = { value = 0.002, unit = "m/s" }, g = { value = -0.1, unit = "1" }, h = { value = 0.2, unit = "1" } }
"""  # noqa: E501


@pytest.mark.slow
def test_a_weak_law_at_two_bearings_from_nothing() -> None:
    """Weak Hertz contact: the first seconds leave its preload free to go anywhere, and the fit with it."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    hertz = CATALOGUE["hertz"]
    truth = with_effect(rig, hertz, strengths(hertz, size(rig, "bearing1.x", RATE), 0.02, rig, SECONDS))
    y = simulate(truth, RATE, SECONDS, seed=7000, noise=0.02, full_scale=490.5)
    added = replace(rig, effects=(*rig.effects, EffectUse("hertz", {"bearing1": {}, "bearing2": {}})))
    found, best = (fit_all_effects(model, y, RATE).point.fit.log_likelihood for model in (added, truth))
    assert abs(found - best) < 0.5


@pytest.mark.slow
def test_a_law_that_the_record_does_not_tell_costs_little_on_held_out_data() -> None:
    """Its searched parameters are held as near in the fit to five folds as in that to all six: a tangent to them is no
    law far off. Free, they made a linear model 875 nats worse, and another simulator's complete one lack 0.6 %."""
    rig = one_bearing()
    law = Rig.parse((ROOT / "configs/tiwari_vyas_1997.toml").read_text() + WAVY).model.effects[-1]
    y = simulate(rig, RATE, 6.0, seed=1, noise=0.02, full_scale=490.5)
    plain, grown = (
        heldout_nll(fit_all_effects(m, y, RATE).point) for m in (rig, replace(rig, effects=(*rig.effects, law)))
    )
    assert len(y) * (grown - plain) < 60.0


def test_a_stop_added_without_numbers_is_found_on_the_other_side() -> None:
    """Begun on the other side it ended at no stiffness: "not identifiable", all of its force still missing."""
    rig = one_bearing()
    at = replace(rig, channels=rig.channels[:1], effects=())
    hidden = {"k": 2e6, "gap": -1.5e-7}
    y = simulate(with_effect(at, CATALOGUE["stop"], hidden), RATE, 2.0, seed=0, noise=0.02)
    found = spectral.fit_spectral(replace(at, effects=(EffectUse("stop", {"bearing1.x": {}}),)), y, RATE).parameters
    for name, value in hidden.items():
        got = found[f"bearing1.x.stop.{name}"]
        assert got.value == pytest.approx(value, abs=4 * got.sd)


@pytest.mark.slow
def test_fit_finds_a_gap_of_twice_the_rms_beside_a_cubic_law() -> None:
    """From a gap of one rms Gauss-Newton ended 30 to 50 nats below, at -0.6e6 +- 0.1e6 N/m for 3e6."""
    rig = one_bearing()
    truth = with_effect(rig, CATALOGUE["clearance"], {"k": 3e6, "gap": 4e-7}, *rig.places)
    y = simulate(truth, RATE, 8.0, seed=0, noise=0.02, full_scale=490.5)
    added = replace(rig, effects=(*rig.effects, EffectUse("clearance", {p: {} for p in rig.places})))
    found = spectral.fit_spectral(added, y, RATE).parameters
    for place in rig.places:
        for name, true in (("k", 3e6), ("gap", 4e-7)):
            p = found[f"{place}.clearance.{name}"]
            assert p.value is not None
            assert p.sd is not None
            assert abs(p.value - true) < 3.0 * p.sd


HUMP = """
[[model.custom]]
name = "hump"
expression = "k*x*exp(-((abs(x)-g)/w)**2)/(1+(v/b)**2)"
at = "bearing1"
parameters = { k = { value = 3e6, unit = "N/m" }, g = { value = 3e-7, unit = "m" }, w = { value = 1.2e-7, unit = "m" }, b = { value = 2e-3, unit = "m/s" } }
"""  # noqa: E501


@pytest.mark.slow
def test_a_typed_law_of_three_searched_numbers_may_be_far_off() -> None:
    """By 5, 0.5 and 3: of the widest grid alone 5.5 of the missing 7.1 % was left, at four places."""
    rig = one_bearing()
    text = (ROOT / "configs/tiwari_vyas_1997.toml").read_text()
    truth = replace(rig, effects=(*rig.effects, Rig.parse(text + HUMP).model.effects[-1]))
    y = simulate(truth, RATE, 6.0, seed=5, noise=0.02, full_scale=490.5)
    typed = HUMP.replace("3e6", "1e6").replace("3e-7", "1.5e-6").replace("1.2e-7", "0.6e-7").replace("2e-3", "6e-3")
    started = replace(rig, effects=(*rig.effects, Rig.parse(text + typed).model.effects[-1]))
    found, best = (fit_all_effects(model, y, RATE).point.fit.log_likelihood for model in (started, truth))
    assert abs(found - best) < 2.0
