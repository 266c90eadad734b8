"""What the Rerun sink costs: the core loop's calls, and the CPU of both processes, beside one log call a sample."""

from __future__ import annotations

import resource
import time
from pathlib import Path

import numpy as np
import pytest

from daq.base.contract.sink import Session
from daq.report.rerun.sink import RerunSink
from drivers.contract.reading import Block, Info, Signal
from estimator.model.rig import Channel, Model

pytestmark = pytest.mark.bench
NAMES = ("b1x", "b1y", "b2x", "b2y")


def cpu(who: int) -> float:
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


def spent(path: Path, rate_hz: float, seconds: float) -> tuple[float, float, float]:
    """CPU of this process and of the drawing process in s, and the 99.9 % quantile of a call in s."""
    model = Model(tuple(Channel(n, f"bearing{n[1]}", n[2]) for n in NAMES), (150.0, 8000.0))
    info = Info(tuple(Signal(n, "m/s^2", 0.015) for n in NAMES), rate_hz)
    counts = np.round(np.random.default_rng(1).normal(size=(256, 4)) * 300).astype(np.int32)
    mine, theirs = cpu(resource.RUSAGE_SELF), cpu(resource.RUSAGE_CHILDREN)
    sink = RerunSink(str(path), live=False)
    sink.start(Session(model, info, "", {}, metadata={}))
    calls = []
    for index in range(0, int(seconds * rate_hz), 256):
        before = time.perf_counter()
        sink.readings([Block(index, counts, index)])
        calls.append(time.perf_counter() - before)
    sink.close()
    assert sink.dropped == 0
    calls.sort()
    late = calls[int(0.999 * len(calls))]
    return cpu(resource.RUSAGE_SELF) - mine, cpu(resource.RUSAGE_CHILDREN) - theirs, late


def one_call_a_sample(path: Path, samples: int) -> float:
    """CPU s for each sample of four channels logged by itself."""
    import rerun as rr

    recording = rr.RecordingStream("bench")
    recording.save(path)
    before = cpu(resource.RUSAGE_SELF)
    for k in range(samples):
        recording.set_time("device_time", duration=k / 25600.0)
        for name in NAMES:
            recording.log(name, rr.Scalars(float(k)))
    recording.flush(timeout_sec=10)
    recording.disconnect()
    return (cpu(resource.RUSAGE_SELF) - before) / samples


def test_cost_of_the_view(tmp_path: Path) -> None:
    start = spent(tmp_path / "start.rrd", 25600.0, 1.0)[1]  # of the drawing process: interpreter and imports
    peer = one_call_a_sample(tmp_path / "peer.rrd", 3000)
    for rate_hz in (25600.0, 100_000.0):
        seconds = 20.0
        mine, theirs, late = spent(tmp_path / f"{rate_hz:g}.rrd", rate_hz, seconds)
        drawn = (theirs - start) / (seconds - 1)
        naive = 100 * peer * rate_hz
        print(
            f"\n4 channels at {rate_hz:g} Hz: {100 * mine / seconds:.1f} % of a core here, {100 * drawn:.1f} % drawing,"
        )
        print(f"{1e6 * late:.0f} us for all but 0.1 % of the calls; one log call a sample: {naive:.0f} % of a core")
        assert drawn < 0.3
        assert late < 1e-3 or rate_hz > 25600
