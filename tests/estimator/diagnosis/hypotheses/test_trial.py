"""Searched parameters of a weak effect: lent between locations, and stepped to their best on the whole record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing, record

from estimator.diagnosis.hypotheses.ranking import ranked_entries
from estimator.diagnosis.hypotheses.trial import (
    Trial,
    are_contenders,
    best_on_grid,
    best_trial,
    refined_trial,
    repeated_trial,
    with_borrowed_parameters,
    with_heldout_gain,
)
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.identification.residual.missing_force import survey
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.located_law import LocatedLaw, acted_on, located_laws
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path import law_gain
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Channel, Model, Setting
from estimator.results import Parameter
from estimator.simulation.simulator import simulate

CLEARANCE = CATALOGUE["clearance"]


@pytest.fixture(scope="module")
def weak() -> tuple[Model, WorkingPoint, float]:
    """A hidden clearance of 3 %; its gap."""
    rig = one_bearing()
    data = prepare(rig, record(rig, "clearance", 0.03), RATE)
    gap = strengths(CLEARANCE, size(rig, "bearing1.x", RATE), 0.03, rig)["gap"]
    return rig, fit_model(data, located_laws(rig, data)), gap


def test_a_gap_found_at_one_direction_is_tried_at_the_other(weak: tuple[Model, WorkingPoint, float]) -> None:
    rig, point, _ = weak
    found = best_trial(point, point, rig, CLEARANCE, "bearing1.y")
    assert found is not None
    both = with_borrowed_parameters(point, rig, [found], ["bearing1.x", "bearing1.y"])
    assert [t.location for t in both] == ["bearing1.x", "bearing1.y"]
    assert both[0].placed.p[1] == found.placed.p[1]
    assert both[0].placed.at != found.placed.at
    assert both[0].gain > 10.0


def test_the_strongest_takes_the_gap_of_another_that_suits_it_better(weak: tuple[Model, WorkingPoint, float]) -> None:
    """With few nats between a right number and a wrong one the strongest had lent its wrong one: Hertz contact,
    preload 9.9 for 1.45 um at a bearing, 1.15 um at the other, ended in a fit that was not added."""
    rig, point, gap = weak
    found = [best_trial(point, point, rig, CLEARANCE, location) for location in ("bearing1.x", "bearing1.y")]
    best, other = sorted((t for t in found if t is not None), key=lambda t: -t.gain)
    wrong = repeated_trial(point, rig, replace(best, placed=best.placed.with_values(best.placed.p * [1.0, 0.5])))
    assert wrong is not None
    assert wrong.gain < best.gain - 2.0
    strongest = replace(other, gain=wrong.gain - 0.1)
    lent = {
        t.location: t
        for t in with_borrowed_parameters(point, rig, [wrong, strongest], [wrong.location, other.location])
    }
    assert lent[wrong.location].placed.p[1] == other.placed.p[1]
    assert lent[wrong.location].gain > wrong.gain


def test_a_number_that_is_given_has_no_spread(
    weak: tuple[Model, WorkingPoint, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The balls of a bearing were 6.00 +- 0.46."""
    rig, point, _ = weak
    monkeypatch.setattr("estimator.diagnosis.hypotheses.trial.parameter_grid", lambda *_: [np.array([1.0, 2e-7, 6.0])])
    found = best_on_grid(point, rig, CATALOGUE["hertz"], "bearing1")
    assert found is not None
    (entry,) = ranked_entries(rig, point, [with_heldout_gain(found)], survey(point, rig))
    assert entry.parameters["bearing1.hertz.balls"] == Parameter(6.0, 0.0, "1", True, reason="given")
    assert entry.parameters["bearing1.hertz.preload"].sd != 0.0


def test_steps_on_the_whole_record_find_the_gap(weak: tuple[Model, WorkingPoint, float]) -> None:
    rig, point, gap = weak
    found = best_trial(point, point, rig, CLEARANCE, "bearing1.x")
    assert found is not None
    off = repeated_trial(point, rig, replace(found, placed=found.placed.with_values(found.placed.p * [1.0, 0.6])))
    assert off is not None
    best = refined_trial(point, rig, off)
    assert best.gain > off.gain
    assert best.placed.p[1] == pytest.approx(gap, rel=0.1)


def test_an_effect_at_its_limit_still_says_from_what_strength_it_would_be_seen(
    weak: tuple[Model, WorkingPoint, float],
) -> None:
    """Friction of the wrong sign is none; its standard deviation is that of a step about zero."""
    rig, point, _ = weak
    coulomb = CATALOGUE["coulomb"]
    where = acted_on(coulomb, "bearing1.x", point.data)
    free = law_gain.fitted_gain(point, LocatedLaw(coulomb, "bearing1.x.coulomb", where, np.ones(1), free=(True,)))
    assert free is not None
    barred = replace(coulomb, parameters=(replace(coulomb.parameters[0], low=1.0),))  # more than the record has
    limited = best_on_grid(point, rig, barred, "bearing1.x")
    assert limited is not None
    assert (limited.gain, limited.values, limited.df) == (0.0, {}, 1)
    assert limited.spread == free.spread
    assert 0.0 < limited.spread["fc"] < 0.05


def test_the_whole_record_is_for_what_it_could_bring_forward(weak: tuple[Model, WorkingPoint, float]) -> None:
    rig, point, _ = weak
    trial = best_trial(point, point, rig, CLEARANCE, "bearing1.x")
    assert trial is not None

    def at(name: str, gain: float) -> Trial:
        return replace(trial, effect=CATALOGUE[name], gain=gain, df=1)

    clear = [at("clearance", 300.0), at("clearance", 0.1), at("stop", 200.0), at("hertz", 60.0)]
    assert are_contenders(clear) == [True, False, True, False]
    alone = [at("clearance", 300.0), at("stop", 60.0), at("hertz", 50.0)]
    assert are_contenders(alone) == [True, True, False]
    faint = [at("clearance", 20.0), at("stop", 1.0), at("hertz", 0.1)]
    assert are_contenders(faint) == [True, True, False]


@pytest.mark.parametrize("curvature", [0.0, -2e4])
def test_a_drift_has_a_curvature_where_it_is_seen(curvature: float) -> None:
    """An idle curvature made the rate four times less certain. A drift with a curvature, whose folds were sixths in
    time, lost hundreds of nats on the first and the last: the pieces of a fold are spread over the record."""
    cap = {"bearing1.x": {"kL": Setting(2e6), "c": Setting(60.0), "S": Setting(1e-4)}}
    rig = Model((Channel("b1x", "bearing1", "x"),), band=(100.0, 2000.0), mass={"bearing1": 0.2}, linear=cap)
    drift = CATALOGUE["stiffness_drift"]
    truth = with_effect(rig, drift, {"rate": 6e4, "curvature": curvature}, "bearing1.x")
    data = prepare(rig, simulate(truth, 5120.0, 8.0, seed=1, noise=0.0), 5120.0)
    point = fit_model(data, located_laws(rig, data))
    found = best_trial(point, point, rig, drift, "bearing1.x")
    assert found is not None
    assert ("curvature" in found.values) is bool(curvature)
    rate, sd = found.values["rate"]
    assert abs(rate - 6e4) < 4.0 * sd
    if not curvature:
        assert sd < 4e3
    assert np.all(with_heldout_gain(found).heldout > 0.0)
