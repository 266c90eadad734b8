"""Real processes, really killed: what the log then holds."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from promises import PATIENCE_S, within
from stand_ins import MomentEstimator, vibration

from daq.log.reader import read_log
from daq.log.recover import recover
from daq.session.replay import replay_into

HERE = Path(__file__).parents[1]
Property = Callable[[str, object], None]
RATE_HZ = 25_600.0


def start(log: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(HERE / "session_process.py"), str(log), *arguments]
    path = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE.parents[1])])}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=path)
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n"
    return process


def kill_after(log: Path, seconds: float) -> float:
    """Seconds of data lost by kill -9 after `seconds` of acquisition, the rest being right, by log and by recovery."""
    with start(log) as process:
        time.sleep(seconds)
        process.send_signal(signal.SIGKILL)
        killed_ns = time.monotonic_ns()
        process.wait(PATIENCE_S)
        process.stdout.close()  # type: ignore[union-attr]
    recording = read_log(log)
    counts = recording.counts()
    assert recording.gaps == ()
    np.testing.assert_array_equal(counts, vibration(0, len(counts)).counts)
    last_ns = max(reading.t_host_ns for reading in recording.readings() if hasattr(reading, "counts"))
    mended = log.with_name("mended.mcap")
    recovery = recover(log, mended)
    np.testing.assert_array_equal(read_log(mended).counts(), counts)
    assert read_log(mended).complete
    assert recovery.samples == len(counts)
    if recording.estimates:
        assert replay_into(read_log(mended), check=True, make=MomentEstimator).identical
    return (killed_ns - last_ns) / 1e9


def test_kill_9_costs_less_than_a_second(tmp_path: Path, record_property: Property) -> None:
    rng = random.Random(1)
    lost = [kill_after(tmp_path / f"{k}.mcap", rng.uniform(1.2, 2.4)) for k in range(2)]
    row = "crash | kill -9 at a random moment, twice | at most 1 s of data lost, the rest bit for bit"
    record_property("reliability", f"{row} | at most {max(lost):.2f} s lost")
    within(max(lost), 1.0)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_kill_9_fifty_times(tmp_path: Path, record_property: Property) -> None:
    rng = random.Random(2)
    lost = [kill_after(tmp_path / f"{k}.mcap", rng.uniform(1.0, 6.0)) for k in range(50)]
    row = "crash | kill -9 at 50 random moments | at most 1 s of data lost, the rest bit for bit, recovery complete"
    measured = f"at most {max(lost):.2f} s lost, median {np.median(lost):.2f} s"
    record_property("reliability", f"{row} | {measured}")
    print(measured)
    within(max(lost), 1.0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_signal_completes_the_log_within_two_seconds(
    tmp_path: Path, number: signal.Signals, record_property: Property
) -> None:
    with start(tmp_path / "a.mcap") as process:
        time.sleep(0.8)
        process.send_signal(number)
        asked = time.monotonic()
        output, _ = process.communicate(timeout=PATIENCE_S)
    took = time.monotonic() - asked
    row = f"stop | {number.name} | a complete log within 2 s"
    record_property("reliability", f"{row} | {took:.2f} s, complete, replay identical")
    within(took, 2.0)
    assert process.returncode == 0
    summary = json.loads(output.removeprefix("stopped "))
    log = read_log(tmp_path / "a.mcap")
    assert log.complete
    assert log.n_samples == summary["samples"] > 10_000
    np.testing.assert_array_equal(log.counts(), vibration(0, log.n_samples).counts)
    assert replay_into(log, check=True, make=MomentEstimator).identical
