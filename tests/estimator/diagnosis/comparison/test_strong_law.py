"""Strong laws: one that is missing under a measured force is found; one beyond the method makes no verdict."""

from __future__ import annotations

from dataclasses import replace

import pytest

from estimator import Channel, EffectUse, Model, Setting, compare, diagnose, fit, simulate
from estimator.results import NOT_CONCLUSIVE

RATE_HZ = 610.0


def test_a_strong_cubic_under_a_measured_force_is_missing_beside_a_free_mass() -> None:
    cap = {"bearing1.x": {"kL": Setting(4.0e5), "c": Setting(25.0), "S": Setting(0.5)}}
    channels = (Channel("a", "bearing1", "x"), Channel("f", "bearing1", "x", "force"))
    cubic = EffectUse("cubic", {"bearing1.x": {"kNL": Setting(5.0e11)}})
    true = Model(channels, band=(10.0, 200.0), mass={"bearing1": 2.0}, linear=cap, effects=(cubic,))
    y = simulate(true, rate_hz=RATE_HZ, seconds=64.0, seed=1)
    rig = replace(true, mass={}, linear={}, effects=())
    found = compare(rig, y, RATE_HZ)
    assert not found.adequate
    value, low, high = found.missing
    assert 2.5 < low < value < high < 4.0
    assert diagnose(rig, y, RATE_HZ).verdict == "cubic"


@pytest.mark.parametrize(("kNL", "strong"), [(2.0e11, False), (6.0e13, True)])
def test_beside_a_law_that_varies_the_stiffness_by_more_than_half_nothing_is_named(kNL: float, strong: bool) -> None:
    """Its complete model was called incomplete, with another law of displacement."""
    cap = {"bearing1.x": {"kL": Setting(4.0e5), "c": Setting(25.0), "S": Setting(0.5)}}
    cubic = EffectUse("cubic", {"bearing1.x": {"kNL": Setting(kNL)}})
    channels = (Channel("a", "bearing1", "x"),)
    true = Model(channels, band=(10.0, 200.0), mass={"bearing1": 2.0}, linear=cap, effects=(cubic,))
    y = simulate(true, rate_hz=RATE_HZ, seconds=40.0, seed=1)
    rig = replace(true, linear={}, effects=(EffectUse("cubic", {"bearing1.x": {}}),))
    found, compared = diagnose(rig, y, RATE_HZ), compare(rig, y, RATE_HZ)
    assert (found.verdict, compared.adequate) == (("unknown", False) if strong else ("complete", True))
    for messages in (fit(rig, y, RATE_HZ).messages, found.messages, compared.messages):
        assert (NOT_CONCLUSIVE in [m.code for m in messages]) is strong
