"""A law far stronger than its noise is missing: a free curve comes to rest, however far it is from the model."""

from __future__ import annotations

from dataclasses import replace

from estimator import Channel, EffectUse, Model, Setting, compare, diagnose, simulate

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
