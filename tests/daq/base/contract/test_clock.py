"""The device clock against simulated devices whose clock is known: the stated bound must hold the truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray

from daq.base.contract.clock import WINDOW_S, DeviceClock, SystemClock, theil_sen


@dataclass(frozen=True)
class Case:
    """A device and what lies between it and us. Arrival of a block: its last sample, the wire, and whatever delays."""

    rate_hz: float
    drift_ppm: float
    rows: int
    wire_s: float
    delay_s: float  # mean of an exponential delay of the host
    burst_s: float  # arrivals wait for the next multiple of this
    stall_s: float  # now and then the host does nothing for up to this long
    first: int
    seconds: float

    def arrivals(self, rng: Generator) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Stop index and arrival time of each block; sample i is taken at i / true_rate."""
        n = int(self.seconds * self.rate_hz / self.rows)
        stop = self.first + self.rows * np.arange(1, n + 1)
        t = self.sampled(stop - 1) + self.wire_s + rng.exponential(self.delay_s, n)
        if self.burst_s:
            phase = rng.uniform(0, self.burst_s)
            t = np.ceil((t - phase) / self.burst_s) * self.burst_s + phase
        if self.stall_s:
            for start in np.arange(0, t[-1] - t[0], 0.7) + t[0] + rng.uniform(0, 0.7):
                stall = rng.uniform(0, self.stall_s)
                t = np.where((t > start) & (t < start + stall), start + stall, t)
        return stop, np.maximum.accumulate(t)

    def sampled(self, index: NDArray[np.int64] | int) -> NDArray[np.float64]:
        return np.asarray(index) / (self.rate_hz * (1 + self.drift_ppm * 1e-6))


def draw(rng: Generator) -> Case:
    rate_hz = float(rng.choice([1000.0, 10_000.0, 25_600.0, 51_200.0]))
    rows = int(rng.choice([7, 32, 64, 256]))
    return Case(
        rate_hz=rate_hz,
        drift_ppm=rng.uniform(-50, 50),
        rows=rows,
        wire_s=rng.uniform(0, min(rows / rate_hz, 5e-3)) + rng.uniform(0, 0.5e-3),
        delay_s=10 ** rng.uniform(-5, -2.5),
        burst_s=float(rng.choice([0.0, 1e-3, 16e-3])),
        stall_s=float(rng.choice([0.0, 0.1])),
        first=int(rng.integers(0, 2**40)),
        seconds=rng.uniform(3, 40),
    )


