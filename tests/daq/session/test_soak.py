"""Two hours of data as fast as they go, and five devices at once: memory, handles, gaps, drift of the estimates."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from stand_ins import ScriptedDriver, info_of, paper_rig

from daq.base.contract.sink import Session, Status
from daq.log.reader import read_log
from daq.log.writer import LogWriter
from daq.rig.rig import Rig
from daq.session.acquire import Device, RunSummary, acquire_all, acquire_from
from daq.session.estimators import maker
from drivers.can.can_frames import CanFrames
from drivers.contract.reading import Block, LinkStats, Reading
from drivers.foreign.mapped import MappedDecoder
from drivers.protocol.device_info import Expected
from estimator.results import Estimate

pytestmark = [pytest.mark.soak, pytest.mark.timeout(3600)]
RIG = paper_rig()
RATE_HZ = 25_600
ROWS = 2048


def noise(seconds: float, seed: int = 0) -> Iterator[list[Reading]]:
    """Counts of a resonance at 1.1 kHz driven by noise, from a pool that repeats each 41 s without a seam."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    pole = 0.995 * np.exp(2j * np.pi * 1100 / RATE_HZ)
    drive = rng.standard_normal((512 * ROWS, 4))
    twice = np.concatenate([drive, drive])  # the second time it is in its periodic state
    motion = lfilter([1.0, -2.0, 1.0], [1.0, -2 * pole.real, abs(pole) ** 2], twice, axis=0)[len(drive) :]
    pool = np.round(motion / motion.std() * 3000).astype(np.int32)
    yield [info_of(RIG)]
    for k in range(int(seconds * RATE_HZ / ROWS)):
        at = k % 512 * ROWS
        t_ns = 10**12 + round((k + 1) * ROWS * 1e9 / RATE_HZ)
        yield [Block(k * ROWS, pool[at : at + ROWS], t_ns)]


def own_mb() -> float:
    """Memory that only we fill. Pages of program files count to RSS too, and a busy machine takes and gives them."""
    lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    return sum(int(line[1]) for line in lines if line[0] in ("RssAnon:", "VmSwap:")) / 1e3


class Watch:
    """A sink that notes memory, handles and the estimates each minute of data."""

    def __init__(self) -> None:
        self.mb: list[float] = []
        self.handles: list[int] = []
        self.values: list[dict[str, tuple[float, float]]] = []
        self._last: Estimate | None = None
        self._next = 0

    def start(self, session: Session) -> None: ...

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Block) and reading.index >= self._next:
                self._next += 60 * RATE_HZ
                self.mb.append(own_mb())
                self.handles.append(len(os.listdir("/proc/self/fd")))
                known = self._last.parameters.items() if self._last else ()
                self.values.append({n: (p.value, p.sd or 0.0) for n, p in known if p.value is not None})

    def estimate(self, estimate: Estimate) -> None:
        self._last = estimate

    def status(self, status: Status) -> None: ...

    def close(self) -> None: ...


def _moves(early: list[dict[str, tuple[float, float]]], late: list[dict[str, tuple[float, float]]]) -> list[float]:
    """By how many of its standard deviations the mean of each estimate has moved."""
    out = []
    for name in early[-1].keys() & late[-1].keys():
        a, b = (np.array([v[name] for v in part if name in v]) for part in (early, late))
        if np.median(a[:, 1]) > 0:
            out.append(float(abs(b[:, 0].mean() - a[:, 0].mean()) / np.median(a[:, 1])))
    return out


