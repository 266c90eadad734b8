"""The test for a change: known run lengths, baselines that are found again, delays. Rates: tests/bench."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from daq.trend.alarms.sequential import Baseline, Cusum, baseline_is_sure, learn, run_length, threshold


def drifting(n: int, seed: int, values: float = 60.0) -> np.ndarray:  # type: ignore[type-arg]
    """White noise of sd 1 beside a drift of sd 1 that comes back within `values`."""
    rng = np.random.default_rng(seed)
    phi = np.exp(-1.0 / values)
    drift = lfilter([np.sqrt(1 - phi**2)], [1.0, -phi], rng.standard_normal(n + 1000))[1000:]
    return np.asarray(rng.standard_normal(n) + drift)


@pytest.mark.parametrize(
    ("reference", "limit", "mean", "known"),
    [(0.5, 4.0, 0.0, 336.0), (0.5, 5.0, 0.0, 930.0), (0.5, 4.0, 1.0, 8.38)],
)
def test_run_lengths_are_those_of_the_literature(reference: float, limit: float, mean: float, known: float) -> None:
    """Hawkins & Olwell 1998, tables of the one-sided CUSUM."""
    assert run_length(reference, limit, mean) == pytest.approx(known, rel=0.03)


def test_the_threshold_pays_for_what_was_learned() -> None:
    exact = threshold(0.5, 10**7, 0.0, 0.0, 1000.0)
    assert run_length(0.5, exact) == pytest.approx(1000.0, rel=0.02)
    assert exact < threshold(0.5, 1000, 0.0, 0.0, 1000.0) < threshold(0.5, 100, 0.0, 0.0, 1000.0)
    assert threshold(6.0, 1000, 0.0, 0.0, 1000.0) < 0.01  # one value is enough


def test_white_noise_is_white_and_a_drift_is_found() -> None:
    rng = np.random.default_rng(1)
    white = learn(5.0 + rng.standard_normal(1440), np.full(1440, 0.9))
    assert (white.phi, white.theta, white.typical_sd) == (0.0, 0.0, 0.9)
    assert white.mean == pytest.approx(5.0, abs=0.1)
    assert baseline_is_sure(white)
    slow = learn(drifting(10_080, 2))
    assert slow.phi == pytest.approx(np.exp(-1 / 60), abs=0.01)
    assert slow.gain == pytest.approx(0.1, abs=0.03)
    assert baseline_is_sure(slow)
    assert not baseline_is_sure(learn(drifting(1440, 3)))  # a day of it says too little


def test_a_value_after_a_gap_is_no_alarm_because_it_drifted_meanwhile() -> None:
    baseline = Baseline(mean=0.0, sd=1.0, phi=0.99, theta=0.0, values=100_000)
    test = Cusum(baseline, 100.0, 43_200.0)
    drifted = 2.0 * baseline.spread
    assert [test.update(v) for v in (0.0, drifted)] == [0, 1]
    test = Cusum(baseline, 100.0, 43_200.0)
    test.update(0.0)
    test.interrupted()
    assert test.update(drifted) == 0


def test_a_change_is_seen_with_its_sign_and_a_less_certain_value_counts_less() -> None:
    baseline = Baseline(mean=100.0, sd=1.0, phi=0.0, theta=0.0, values=1440, typical_sd=1.0)
    rng = np.random.default_rng(4)
    for sign in (1, -1):
        test, took = Cusum(baseline, 2.0, 43_200.0), 0
        said = 0
        while not said:
            said, took = test.update(100.0 + 2.0 * sign + rng.standard_normal(), 1.0), took + 1
        assert said == sign
        assert took < 6 * test.delay(2.0)
    assert Cusum(baseline, 2.0, 43_200.0).update(120.0, 1.0) == 1
    assert Cusum(baseline, 2.0, 43_200.0).update(120.0, 100.0) == 0
