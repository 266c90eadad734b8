"""Pacing of a log as a link."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest
from promises import PATIENCE_S, within
from sessions import make_block, write_log

from daq.log.reader import Recording, read_log
from daq.session.replay import ReplayDriver
from drivers.contract.reading import Block, Gap, Reading


@pytest.fixture
def log(tmp_path: Path) -> Recording:
    """0.4 s: four blocks of 2304 rows, a gap of 256 behind each."""
    stream: list[Reading] = []
    for k in range(4):
        stream += [make_block(2560 * k, 2304), Gap(2560 * k + 2304, 256, "sequence")]
    write_log(tmp_path / "a.mcap", stream)
    return read_log(tmp_path / "a.mcap")


@pytest.mark.parametrize(("speed", "seconds"), [(1.0, 0.38), (4.0, 0.09), (None, 0.0)])
def test_pace(log: Recording, speed: float | None, seconds: float) -> None:
    driver, out, started = ReplayDriver(log, speed), list[Reading](), time.monotonic()
    driver.open()
    while not driver.exhausted:
        out += driver.read(0.1)
    took = time.monotonic() - started
    assert took >= seconds
    within(took - seconds, 0.5)
    assert sum(len(r.counts) for r in out if isinstance(r, Block)) == 4 * 2304
    assert driver.stats.lost_samples == 4 * 256
    assert driver.read(0.1) == []


def test_a_timeout_before_the_next_is_due_and_a_close_that_wakes(log: Recording) -> None:
    driver = ReplayDriver(log, 0.01)  # the first block ends after 9 s
    driver.open()
    driver.read(0.05)  # what the log says before the first sample
    started = time.monotonic()
    assert driver.read(0.05) == []
    within(time.monotonic() - started, 0.3)
    thread = threading.Thread(target=driver.read, args=(30.0,))
    thread.start()
    time.sleep(0.1)
    closed = time.monotonic()
    driver.close()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    within(time.monotonic() - closed, 0.3)
