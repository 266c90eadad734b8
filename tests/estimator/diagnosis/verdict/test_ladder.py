"""The models of an improvement: a background instead of one cause, two laws at once."""

from __future__ import annotations

import pytest
from scipy.signal import iirpeak, lfilter

from estimator.diagnosis.comparison.survey import survey_bearing
from estimator.diagnosis.verdict.bearing import fitting_pair, quiet
from estimator.diagnosis.verdict.gates import Context
from estimator.diagnosis.verdict.ladder import Ladder
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.model.rig import Channel, Model, Setting
from estimator.simulation.simulator import simulate

RATE_HZ = 5120.0
CAP = {"bearing1.x": {"kL": Setting(2e6), "c": Setting(60.0), "S": Setting(1e-4)}}
RIG = Model((Channel("b1x", "bearing1", "x"),), band=(100.0, 2000.0), mass={"bearing1": 0.2}, linear=CAP)


def test_two_laws_of_different_states_are_tried_together() -> None:
    """A spring that hardens and a damping that rises with speed: neither leaves little of what both leave together."""
    truth = RIG
    for name in ("cubic", "quadratic_damping"):
        law = CATALOGUE[name]
        truth = with_effect(truth, law, strengths(law, size(RIG, "bearing1.x", RATE_HZ), 0.15, RIG), "bearing1.x")
    y = simulate(truth, RATE_HZ, 6.0, seed=3, noise=0.0)
    whole = fit_all_effects(RIG, y, RATE_HZ)
    survey = survey_bearing(whole.model, whole.point, y)[0]
    entries = {e.effect: e for e in survey.ranking.entries}
    context = Context(model=whole.model, point=whole.point, y=y, survey=survey, say=quiet)
    both = fitting_pair(context, [entries["cubic"], entries["quadratic_damping"]])
    assert both is not None
    assert [law.effect.name for law in both.placed] == ["cubic", "quadratic_damping"]
    assert fitting_pair(context, [entries["cubic"], entries["quadratic"]]) is None


@pytest.mark.parametrize(("height", "structural"), [(0.0, False), (0.3, True)])
def test_a_pedestal_is_one_cause_and_beside_a_peak_of_the_force_a_structural_mode(
    height: float, structural: bool
) -> None:
    """A pedestal explained 95 % of the spectrum of both, was added, and left 14 % of the force without a cause."""
    pedestal = {"mass": 1.2, "frequency": 250.0, "damping": 0.05}
    truth = with_effect(RIG, CATALOGUE["pedestal"], pedestal, "bearing1.x")
    y = simulate(truth, RATE_HZ, 8.0, seed=3, noise=0.0)
    y += height * lfilter(*iirpeak(900.0, 2.0, fs=RATE_HZ), y, axis=0)
    ladder = Ladder(RIG, y, RATE_HZ, fit_all_effects(RIG, y, RATE_HZ))
    ladder.settle_background()
    assert (ladder.whole.model.background is not None) is structural
    assert len(ladder.rungs) == 1
    if structural:
        assert ladder.survey.explained
        assert not ladder.survey.adequate  # eight seconds beside modes do not show every effect
