"""Narrow lines of a record are left out of the force balance, and move none of its numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator import Channel, EffectUse, Model, Setting, compare, simulate
from estimator.identification.machine import is_mains_multiple
from estimator.identification.machine.line_bands import with_lines_left_out
from estimator.identification.machine.tones import Line, lines_to_leave_out, tones_of

RATE_HZ = 12800.0
CAP_X = {"kL": Setting(1.0e7), "c": Setting(60.0), "S": Setting(1.0e-4)}
ONE_CAP_RIG = Model(
    (Channel("b1x", "bearing1", "x"),), band=(150.0, 5000.0), mass={"bearing1": 0.2}, linear={"bearing1.x": CAP_X},
    speed_rpm=2100.0,
)  # fmt: skip


def tones(rows: int, *hz: float) -> np.ndarray:
    """Tones of equal strength whose frequency wanders by 0.1 % within a second."""
    t = np.arange(rows) / RATE_HZ
    wander = 0.001 * np.sin(2 * np.pi * 1.1 * t) / (2 * np.pi * 1.1)
    return np.sum([np.sin(2 * np.pi * f * (t + wander) + f) for f in hz], axis=0)[:, None]


def test_tones_move_no_number_and_are_no_missing_force() -> None:
    clean = simulate(ONE_CAP_RIG, RATE_HZ, 12.0, seed=2)
    hum = clean + 0.5 * clean.std() * tones(len(clean), 35.0, 251.3, 1101.7, 2400.0)
    found, alone = compare(ONE_CAP_RIG, hum, RATE_HZ), compare(ONE_CAP_RIG, clean, RATE_HZ)
    assert found.adequate
    assert found.missing[0] == 0.0
    for name in ("kL", "c", "S"):
        p, q = found.parameters[f"bearing1.x.{name}"], alone.parameters[f"bearing1.x.{name}"]
        assert abs(p.value - q.value) < 0.5 * q.sd


@pytest.mark.parametrize("hz", [125.0, 175.0], ids=["beside the band", "harmonic of the shaft"])
def test_a_wandering_tone_moves_no_number(hz: float) -> None:
    clean = simulate(ONE_CAP_RIG, RATE_HZ, 8.0, seed=2)
    t = np.arange(len(clean)) / RATE_HZ
    wander = 0.004 * np.sin(2 * np.pi * 0.7 * t) / (2 * np.pi * 0.7)
    tone = 3.0 * clean.std() * np.sin(2 * np.pi * hz * (t + wander))[:, None]
    found, alone = (compare(ONE_CAP_RIG, y, RATE_HZ) for y in (clean + tone, clean))
    assert found.adequate
    for name in ("kL", "c", "S"):
        p, q = found.parameters[f"bearing1.x.{name}"], alone.parameters[f"bearing1.x.{name}"]
        assert abs(p.value - q.value) < 0.5 * q.sd


def test_the_bands_hold_the_tones_and_nothing_else() -> None:
    y = simulate(ONE_CAP_RIG, RATE_HZ, 8.0, seed=3)
    assert with_lines_left_out(ONE_CAP_RIG, y, RATE_HZ).line_bands == ()
    bands = with_lines_left_out(ONE_CAP_RIG, y + 0.3 * y.std() * tones(len(y), 251.3, 2400.0), RATE_HZ).line_bands
    assert [round(b.centre_hz) for b in bands] == [251, 2400]
    assert all(b.high_hz - b.low_hz < 0.02 * b.centre_hz for b in bands)


def test_mains_hum_is_left_out_where_a_short_record_does_not_tell_it_from_a_mode() -> None:
    hum, mode, blurred = (
        Line(channel="b1x", hz=hz, half_width_hz=width, amplitude=1.0, log_p=-90.0, power_ratio=50.0, narrow=False)
        for hz, width in ((60.01, 0.1), (71.3, 0.1), (59.22, 1.4))
    )
    assert lines_to_leave_out([hum, mode], (40.0, 2000.0)) == [replace(hum, has_cause=True)]
    units, rms = {"b1x": "m/s^2"}, {"b1x": 1.0}
    assert [tone.kind for tone in tones_of([hum, mode, blurred], None, units, rms)] == ["mains"]
    assert tones_of([mode, blurred], None, units, rms) == [], "a resonance at 59.2 Hz was called mains"


@pytest.mark.parametrize(("hz", "is_one"), [(100.0, True), (149.9, True), (101.0, False), (60.1, True), (850.0, False)])
def test_a_multiple_of_the_mains_is_within_what_a_grid_and_a_clock_deviate(hz: float, is_one: bool) -> None:
    """Weak lines at 50 and 100 Hz were named beside stronger tones."""
    assert is_mains_multiple(hz) is is_one


@pytest.mark.parametrize("why", ["force", "own", "unknown"])
def test_lines_that_the_model_may_explain_stay(why: str) -> None:
    y = simulate(ONE_CAP_RIG, RATE_HZ, 8.0, seed=4)
    y = y + 0.3 * y.std() * tones(len(y), 251.3)
    line = {"frequency": Setting(251.3 if why == "own" else None)}
    if why == "force":
        rig = replace(ONE_CAP_RIG, channels=(*ONE_CAP_RIG.channels, Channel("f", "bearing1", "x", "force")))
        y = np.hstack([y, y])
    else:
        rig = replace(ONE_CAP_RIG, effects=(EffectUse("line", {"bearing1.x": line}),))
    assert with_lines_left_out(rig, y, RATE_HZ).line_bands == ()
