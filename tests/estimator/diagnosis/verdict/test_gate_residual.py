"""What is claimed of a law whose fit goes far from the rotor, and of what may be nothing: no more than is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing

from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.verdict import gate_residual, gate_second_law
from estimator.diagnosis.verdict.bearing import quiet, verdict_without_law
from estimator.diagnosis.verdict.diagnose import diagnose
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.errors import NotFiniteError
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.residual import missing_force
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.model.rig import CustomLaw, EffectUse, Setting
from estimator.simulation.simulator import simulate

QUINTIC = LocatedLaw(CATALOGUE["quintic"], "bearing1.x.quintic", (0,), np.array([1e60]), (True,))  # some 1e25 N


def test_a_law_whose_fit_goes_astray_is_nothing() -> None:
    """A pair of laws once went to a stiffness of 4e16 N/m: numpy's warnings came through to the user."""
    rig = replace(one_bearing(), effects=())
    point = fit_all_effects(rig, simulate(rig, RATE, 5.0, seed=2), RATE).point
    entry = Entry("quintic", ("bearing1",), 9.0, 9.0, 1e-9, 3.0, 0.0, {}, 9.0, placed=(QUINTIC,))
    before = missing_force.survey(point, rig)
    with pytest.raises(NotFiniteError, match=r"quintic at bearing1\.x"):
        gate_residual.fit_on_part(point, point, before, entry)
    found = gate_residual.residual_gate(rig, point, before, entry, quiet)
    assert found.misfit_rel is None
    assert found.entry.notes == (gate_residual.REFUSED_DIVERGES,)
    assert gate_second_law.of_one_state(rig, point, point, [entry]) is None


def test_what_may_be_nothing_by_its_interval_makes_no_model_unknown() -> None:
    """A quintic that was found left 0.12 (0.00 to 0.33) % and the verdict unknown."""
    rig = replace(one_bearing(), effects=())
    truth = with_effect(rig, CATALOGUE["cubic"], {"kNL": 2e19}, "bearing1.x")
    point = fit_all_effects(rig, simulate(truth, RATE, 5.0, seed=2), RATE).point
    found = missing_force.survey(point, rig)
    assert found.interval()[1] > 0.0
    assert verdict_without_law(point, found, ()).verdict == "unknown"
    unsure = replace(found, residuals=tuple(replace(r, power_sd_N2=r.power_N2) for r in found.residuals))
    assert unsure.interval()[:2] == (found.interval()[0], 0.0)
    assert verdict_without_law(point, unsure, ()).verdict == "complete"


@pytest.mark.parametrize("hidden", ["hertz", "saturating"])
def test_a_spring_that_gives_way_is_no_contact_seen_along_one_direction(hidden: str) -> None:
    """Hertz contacts that nothing tells of across left 0.14 to 0.19 of its force, within the 0.2 they had."""
    rig = replace(one_bearing(), effects=())
    there = size(rig, "bearing1.x", RATE)
    if hidden == "hertz":
        truth = with_effect(rig, CATALOGUE["hertz"], strengths(CATALOGUE["hertz"], there, 0.06, rig, 20.0), "bearing1")
    else:
        law = CustomLaw("k*g*tanh(x/g)", None, {"k": "N/m", "g": "m"})
        values = {"k": Setting(0.8 * there.kL), "g": Setting(there.x)}
        soft = {p: {**rig.linear[p], "kL": Setting(0.4 * there.kL)} for p in rig.places}
        truth = replace(rig, linear=soft, effects=(EffectUse("soft", {p: dict(values) for p in rig.places}, law),))
    y = simulate(truth, RATE, 20.0, seed=2, noise=0.02)
    rig = replace(rig, channels=rig.channels[:1])
    found = diagnose(rig, y[:, :1], RATE)
    assert found.verdict == ("hertz" if hidden == "hertz" else "unknown")
