"""In a thread or not, the same blocks give the same answers; nobody waits for a slow estimator."""

from __future__ import annotations

import threading
import time

import numpy as np
from promises import PATIENCE_S, within
from stand_ins import MomentEstimator, paper_rig, vibration

from daq.log.codec import encode_estimate
from daq.session.estimation import Estimation
from daq.session.estimator_runner import BUSY_BLOCKS, Ask, EstimatorRunner

MODEL = paper_rig().model
ROWS = vibration(0, 200_000).counts * 0.01


class Slow(MomentEstimator):
    def update(self, block: np.ndarray) -> None:
        time.sleep(0.02)
        super().update(block)


def test_a_thread_changes_nothing() -> None:
    woken = threading.Semaphore(0)
    here = EstimatorRunner(MomentEstimator(MODEL, 25_600.0))
    there = EstimatorRunner(MomentEstimator(MODEL, 25_600.0), woken.release)
    for runner in (here, there):
        estimation = Estimation(runner, 4, 25_600.0, 777)
        estimation.append(ROWS[:70_001], stamp=5)
        estimation.skip(3_000_000)
        estimation.append(ROWS, stamp=6)
        assert estimation.finish(PATIENCE_S)
    ours, theirs = here.take(), there.take()
    assert [encode_estimate(a.estimate) for a in ours] == [encode_estimate(a.estimate) for a in theirs]
    assert [a.stamp for a in ours] == [a.stamp for a in theirs]
    assert {5, 6, 0} == {a.stamp for a in ours}
    for _ in ours:
        assert woken.acquire(timeout=PATIENCE_S)


def test_putting_never_waits_and_busy_says_when_to_stop() -> None:
    runner = EstimatorRunner(Slow(MODEL, 25_600.0), lambda: None)
    begin = time.monotonic()
    for _ in range(BUSY_BLOCKS + 20):
        runner.put(ROWS[:1024], None)
    within(time.monotonic() - begin, 0.5)
    assert runner.busy
    assert runner.close(0.1) is False
    assert not runner.busy


def test_what_is_closed_says_no_more() -> None:
    runner = EstimatorRunner(Slow(MODEL, 25_600.0), lambda: None)
    for _ in range(5):
        runner.put(ROWS[:1024], Ask(0, 0))
    assert runner.close(0.03) is False
    runner.take()
    time.sleep(0.1)
    assert runner.take() == []


def test_a_failing_estimator_is_dropped() -> None:
    class Failing(MomentEstimator):
        def update(self, block: np.ndarray) -> None:
            raise ZeroDivisionError("a defect")

    woken = threading.Event()
    runner = EstimatorRunner(Failing(MODEL, 25_600.0), woken.set)
    runner.put(ROWS[:1024], Ask(0, 0))
    assert woken.wait(PATIENCE_S)
    assert isinstance(runner.failure, ZeroDivisionError)
    runner.put(ROWS[:1024], Ask(0, 0))
    assert runner.close(PATIENCE_S)
    assert runner.take() == []
