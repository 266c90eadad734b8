"""Narrow lines of a record are left out of the force balance, and move none of its numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator import Channel, EffectUse, Model, Setting, compare, simulate
from estimator.identification.machine.line_bands import with_lines_left_out

RATE = 12800.0
CAP = {"kL": Setting(1.0e7), "c": Setting(60.0), "S": Setting(1.0e-4)}
RIG = Model(
    (Channel("b1x", "bearing1", "x"),), band=(150.0, 5000.0), mass={"bearing1": 0.2}, linear={"bearing1.x": CAP},
    speed_rpm=2100.0,
)  # fmt: skip


def tones(rows: int, *hz: float) -> np.ndarray:
    """Tones of equal strength whose frequency wanders by 0.1 % within a second."""
    t = np.arange(rows) / RATE
    wander = 0.001 * np.sin(2 * np.pi * 1.1 * t) / (2 * np.pi * 1.1)
    return np.sum([np.sin(2 * np.pi * f * (t + wander) + f) for f in hz], axis=0)[:, None]


def test_tones_move_no_number_and_are_no_missing_force() -> None:
    clean = simulate(RIG, RATE, 12.0, seed=2)
    hum = clean + 0.5 * clean.std() * tones(len(clean), 35.0, 251.3, 1101.7, 2400.0)
    found, alone = compare(RIG, hum, RATE), compare(RIG, clean, RATE)
    assert found.adequate
    assert found.missing[0] == 0.0
    for name in ("kL", "c", "S"):
        p, q = found.parameters[f"bearing1.x.{name}"], alone.parameters[f"bearing1.x.{name}"]
        assert abs(p.value - q.value) < 0.5 * q.sd


def test_the_bands_hold_the_tones_and_nothing_else() -> None:
    y = simulate(RIG, RATE, 8.0, seed=3)
    assert with_lines_left_out(RIG, y, RATE).line_bands == ()
    bands = with_lines_left_out(RIG, y + 0.3 * y.std() * tones(len(y), 251.3, 2400.0), RATE).line_bands
    assert [round(b.centre_hz) for b in bands] == [251, 2400]
    assert all(b.high_hz - b.low_hz < 0.02 * b.centre_hz for b in bands)


@pytest.mark.parametrize("why", ["force", "own", "unknown"])
def test_lines_that_the_model_may_explain_stay(why: str) -> None:
    y = simulate(RIG, RATE, 8.0, seed=4)
    y = y + 0.3 * y.std() * tones(len(y), 251.3)
    line = {"frequency": Setting(251.3 if why == "own" else None)}
    if why == "force":
        rig = replace(RIG, channels=(*RIG.channels, Channel("f", "bearing1", "x", "force")))
        y = np.hstack([y, y])
    else:
        rig = replace(RIG, effects=(EffectUse("line", {"bearing1.x": line}),))
    assert with_lines_left_out(rig, y, RATE).line_bands == ()
