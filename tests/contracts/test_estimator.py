"""What every rolling estimator must satisfy; a new one goes into `METHODS` of the service and cannot avoid it."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from daq.session.estimators import ESTIMATOR_OF_METHOD, maker
from estimator import Channel, EffectUse, Estimate, Model, Setting, simulate
from estimator.results import OnlineEstimator

RATE_HZ = 4096.0
BLOCK_ROWS = 512
TIME_CONSTANT_S = 3.0
PLACES = ("bearing1.x", "bearing1.y")
LINEAR = {"kL": Setting(1.3e6), "c": Setting(20.0), "S": Setting(1e-4)}  # resonance at 406 Hz, 2 % of critical
RIG = Model(
    tuple(Channel(place, *place.split(".")) for place in PLACES),
    band=(150.0, 1600.0),
    mass={"bearing1": 0.2},
    linear=dict.fromkeys(PLACES, LINEAR),
    effects=(EffectUse("cubic", {place: {"kNL": Setting(1e15)} for place in PLACES}),),
)
HEALTHY_S = 6.0  # of the start: longer than any estimator's warm-up
FAULT = slice(int(HEALTHY_S * RATE_HZ), int((HEALTHY_S + 1.0) * RATE_HZ))


def with_value(value: float, rows: slice, columns: slice = slice(None)) -> Callable[[np.ndarray], None]:
    def spoil(y: np.ndarray) -> None:
        y[rows, columns] = value

    return spoil


def with_factor(factor: float, rows: slice) -> Callable[[np.ndarray], None]:
    def spoil(y: np.ndarray) -> None:
        y[rows] *= factor

    return spoil


def with_gaps(y: np.ndarray) -> None:
    for start in np.random.default_rng(5).integers(0, len(y), 40):
        y[start : start + 37, start % 2] = np.nan


ALL, ONE_ROW = slice(None), slice(FAULT.start, FAULT.start + 1)
FAULTS: dict[str, Callable[[np.ndarray], None]] = {
    "only NaN": with_value(np.nan, ALL),
    "a second of NaN": with_value(np.nan, FAULT),
    "gaps": with_gaps,
    "a dead channel": with_value(0.0, ALL, slice(1, 2)),
    "a channel that stops at an offset": with_value(9.81, slice(FAULT.start, None), slice(1, 2)),
    "only zeros": with_value(0.0, ALL),
    "a second of zeros": with_value(0.0, FAULT),
    "only tiny values": with_factor(1e-300, ALL),
    "a second of tiny values": with_factor(1e-300, FAULT),
    "only huge values": with_factor(1e300, ALL),
    "a second of huge values": with_factor(1e300, FAULT),
    "one huge value": with_value(1e300, ONE_ROW),
    "one infinite value": with_value(np.inf, ONE_ROW, slice(0, 1)),
}


@pytest.fixture(scope="module")
def record() -> np.ndarray:
    y = simulate(RIG, RATE_HZ, 9.0, seed=3)
    y.flags.writeable = False
    return y


@pytest.fixture(params=ESTIMATOR_OF_METHOD)
def make(request: pytest.FixtureRequest) -> Callable[[], OnlineEstimator]:
    making = maker(request.param, TIME_CONSTANT_S)
    return lambda: making(RIG, RATE_HZ)


def blocks(y: np.ndarray) -> list[np.ndarray]:
    return [y[k : k + BLOCK_ROWS] for k in range(0, len(y), BLOCK_ROWS)]


def estimates(estimator: OnlineEstimator, y: np.ndarray) -> list[Estimate]:
    out = []
    for block in blocks(y):
        estimator.update(block)
        out.append(estimator.snapshot())
    return out


def bits(found: list[Estimate]) -> list[str]:
    """Texts that are equal where every number is equal to the last bit."""
    return [repr(estimate) for estimate in found]


def assert_sound(estimate: Estimate) -> None:
    assert estimate.status
    assert estimate.log_likelihood is None or np.isfinite(estimate.log_likelihood)
    assert np.isfinite([estimate.samples, *(estimate.extra or {}).values()]).all()
    for name, p in estimate.parameters.items():
        if p.identifiable:
            assert p.value is not None, name
            assert p.sd is not None, name
            assert np.isfinite([p.value, p.sd]).all(), (name, p)
            assert p.sd >= 0.0
        else:
            assert p.reason, name


def test_the_healthy_record_is_estimated(make: Callable[[], OnlineEstimator], record: np.ndarray) -> None:
    found = estimates(make(), record)
    assert [e.index for e in found] == sorted(e.index for e in found)
    assert found[-1].index <= len(record)
    for place in PLACES:
        stiffness = found[-1].parameters[f"{place}.kL"]
        assert stiffness.value == pytest.approx(1.3e6, rel=0.05)
    for estimate in found:
        assert_sound(estimate)


def test_equal_blocks_give_equal_bits(make: Callable[[], OnlineEstimator], record: np.ndarray) -> None:
    assert bits(estimates(make(), record)) == bits(estimates(make(), record))


def test_a_snapshot_has_no_side_effect(make: Callable[[], OnlineEstimator], record: np.ndarray) -> None:
    asked, unasked = make(), make()
    for block in blocks(record):
        asked.update(block)
        assert bits([asked.snapshot()]) == bits([asked.snapshot()])
        unasked.update(block)
    assert bits([asked.snapshot()]) == bits([unasked.snapshot()])


def test_a_replay_from_a_reused_buffer_gives_equal_bits(
    make: Callable[[], OnlineEstimator], record: np.ndarray
) -> None:
    replayed, found = make(), []
    buffer = np.empty((BLOCK_ROWS, len(PLACES)))
    for block in blocks(record):
        buffer[: len(block)] = block
        replayed.update(buffer[: len(block)])
        buffer[:] = np.nan
        found.append(replayed.snapshot())
    assert bits(found) == bits(estimates(make(), record))


def test_blocks_are_not_changed(make: Callable[[], OnlineEstimator], record: np.ndarray) -> None:
    y = record.copy()
    with_gaps(y)
    given = y.copy()
    estimates(make(), y)
    np.testing.assert_array_equal(y, given)


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_data_never_raise_and_every_number_is_sound(
    make: Callable[[], OnlineEstimator], record: np.ndarray, fault: str
) -> None:
    y = record.copy()
    FAULTS[fault](y)
    for estimate in estimates(make(), y):
        assert_sound(estimate)


def test_memory_does_not_grow(make: Callable[[], OnlineEstimator], record: np.ndarray) -> None:
    """The state is compared after whole turns of one record, once the longest buffer, of 24 s, is full."""
    estimator, bytes_held = make(), []
    tracemalloc.start()
    turns = 4  # of 9 s
    for _ in range(turns + 1):
        estimates(estimator, record)
        gc.collect()
        bytes_held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert turns * len(blocks(record)) > 200
    assert bytes_held[-1] - bytes_held[turns - 1] < 0.05 * bytes_held[turns - 1]
