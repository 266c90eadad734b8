"""Pacing of recorded readings."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from ramp_device import Record, read_all

from drivers.reading import Block, Gap, Info, Reading, Signal
from drivers.replay import Replay

INFO = Info((Signal("a", "m/s^2", 1.0),), 1000.0)


def batches(n: int = 5, step_s: float = 0.1) -> list[tuple[list[Reading], int]]:
    out: list[tuple[list[Reading], int]] = [([INFO], 10_000)]
    for k in range(n):
        t_ns = 10_000 + round(k * step_s * 1e9)
        out.append(([Block(100 * k, np.zeros((90, 1), np.int32), t_ns), Gap(100 * k + 90, 10, "sequence")], t_ns))
    return out


@pytest.mark.parametrize(("speed", "seconds"), [(1.0, 0.4), (4.0, 0.1), (None, 0.0)])
def test_pace(speed: float | None, seconds: float) -> None:
    driver = Replay(batches, speed)
    driver.open()
    started = time.monotonic()
    record = read_all(driver, Record(ramp=False))
    took = time.monotonic() - started
    assert seconds <= took < seconds + 0.3
    assert record.samples == 450
    assert driver.stats.lost_samples == 50
    assert [block.t_host_ns for block in record.blocks] == [t_ns for _, t_ns in batches()[1:]]


def test_timeout_before_the_next_is_due() -> None:
    driver = Replay(lambda: batches(step_s=5.0), 1.0)
    driver.open()
    read = [driver.read(0.05) for _ in range(3)]
    assert len(read[0]) == 1
    assert len(read[1]) == 2
    started = time.monotonic()
    assert driver.read(0.05) == []
    assert time.monotonic() - started < 0.15


def test_close_wakes_the_wait() -> None:
    driver = Replay(lambda: batches(step_s=60.0), 1.0)
    driver.open()
    driver.read(1)
    driver.read(1)
    thread = threading.Thread(target=driver.read, args=(30.0,))
    thread.start()
    time.sleep(0.1)
    closed = time.monotonic()
    driver.close()
    thread.join(1)
    assert not thread.is_alive()
    assert time.monotonic() - closed < 0.2


def test_nothing_to_replay() -> None:
    driver = Replay(list, None)
    driver.open()
    assert driver.exhausted
    assert driver.read(1.0) == []
