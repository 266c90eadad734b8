"""The curves that a person looks at: a dead zone is seen as a dead zone."""

from __future__ import annotations

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing, record

from estimator.diagnosis.comparison.comparison import compare
from estimator.diagnosis.comparison.curves import CURVE_STATES, on_hats


def test_a_projection_on_hats_keeps_straight_lines_and_kinks() -> None:
    z = np.random.default_rng(0).standard_normal(20_000)
    knots = np.arange(-8, 9) * 0.5
    got, visits = on_hats(z, knots, np.stack([2 * z + 1, np.abs(z)]))
    seen = visits > 50
    assert got[seen, 0] == pytest.approx(2 * knots[seen] + 1, abs=1e-6)
    assert got[seen, 1] == pytest.approx(np.abs(knots[seen]), abs=1e-6)


@pytest.mark.slow
def test_a_dead_zone_shows_as_a_dead_zone() -> None:
    model = one_bearing()
    hidden = compare(model, record(model, "clearance", 0.06), RATE)
    law = next(k for k in hidden.laws if k.channel == "b1x" and k.against == "displacement")
    sure = law.band_high - law.band_low < 0.4 * np.ptp(law.measured)
    at, measured = law.at[sure], law.measured[sure]
    inner = np.abs(at) < 0.3 * at.max()
    assert np.abs(measured[inner]).max() < 0.1 * np.abs(measured).max()  # flat
    assert measured[0] < 0 < measured[-1]  # flanks that stiffen
    outside = (law.model < law.band_low) | (law.model > law.band_high)
    assert outside.any()
    assert {c.against for c in hidden.curves} <= set(CURVE_STATES)
    assert {"displacement", "velocity", "other_direction"} <= {c.against for c in hidden.curves}


@pytest.mark.slow
def test_the_law_of_a_complete_model_lies_in_its_band() -> None:
    from estimator.simulation.simulator import simulate

    model = one_bearing()
    complete = compare(model, simulate(model, RATE, 10.0, seed=5, noise=0.02, full_scale=490.5), RATE)
    inside = [(k.band_low <= k.model) & (k.model <= k.band_high) for k in complete.laws]
    assert np.mean(np.concatenate(inside)) > 0.85
    zero = [(c.band_low <= 0) & (c.band_high >= 0) for c in complete.curves]
    assert np.mean(np.concatenate(zero)) > 0.85