def error_and_bound(case: Case, rng: Generator) -> tuple[float, float, float]:
    """Largest error of the mapping within its range of validity, its bound (s), and the error of the drift (ppm)."""
    clock = DeviceClock(case.rate_hz)
    host0_ns = int(rng.integers(0, 2**50))
    stops, times = case.arrivals(rng)
    t0 = times[0]
    for stop, t in zip(stops.tolist(), times.tolist(), strict=True):
        clock.feed(stop, host0_ns + round((t - t0) * 1e9), case.rows)
    state = clock.state()
    assert state is not None
    oldest = max(case.first, stops[-1] - int(60 * case.rate_hz))
    index = np.array([oldest, (oldest + stops[-1]) // 2, stops[-1], stops[-1] + int(case.rate_hz)])
    offset_s = (state.offset_ns - host0_ns) * 1e-9
    stated = offset_s + index / state.rate_hz
    truth = case.sampled(index) - t0
    return float(np.abs(stated - truth).max()), state.bound_ns * 1e-9, abs(state.drift_ppm - case.drift_ppm)


def coverage(cases: int) -> tuple[float, float, float]:
    results = []
    for seed in range(cases):
        rng = np.random.default_rng(seed)
        results.append(error_and_bound(draw(rng), rng))
    error, bound, drift = np.array(results).T
    return float((error <= bound).mean()), float(np.median(bound)), float(np.median(drift))


@pytest.mark.slow
def test_the_bound_holds_the_truth(record_property: Callable[[str, object], None]) -> None:
    held, bound_s, drift_ppm = coverage(100)
    row = "clock | 100 simulated devices: 50 ppm, bursts of 16 ms, a busy host | the bound holds the truth in 99 %"
    record_property("reliability", f"{row} | {100 * held:.1f} %; median bound {1e3 * bound_s:.1f} ms")
    assert held >= 0.99


@pytest.mark.slow
def test_the_bound_holds_the_truth_in_many() -> None:
    held, bound_s, drift_ppm = coverage(600)
    print(f"bound true in {100 * held:.2f} % of 600 devices; median bound {1e3 * bound_s:.2f} ms, {drift_ppm:.2f} ppm")
    assert held >= 0.99


@pytest.mark.parametrize("rows", [64, 410])
def test_bursts_of_16_ms_on_a_busy_host_at_50_ppm(rows: int) -> None:
    """The case that was promised; least squares through all points is wrong by 1000 ppm there (links.md)."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        case = Case(25_600.0, 50.0, rows, 1e-4, 3.4e-3, 16e-3, 0.1, 0, 30.0)
        error_s, bound_s, drift_ppm = error_and_bound(case, rng)
        assert error_s <= bound_s < 0.05
        assert rows == 410 or drift_ppm < 25.0  # 410 rows are 16.02 ms: the stamps drift slowly through the bursts


@pytest.mark.parametrize("true", [0.5, 0.93, 0.997, 1.003, 1.1])
def test_a_rate_that_is_not_what_the_device_says_is_seen_whatever_the_link(true: float) -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        case = replace(draw(rng), seconds=40.0, drift_ppm=1e6 * (true - 1))
        clock = DeviceClock(case.rate_hz)
        for stop, t in zip(*case.arrivals(rng), strict=True):
            clock.feed(int(stop), round(t * 1e9), case.rows)
        said = clock.true_rate_hz()
        assert said == pytest.approx(case.rate_hz * true, rel=5e-4)


@pytest.mark.slow
def test_a_crystal_is_never_said_to_be_off() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        case = replace(draw(rng), seconds=40.0, drift_ppm=rng.uniform(-300, 300))
        clock = DeviceClock(case.rate_hz)
        for stop, t in zip(*case.arrivals(rng), strict=True):
            clock.feed(int(stop), round(t * 1e9), case.rows)
        assert clock.true_rate_hz() is None


def test_a_quiet_link_is_known_to_a_ppm() -> None:
    error_s, bound_s, drift_ppm = error_and_bound(
        Case(25_600.0, -37.0, 64, 1e-4, 1e-4, 0.0, 0.0, 12345, 30.0), np.random.default_rng(1)
    )
    assert error_s <= bound_s < 0.0025
    assert drift_ppm < 1.0


def test_nothing_is_stated_too_early_or_after_a_restart() -> None:
    clock = DeviceClock(1000.0)
    for k in range(1, 1990):
        clock.feed(k, k * 1_000_000, 1)
    assert clock.state() is None
    for k in range(1990, 4000):
        clock.feed(k, k * 1_000_000, 1)
    state = clock.state()
    assert state is not None
    assert state.rate_hz == pytest.approx(1000.0)
    clock.restart()
    assert clock.state() is None


def test_theil_sen_is_scipys() -> None:
    from scipy.stats import theilslopes

    rng = np.random.default_rng(0)
    x = np.arange(60) * WINDOW_S
    y = 2.0 * x + rng.exponential(1.0, 60)
    slope, low, high = theil_sen(x, y)
    reference = theilslopes(y, x, alpha=math.erf(3.3 / math.sqrt(2)))
    assert slope == pytest.approx(reference.slope)
    assert (low, high) == pytest.approx((reference.low_slope, reference.high_slope), rel=0.01)


def test_the_system_clock() -> None:
    clock = SystemClock()
    assert clock.now_ns() <= clock.now_ns()
    assert abs(clock.wall_offset_ns() - clock.wall_offset_ns()) < 10**9


def test_a_clock_set_beyond_what_python_can_say_ends_no_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def far_future() -> int:
        raise OverflowError("timestamp too large to convert to C _PyTime_t")

    monkeypatch.setattr("time.time_ns", far_future)
    beyond_s = SystemClock().wall_offset_ns() / 1e9
    assert beyond_s > 7e9  # the pipeline tells that it has moved


def test_a_source_faster_than_time_has_no_clock() -> None:
    """A simulated bus at full speed: ten seconds of data in one."""
    clock = DeviceClock(25_600.0)
    for k in range(1, 4000):
        clock.feed(64 * k, 10**12 + k * 250_000, 64)
    assert clock.state() is None


@pytest.mark.parametrize("lost", [True, False], ids=["buffers overflow", "all comes late"])
def test_a_suspended_process_makes_no_bound_untrue(lost: bool, record_property: Callable[[str, object], None]) -> None:
    """Stopped for 20 s, it finds what waited for it, up to 20 s old; a device at +50 ppm."""
    rate_hz, true_hz, rows, stall_s = 25_600.0, 25_600.0 * (1 + 50e-6), 64, 20.0
    rng = np.random.default_rng(3)
    states, bounds, silent = 0, [], 0
    for before in (3.0, 10.0, 61.0):
        clock, asked = DeviceClock(rate_hz), 0.0
        for stop in range(rows, int((before + stall_s + 40.0) * rate_hz), rows):
            taken = (stop - 1) / true_hz
            t = taken + rng.exponential(1e-3)
            if before < taken < before + stall_s:
                if lost and taken > before + 3.0:
                    continue
                t = before + stall_s + 0.01 * (taken - before)  # a hundred times as fast as they were taken
            elif before + stall_s <= taken < before + 1.01 * stall_s:
                t = max(t, before + 1.01 * stall_s)
            clock.feed(stop, round(t * 1e9), rows)
            if taken < asked + 1.0:
                continue
            asked, state = taken, clock.state()
            assert clock.true_rate_hz() is None
            if state is None:
                silent += 1
                continue
            states += 1
            bounds.append(state.bound_ns)
            assert abs(state.offset_ns + (stop - 1) / state.rate_hz * 1e9 - taken * 1e9) <= state.bound_ns, (
                before,
                taken,
            )
    how = "20 s, after 3, 10 and 61 s, device at +50 ppm"
    row = f"clock, process suspended | {how} | the stated bound is true, or none is stated"
    measured = f"true in all {states} states, none in {silent} s; median bound {np.median(bounds) / 1e6:.1f} ms"
    record_property("reliability", f"{row} | {measured}")
    assert states > 100
