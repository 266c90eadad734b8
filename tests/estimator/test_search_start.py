"""An effect added without numbers ends where a fit from the true numbers ends."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden_effects import RATE, ROOT

from daq.rig import load_rig
from estimator.effects import CATALOGUE
from estimator.effects.strength import size, strengths, with_effect
from estimator.model import EffectUse
from estimator.simulate import simulate
from estimator.whole import fit_whole

SECONDS = 15.0


@pytest.mark.slow
def test_a_weak_law_at_two_bearings_from_nothing() -> None:
    """Weak Hertz contact: the first seconds leave its preload free to go anywhere, and the fit with it."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    hertz = CATALOGUE["hertz"]
    truth = with_effect(rig, hertz, strengths(hertz, size(rig, "bearing1.x", RATE), 0.02, rig, SECONDS))
    y = simulate(truth, RATE, SECONDS, seed=7000, noise=0.02, full_scale=490.5)
    added = replace(rig, effects=(*rig.effects, EffectUse("hertz", {"bearing1": {}, "bearing2": {}})))
    found, best = (fit_whole(model, y, RATE).point.fit.log_likelihood for model in (added, truth))
    assert abs(found - best) < 0.5
