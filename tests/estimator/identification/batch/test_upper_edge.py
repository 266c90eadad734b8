"""A filter that the rig file gives is undone; one that it leaves out is said, with the frequency to stay below."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing
from numpy.typing import NDArray

from estimator import fit
from estimator.identification.batch.upper_edge import aliasing_message, common_fall_db
from estimator.model import AntiAlias, Model
from estimator.simulation.simulator import simulate

SECONDS = 12.0
HIGH_HZ = one_bearing().band[1]
STEEP = AntiAlias(kind="butterworth", order=6, cutoff_hz=1.1 * HIGH_HZ)
SLOW = AntiAlias(kind="bessel", order=2, cutoff_hz=0.55 * HIGH_HZ)


@cache
def recorded(filtered: AntiAlias | None) -> tuple[Model, NDArray[np.float64]]:
    rig = one_bearing()
    return rig, simulate(replace(rig, anti_alias=filtered), RATE, SECONDS, seed=5)


def test_a_given_filter_is_undone() -> None:
    """The same motion, behind a filter and not: the same numbers, as none of it is folded here."""
    rig, bare = recorded(None)
    _, behind = recorded(STEEP)
    known = fit(replace(rig, anti_alias=STEEP), behind, RATE)
    for name, p in fit(rig, bare, RATE).parameters.items():
        if p.value is not None and p.sd:
            assert known.parameters[name].value == pytest.approx(p.value, abs=0.1 * p.sd), name
    assert not [m for m in known.messages if m.code.startswith("band_")]


def test_a_given_filter_that_lets_much_be_folded_is_said() -> None:
    (message,) = aliasing_message(replace(one_bearing(), anti_alias=SLOW), RATE)
    assert message.code == "band_aliased"
    assert "lower band.high to" in message.text
    assert aliasing_message(replace(one_bearing(), anti_alias=STEEP), RATE) == ()


def test_a_filter_that_is_not_given_is_said() -> None:
    rig, y = recorded(STEEP)
    text = next(m.text for m in fit(rig, y, RATE).messages if m.code == "band_rolls_off")
    low, high = rig.band
    assert 0.5 * low < float(text.split("lower band.high to ")[1].split(" Hz")[0]) < high


def test_no_fall_is_seen_in_chance() -> None:
    rng = np.random.default_rng(3)
    f, n = np.linspace(100.0, 1000.0, 120), np.full(120, 400.0)
    chance = [rng.gamma(n, 1 / n, (2, 120)) for _ in range(400)]
    assert not [1 for ratio in chance if common_fall_db(ratio, f, n, 300.0) is not None]
