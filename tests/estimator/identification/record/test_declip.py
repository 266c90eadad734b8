"""What a limiter took from a channel, restored from the samples beside it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, coupled_on_a_stiff_shaft, one_bearing, record
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimator.diagnosis.verdict.bearing import judge_bearing
from estimator.diagnosis.verdict.diagnose import diagnose
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.record.declip import ceilings, restore_clipped
from estimator.identification.residual import missing_force
from estimator.likelihood.motion.prepare import prepare
from estimator.model.rig import EffectUse
from estimator.simulation.simulator import simulate

HERE = frozenset(["bearing1.x"])
LOST = {"bearing1.x": np.inf}


def damped(turn: float, radius: float, noise: float) -> NDArray[np.float64]:
    """A resonance at `turn` rad a sample under white force, and white noise of a sensor."""
    rng = np.random.default_rng(1)
    x = lfilter([1.0], [1.0, -2 * radius * np.cos(turn), radius**2], rng.standard_normal(3_000_000))
    return np.asarray(x + noise * x.std() * rng.standard_normal(x.size))


@pytest.mark.parametrize(("turn", "radius", "noise"), [(1.0, 0.0, 0.0), (0.3, 0.98, 0.02), (0.1, 0.99, 0.003)])
def test_what_lies_beyond_is_as_far_as_it_was(turn: float, radius: float, noise: float) -> None:
    """A sample at a time, what lies beyond a smooth crest (the last, of 60 samples a period) was a quarter of it, and
    said to be known 15 times better than it was. Another BLAS draws others: of 3 million samples what is
    said scatters by 3 % there, of 300 000 by 6."""
    rig, y = one_bearing(), np.stack([damped(turn, radius, noise)] * 2, axis=1)
    top = float(np.quantile(np.abs(y[:, 0]), 0.99))
    z = y.copy()
    z[:, 0] = np.clip(y[:, 0], -top, top)
    z[5000:5010] = np.nan
    at = np.abs(z[:, 0]) == top
    made, off = restore_clipped(rig, z, HERE)
    same = ~at
    assert np.array_equal(made[same, 0], z[same, 0], equal_nan=True)
    assert np.array_equal(made[:, 1], z[:, 1], equal_nan=True)
    assert (np.abs(made[at, 0]) >= top).all()
    assert (np.sign(made[at, 0]) == np.sign(z[at, 0])).all()
    beyond, was = (np.abs(w[at, 0]) - top for w in (made, y))
    assert beyond.mean() == pytest.approx(was.mean(), rel=0.06)
    assert np.sqrt(np.mean(beyond**2)) == pytest.approx(np.sqrt(np.mean(was**2)), rel=0.06)
    assert np.array_equal(restore_clipped(rig, z, HERE)[0], made, equal_nan=True)
    there = at & np.isfinite(y[:, 0])
    error = np.sqrt(0.5 * np.sum((made[there, 0] - y[there, 0]) ** 2) / len(y)) / np.nanstd(y[:, 0])
    assert off["bearing1.x"] == pytest.approx(error, rel=0.1)


def test_a_channel_without_a_ceiling_is_left_alone() -> None:
    rig = one_bearing()
    rng = np.random.default_rng(1)
    y = rng.standard_normal((20000, 2))
    assert ceilings(y[:, 0]) == (-np.inf, np.inf)
    assert restore_clipped(rig, y, HERE) == (y, {})
    sharp = np.clip(y, -2.5, 2.5)
    assert restore_clipped(rig, sharp, frozenset()) == (sharp, {})
    blurred = np.clip(y, -2.5, 2.5) + 0.001 * rng.standard_normal(y.shape)
    assert restore_clipped(rig, blurred, HERE) == (blurred, LOST)
    flat = np.clip(y, -0.5, 0.5)  # of a square wave nothing is known
    assert restore_clipped(rig, flat, HERE) == (flat, LOST)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.003, 0.02])
def test_a_model_with_the_clipping_has_the_numbers_of_the_rotor(share: float) -> None:
    """Without it kL is 10 to 40 standard deviations off, and kNL is gone."""
    rig = one_bearing()
    y = simulate(rig, RATE, 30.0, seed=4, noise=0.02, full_scale=490.5)
    top = float(np.quantile(np.abs(y[:, 0]), 1.0 - share))
    z = y.copy()
    z[:, 0] = np.clip(y[:, 0], -top, top)
    known = replace(rig, effects=(*rig.effects, EffectUse("sensor_clipping", {"bearing1.x": {}})))
    whole = fit_all_effects(known, z, RATE)
    assert whole.messages[0].code == "clipped_restored"
    level = whole.parameters["bearing1.x.sensor_clipping.level"]
    assert level.value == pytest.approx(top, rel=1e-9)
    exact, bare = fit_all_effects(rig, y, RATE).parameters, fit_all_effects(rig, z, RATE).parameters
    for name in ("kL", "c", "cubic.kNL"):
        p, q = whole.parameters[f"bearing1.x.{name}"], exact[f"bearing1.x.{name}"]
        assert p.value is not None
        assert q.value is not None
        assert p.sd is not None
        assert abs(p.value - q.value) < 2.5 * p.sd, name
    off = bare["bearing1.x.kL"]
    assert off.value is not None
    assert off.sd is not None
    assert abs(off.value - 10.0e6) > 6 * off.sd


def test_nothing_is_told_of_a_bearing_whose_motion_cannot_be_restored() -> None:
    """A limiter at half of the rms, everywhere: no number, no verdict, and all of the force may be missing."""
    rig = one_bearing()
    y = np.clip(simulate(rig, RATE, 8.0, seed=5), -3.0, 3.0)
    known = replace(rig, effects=(*rig.effects, EffectUse("sensor_clipping", {p: {} for p in rig.places})))
    whole = fit_all_effects(known, y, RATE)
    assert not whole.parameters["bearing1.x.kL"].identifiable
    assert "cannot be restored" in whole.parameters["bearing1.x.kL"].reason
    assert whole.parameters["bearing1.x.sensor_clipping.level"].value == pytest.approx(3.0)
    found = missing_force.survey(whole.point, whole.model)
    assert found.interval() == (0.0, 0.0, 100.0)
    said = judge_bearing(whole.model, whole.point, y)
    assert said.verdict == "unknown"
    assert missing_force.UNJUDGED_MESSAGE in said.messages


@pytest.mark.slow
@pytest.mark.parametrize(("lost", "verdict"), [(None, "complete"), ("clearance", "clearance")])
def test_a_law_is_found_where_all_sensors_are_clipped_a_little_and_none_is_made(lost: str | None, verdict: str) -> None:
    """One sample in two hundred is drawn: what a draw is off by is nothing that the model lacks."""
    rig = one_bearing()
    complete = simulate(rig, RATE, 30.0, seed=6, noise=0.02, full_scale=490.5)
    y = complete if lost is None else record(rig, lost, 0.06, seed=6, seconds=30.0)
    top = np.quantile(np.abs(y), 0.995, axis=0)
    known = replace(rig, effects=(*rig.effects, EffectUse("sensor_clipping", {p: {} for p in rig.places})))
    assert diagnose(known, np.clip(y, -top, top), RATE).verdict == verdict


def test_what_is_not_known_of_a_cap_comes_to_the_other_through_a_stiff_shaft() -> None:
    """Numbers there had been said that were 150 standard deviations off, and a law was sought for it."""
    stiff = replace(coupled_on_a_stiff_shaft(), effects=())
    soft = replace(stiff, shaft_stiffness=1e5)
    for rig, other in ((stiff, np.inf), (soft, pytest.approx(4e-5, rel=0.5))):
        data = prepare(rig, simulate(rig, RATE, 3.0, seed=1), RATE)
        off = dict(zip(data.places, data.passed_on({"bearing1.x": np.inf}), strict=True))
        assert off == {"bearing1.x": np.inf, "bearing2.x": other, "bearing1.y": 0.0, "bearing2.y": 0.0}
