"""False alarms in 200 simulated months, and the delay until a change is an alarm: the table of docs/alarms.md."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from daq.trend.alarms.sequential import Cusum, baseline_is_sure, learn

pytestmark = [pytest.mark.bench, pytest.mark.timeout(3600)]
DAY_VALUES, MONTH_VALUES = 1440, 43_830  # one value a minute
SIMULATED_MONTHS = 200
WITHIN_RATIO = 1.5  # of the accepted rate
MEAN, DRIFT_VALUES = 1e7, 60.0  # N/m; minutes in which the drift comes back
SD_PERCENT = 0.4  # of a mean over a minute: kL of the demo's rig in ten seconds has 0.2 %
MONTHS_OF_DELAY = 100
Floats = Any


def estimates(kind: str, n: int, rng: np.random.Generator) -> Floats:
    """(n,) values of unit mean: white, or with a drift of equal size beside it."""
    white = rng.standard_normal(n)
    if kind == "drifting":
        phi = np.exp(-1.0 / DRIFT_VALUES)
        white = white + lfilter([np.sqrt(1 - phi**2)], [1.0, -phi], rng.standard_normal(n + 2000))[2000:]
    return MEAN * (1.0 + 0.01 * SD_PERCENT * white)


def watched(kind: str, change: float, rng: np.random.Generator) -> tuple[Cusum, int, Floats]:
    """A test that has learned, the days that it took, and a month that follows."""
    stream = estimates(kind, 32 * DAY_VALUES + MONTH_VALUES, rng)
    days = next((d for d in (1, 2, 4, 8, 16) if baseline_is_sure(learn(stream[: d * DAY_VALUES]))), 32)
    learned = learn(stream[: days * DAY_VALUES])
    test = Cusum(learned, change * MEAN, MONTH_VALUES)
    for value in stream[days * DAY_VALUES - 200 : days * DAY_VALUES].tolist():  # the filter settles
        test.update(value)
    test.reset()
    return test, days, stream[days * DAY_VALUES :][:MONTH_VALUES]


@pytest.mark.parametrize("change", [0.005, 0.02])
@pytest.mark.parametrize("kind", ["white", "drifting"])
def test_false_alarms_are_as_many_as_were_accepted(kind: str, change: float) -> None:
    """change 0.5 % is about the standard deviation of a value: the test has to add up; 2 % is five of them."""
    rng = np.random.default_rng([int(1000 * change), kind == "white"])
    alarms, days = 0, []
    for _ in range(SIMULATED_MONTHS):
        test, learned, month = watched(kind, change, rng)
        days.append(learned)
        for value in month.tolist():
            if test.update(value):
                alarms += 1
                test.reset()
    rate = alarms / SIMULATED_MONTHS
    print(f"\n{kind}, change {100 * change:g} %: {rate:.2f} false alarms a month (accepted 1), "
          f"learned in {np.mean(days):.1f} days, k {test.reference:.2f}, h {test.threshold:.2f}")  # fmt: skip
    assert rate < WITHIN_RATIO
    if test.threshold > 0.01:  # else one value beyond the reference is rarer than what is accepted
        assert rate > 1.0 / WITHIN_RATIO


@pytest.mark.parametrize("change", [0.02, 0.05])
@pytest.mark.parametrize("kind", ["white", "drifting"])
def test_the_delay_of_a_change(kind: str, change: float) -> None:
    """An alarm with `change` of this size, and a change of this size."""
    rng = np.random.default_rng([int(100 * change), kind == "white"])
    delays, expected = [], []
    for _ in range(MONTHS_OF_DELAY):
        test, _, month = watched(kind, change, rng)
        expected.append(test.delay(change * MEAN))
        before = month[:500]
        for value in before.tolist():
            test.update(value)
        test.up = test.down = 0.0
        after = (month[500:] - change * MEAN).tolist()
        delays.append(next((k for k, value in enumerate(after, 1) if test.update(value)), MONTH_VALUES))
    print(f"\n{kind}, change {100 * change:g} %: an alarm after {np.median(delays):.0f} min (95 %: "
          f"{np.quantile(delays, 0.95):.0f} min), said before: {np.mean(expected):.0f} min")  # fmt: skip
    assert np.quantile(delays, 0.95) < 60