@pytest.mark.parametrize(("method", "least"), [("score-matching", 20.0), ("spectral", 10.0)])
def test_two_hours(method: str, least: float, tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    """least : times real time, on a machine with other work; the page says what it was.

    With a heap for each thread, as glibc has them unless set otherwise, their free memory grew by 5.1 and 5.7 MB;
    of Python's objects 17 kB come in 28 minutes (tracemalloc), this test's own notes among them.
    """
    seconds = float(os.environ.get("ROTORSCOPE_SOAK_S", "7200"))
    watch = Watch()
    begin, cpu = time.monotonic(), time.process_time()
    summary = acquire_from(
        RIG, ScriptedDriver(noise(seconds), "capture"), [LogWriter(tmp_path / "a.mcap", live=False), watch],
        make=maker(method, 60.0),
    )  # fmt: skip
    wall = seconds / (time.monotonic() - begin)
    speed = seconds / (time.process_time() - cpu)  # by one core of its own
    minutes = len(watch.mb)
    growth = np.median(watch.mb[-5:]) - np.median(watch.mb[minutes // 8 : minutes // 8 + 5])
    drift = _moves(watch.values[minutes // 4 : minutes // 2], watch.values[-minutes // 4 :])
    memory = f"memory {watch.mb[minutes // 8]:.0f} -> {watch.mb[-1]:.0f} MB ({growth:+.1f})"
    handles = f"handles {min(watch.handles[2:])} to {max(watch.handles[2:])}"
    moved = f"largest move of {len(drift)} estimates, second to last quarter, {max(drift, default=0.0):.2f} sd"
    pace = f"{speed:.0f} times real time by a core of its own ({wall:.0f} on this busy machine)"
    measured = f"{pace}, {summary.lost_samples} lost, {memory}, {handles}, {moved}"
    print(f"\n{seconds / 3600:.1f} h of data: {measured}")
    how = f"{seconds / 3600:.1f} h of data of 4 x 25.6 kS/s through the pipeline into a log, {method}"
    promised = "20 times real time or faster, no gap, memory and handles flat, no drift"
    record_property("reliability", f"endurance | {how} | {promised} | {measured}")
    assert summary.samples == int(seconds * RATE_HZ / ROWS) * ROWS
    assert summary.gaps == ()
    assert growth < 5.0
    assert max(watch.handles[2:]) - min(watch.handles[2:]) <= 1
    assert speed > least
    assert drift
    assert max(drift) < 1
    log = read_log(tmp_path / "a.mcap")
    assert log.complete
    assert log.n_samples == summary.samples


SLOW_RIG = """schema = 1
[band]
low = 2.0
high = 40.0
[acquisition]
rate_hz = 100.0
[[channel]]
name = "x"
node = "bearing1"
direction = "x"
unit = "m/s^2"
"""
SLOW_DBC = b"""VERSION ""
BS_:
BU_: d
BO_ 256 M: 2 d
 SG_ X : 0|16@1- (0.001,0) [0|0] "m/s^2" d
"""


def slow_frames(hours: float, lost: set[int]) -> Iterator[CanFrames]:
    """Of a device without a counter at 100.02 Hz, with jitter; those of `lost` are missing."""
    rng, rows = np.random.default_rng(1), 600
    drive = np.cumsum(rng.standard_normal(rows * 64)) * 30
    for k in range(round(hours * 3600 * 100 / rows)):
        index = np.arange(k * rows, (k + 1) * rows)
        index = index[~np.isin(index, list(lost))] if lost else index
        counts = (drive[index % len(drive)] % 20_000 - 10_000).astype("<i2")
        payload = np.zeros((len(index), 64), np.uint8)
        payload[:, :2] = counts.view(np.uint8).reshape(-1, 2)
        t_ns = 10**12 + np.rint(index * 1e9 / 100.02 + rng.exponential(2e5, len(index))).astype(np.int64)
        n = len(index)
        yield CanFrames(np.full(n, 256, np.uint32), np.full(n, 2, np.uint8), payload, t_ns)


def test_a_day_of_100_hz(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    """Placed by the stamps alone: no loss is invented, and none is missed, however long it goes on."""
    hours = float(os.environ.get("ROTORSCOPE_SOAK_S", "86400")) / 3600
    rng = np.random.default_rng(2)
    lost = {int(at) for at in rng.choice(np.arange(10_000, int(hours * 360_000) - 1000), 50, replace=False)}
    rig, mb = Rig.parse(SLOW_RIG), list[float]()
    decoder = MappedDecoder(LinkStats(), SLOW_DBC, {"x": "M.X"}, Expected(100.0), recorded=True)

    def readings() -> Iterator[list[Reading]]:
        for number, frames in enumerate(slow_frames(hours, lost)):
            if number % 100 == 0:
                mb.append(own_mb())
            yield decoder.feed(frames, int(frames.t_ns[-1]))
        yield decoder.feed(CanFrames.build([]), 0, final=True)

    cpu = time.process_time()
    driver = ScriptedDriver(readings(), "capture")
    summary = acquire_from(
        rig, driver, [LogWriter(tmp_path / "a.mcap", live=False)], make=maker("score-matching", 60.0),
        queue_bytes=1 << 20,  # a file is read ahead until the queue of 32 MiB is full, which would hide what grows
    )  # fmt: skip
    took = time.process_time() - cpu
    holes = {index for gap in summary.gaps for index in range(gap.index, gap.index + gap.count)}
    growth = np.median(mb[-3:]) - np.median(mb[len(mb) // 8 : len(mb) // 8 + 3])
    measured = f"{summary.samples} samples, {len(lost)} lost, all in place, {growth:+.1f} MB, {took:.0f} s of a core"
    print(f"\n{hours:.1f} h of 100 Hz: {measured}")
    row = f"{hours:.1f} h of a device without a counter | 100.02 Hz for 100 Hz, jitter, 50 losses | each in its place"
    record_property("reliability", f"{row}, memory flat | {measured}")
    assert holes == lost
    assert growth < 5.0


def test_five_devices_at_once_in_real_time(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    """Five devices of four channels at 25.6 kS/s in one process for 20 s: no gap, and each log replays."""

    def paced(seed: int) -> Iterator[list[Reading]]:
        begin = time.monotonic()
        for batch in noise(20.0, seed):
            for block in batch:
                if isinstance(block, Block):
                    time.sleep(max(0.0, begin + (block.index + ROWS) / RATE_HZ - time.monotonic()))
            yield [Block(b.index, b.counts, time.monotonic_ns()) if isinstance(b, Block) else b for b in batch]

    cpu, begin = time.process_time(), time.monotonic()
    devices = [Device(f"d{n}", RIG, ScriptedDriver(paced(n)), [LogWriter(tmp_path / f"{n}.mcap")]) for n in range(5)]
    outcome = acquire_all(devices, make=maker("score-matching", 10.0))
    cores = (time.process_time() - cpu) / (time.monotonic() - begin)
    for n in range(5):
        summary = outcome[f"d{n}"]
        assert isinstance(summary, RunSummary)
        assert summary.gaps == ()
        log = read_log(tmp_path / f"{n}.mcap")
        assert log.complete
        assert log.n_samples == summary.samples
    measured = f"{cores:.2f} cores, no gap"
    print(f"\nfive devices of 25.6 kS/s with estimators and logs: {measured}")
    record_property("reliability", f"load | five devices of 4 x 25.6 kS/s in one service, 20 s | no gap | {measured}")
