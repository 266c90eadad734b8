"""What is left of a record without its faulty channels, and what fit says of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing
from numpy.typing import NDArray

from estimator.errors import DataError
from estimator.identification.fit import fit
from estimator.identification.record import pileup_p_value, survey_record, usable_record
from estimator.model.rig import Channel, EffectUse, Model
from estimator.simulation.simulator import simulate


@pytest.fixture(scope="module")
def rig() -> Model:
    return replace(one_bearing(), effects=())


@pytest.fixture(scope="module")
def record(rig: Model) -> NDArray[np.float64]:
    return simulate(rig, RATE, 6.0, seed=4, noise=0.02, full_scale=490.5)


def test_a_clipped_place_is_not_judged_and_the_other_one_is(rig: Model, record: NDArray[np.float64]) -> None:
    y = record.copy()
    y[:, 0] = np.clip(y[:, 0], -2.3 * y[:, 0].std(), 2.3 * y[:, 0].std())
    found = fit(rig, y, RATE)
    lost = found.parameters["bearing1.x.kL"]
    assert not lost.identifiable
    assert "clipped" in lost.reason
    alone = found.parameters["bearing1.y.kL"]
    assert alone.identifiable
    (said,) = (m for m in found.messages if m.code == "clipped")
    assert said.place == "bearing1.x"
    assert "2.1 % of its samples" in said.text or "2.2 % of its samples" in said.text
    known = replace(rig, effects=(EffectUse("sensor_clipping", {"bearing1.x": {}}),))
    level = fit(known, y, RATE).parameters["bearing1.x.sensor_clipping.level"]
    assert level.value == pytest.approx(y[:, 0].max())


def test_findings_are_said_by_a_fit(rig: Model, record: NDArray[np.float64]) -> None:
    copied, frozen = record.copy(), record.copy()
    copied[:, 1] = copied[:, 0]
    frozen[len(frozen) // 2 :, 1] = frozen[len(frozen) // 2, 1]
    for y, code in ((copied, "copied_channel"), (frozen, "frozen_channel")):
        found = fit(rig, y, RATE)
        assert code in [m.code for m in found.messages]
        assert not found.parameters["bearing1.y.kL"].identifiable
        assert found.parameters["bearing1.x.kL"].identifiable


def test_without_a_usable_place_the_first_finding_is_the_reason(rig: Model, record: NDArray[np.float64]) -> None:
    with pytest.raises(DataError, match=r"b1x is clipped at .* use a sensor range"):
        fit(rig, np.clip(record, -3.0, 3.0), RATE)
    with pytest.raises(DataError, match="shape"):
        usable_record(rig, record[:, :1], survey_record(rig, record[:, :1], RATE))


def test_laws_of_a_lost_place_leave_and_those_of_the_node_stay(rig: Model, record: NDArray[np.float64]) -> None:
    model = replace(
        rig, effects=(EffectUse("cubic", {p: {} for p in rig.places}), EffectUse("cross_coupling", {"bearing1": {}}))
    )
    y = record.copy()
    y[:, 0] = 0.0
    usable = usable_record(model, y, survey_record(model, y, RATE))
    assert [c.name for c in usable.model.channels] == ["b1y"]
    assert {u.name: list(u.parameters) for u in usable.model.effects} == {
        "cubic": ["bearing1.y"],
        "cross_coupling": ["bearing1"],
    }
    assert not usable.parameters["bearing1.x.cubic.kNL"].identifiable


def test_pulses_of_a_tacho_are_no_clipped_motion(rig: Model) -> None:
    noise = np.random.default_rng(3).standard_normal((50_000, 2))
    pulses = np.where(np.arange(50_000) % 100 < 10, 5.0, 0.0)
    model = replace(rig, channels=(*rig.channels, Channel("tacho", "bearing1", "x", "tacho")))
    assert not survey_record(model, np.column_stack([noise, pulses]), RATE).findings


def test_a_pile_of_more_samples_is_less_likely_by_chance() -> None:
    assert 1e-5 > pileup_p_value(24) > pileup_p_value(40) > pileup_p_value(400)


def test_a_spike_is_left_out_of_a_fit_and_said(rig: Model, record: NDArray[np.float64]) -> None:
    y = record.copy()
    y[40_000, 0] = 1e6
    plain, found = fit(rig, record, RATE), fit(rig, y, RATE)
    assert [m.code for m in found.messages if m.place == "bearing1.x"] == ["spikes"]
    p, q = found.parameters["bearing1.x.kL"], plain.parameters["bearing1.x.kL"]
    assert p.value is not None
    assert q.value is not None
    assert abs(p.value - q.value) < (q.sd or 0.0)
