"""Time, processor time and memory of the commands on one minute at 25.6 kHz, four channels; memory on ten minutes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GIVEN_RIG = ROOT / "configs/tiwari_vyas_1997.toml"
TRUE_RIGS = {"complete": GIVEN_RIG, "clearance": ROOT / "configs/worn_bearing.toml"}
ONE_THREAD_ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
LARGEST_GB = 1.0  # of a process, at any length of the record


def recorded(folder: Path, truth: str, seconds: float) -> Path:
    """The log of a simulated rig."""
    log = folder / f"{truth}.mcap"
    program = [sys.executable, "-m", "daq", "simulate", str(TRUE_RIGS[truth]), "--out", str(log)]
    program += ["--seconds", f"{seconds:g}", "--quiet"]
    subprocess.run(program, check=True, cwd=folder, env=ONE_THREAD_ENVIRONMENT)
    return log


def spent(command: str, log: Path) -> tuple[float, float, float]:
    """Seconds by the clock, seconds of the processors, and the largest memory of the process, GB."""
    program = [sys.executable, "-m", "daq", command, str(log), "--rig", str(GIVEN_RIG), "--quiet"]
    if command == "improve":
        program += ["--out", str(log.with_suffix(".toml"))]
    start = time.perf_counter()
    process = subprocess.Popen(program, cwd=log.parent, env=ONE_THREAD_ENVIRONMENT, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, command
    return time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss / 1e6


@pytest.mark.bench
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("truth", "asked_s"), [
    ("complete", {"fit": 2.0, "compare": 3.0, "diagnose": 8.0, "improve": 25.0}),
    ("clearance", {"fit": 2.0, "compare": 3.0, "diagnose": 12.0, "improve": 25.0}),
])  # fmt: skip
def test_one_minute(truth: str, asked_s: dict[str, float], tmp_path: Path) -> None:
    spent("compare", recorded(tmp_path, truth, 5.0))  # compiled laws are read from the cache
    log = recorded(tmp_path, truth, 60.0)
    print(f"\n60 s, 4 channels, {truth}; load {os.getloadavg()[0]:.1f}")
    for command, asked in asked_s.items():
        wall, processors, peak = spent(command, log)
        print(f"{command:9} {wall:5.1f} s (asked {asked:g}), processors {processors:5.1f} s, peak {peak:.2f} GB")
        assert peak < 1.25 * LARGEST_GB


@pytest.mark.bench
@pytest.mark.timeout(1200)
def test_memory_of_ten_minutes(tmp_path: Path) -> None:
    wall, processors, peak = spent("compare", recorded(tmp_path, "complete", 600.0))
    print(f"\ncompare of 600 s, 4 channels: {wall:.1f} s, processors {processors:.1f} s, peak {peak:.2f} GB")
    assert peak < LARGEST_GB
