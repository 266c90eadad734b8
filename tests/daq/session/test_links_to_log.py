"""Device to log and back over real links, faults included: what is in the log is what the device sent, or a gap."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from promises import PATIENCE_S, least_share, until, within
from ramp_device import PERIOD, Served, ramp_device
from stand_ins import MomentEstimator, Recorder, paper_rig

from daq.base.contract.clock import SystemClock
from daq.log.reader import Recording, read_log
from daq.log.writer import LogWriter
from daq.session.acquire import RunSummary, acquire_from
from daq.session.replay import replay_into
from drivers.contract.link_config import VirtualConfig
from drivers.contract.reading import Block, Driver, Notice, Reading
from drivers.links.links import make_driver, parse_link
from drivers.simulated.simulated import SimulatedDevice

RIG = paper_rig()
FAULTS = {"drop": 0.02, "flip": 0.02, "duplicate": 0.02, "reorder": 0.01}  # of the frames


def record(
    driver: Driver, path: Path, seconds: float | None, stop: threading.Event | None = None, sink: Recorder | None = None
) -> RunSummary:
    return acquire_from(RIG, driver, [LogWriter(path), *([sink] if sink else [])], seconds, stop, make=MomentEstimator)


def assert_ramp(log: Recording, restarts: int = 0) -> None:
    """Every sample present says by its value that it lies where it should; the rest is gaps, all named."""
    assert log.complete, log.damage
    counts = log.counts().astype(np.int64)
    there = counts[:, 0] > np.iinfo(np.int32).min
    assert (~there).sum() == log.lost_samples == sum(g.count for g in log.gaps)
    index = log.first + np.flatnonzero(there)
    shift = (counts[there][:, 0] + PERIOD // 2 - index) % PERIOD
    assert len(np.unique(shift)) <= 1 + restarts
    for channel in range(1, 4):
        step = (counts[there][:, channel] - counts[there][:, 0]) % PERIOD
        assert (step == 100 * channel).all()
    assert replay_into(log, RIG, check=True, make=MomentEstimator).identical


@pytest.mark.parametrize(
    ("link", "layout"),
    [
        ("virtual:", "fd16"),
        ("slcan:pty", "fd16"),
        ("serial:pty", "serial16"),
        ("serial:socket://127.0.0.1:0", "serial24"),
    ],
)
def test_a_faulty_device_in_real_time(tmp_path: Path, link: str, layout: str) -> None:
    # an slcan line has no check sum: nothing behind it can find a flipped bit
    rates = {kind: rate for kind, rate in FAULTS.items() if kind != "flip" or not link.startswith("slcan")}
    device = ramp_device(layout, seconds=None, fault_rates=rates, clock_ppm=50.0, jitter_s=1e-3, burst_s=0.016)
    path = tmp_path / "a.mcap"
    if link == "virtual:":
        summary = record(make_driver(VirtualConfig(1.0), device=device), path, 1.5)
    else:
        with Served(link, device, speed=1.0) as served:
            summary = record(make_driver(parse_link(served.url)), path, 1.5)
    log = read_log(path)
    assert_ramp(log)
    assert log.n_samples == summary.samples
    assert log.lost_samples == summary.lost_samples > 0
    assert summary.samples + summary.lost_samples == 1.5 * 25_600
    assert {g.reason for g in summary.gaps} <= {"sequence", "crc", "duplicate", "device_lost"}


class Plug:
    """A pty behind a name that stays, as udev gives a USB device: unplugged and plugged in again."""

    def __init__(self, name: Path) -> None:
        self.name = name
        self._served: Served | None = None

    def into(self, device: SimulatedDevice) -> None:
        self._served = Served("serial:pty", device, speed=1.0)
        self.name.symlink_to(self._served.url.removeprefix("serial:"))

    def out(self) -> None:
        assert self._served is not None
        self.name.unlink()
        self._served.stop.set()
        self._served.thread.join()


def test_unplugged_and_plugged_in_again(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    """The session goes on by itself; the log has a gap of reason reconnect or restart; the CPU does not spin."""
    plug = Plug(tmp_path / "port")
    plug.into(ramp_device("serial16", seconds=None))
    stop, seen = threading.Event(), Recorder()
    done: dict[str, RunSummary] = {}

    def session() -> None:
        driver = make_driver(parse_link(f"serial:{plug.name}"))
        done["summary"] = record(driver, tmp_path / "a.mcap", None, stop, seen)

    def samples() -> int:
        return sum(len(r.counts) for r in seen.delivered if isinstance(r, Block))

    thread = threading.Thread(target=session)
    thread.start()
    until(lambda: samples() > 10_000)
    plug.out()
    before = samples()
    time.sleep(0.3)  # the loss is noticed
    busy = least_share(time.process_time, time.sleep, 0.02)
    plug.into(ramp_device("serial16", seconds=None, epoch=2))
    back = time.monotonic()
    until(lambda: samples() > before + 10_000)
    took = time.monotonic() - back
    stop.set()
    thread.join(PATIENCE_S)
    plug.out()
    log, summary = read_log(tmp_path / "a.mcap"), done["summary"]
    row = "unplugged and plugged in again | a pty that is closed and made again | data within 5 s, a gap, no busy loop"
    record_property("reliability", f"{row} | {took:.1f} s; {100 * busy:.1f} % of a core meanwhile")
    within(took, 5.0)
    assert busy < 0.02
    assert_ramp(log, restarts=1)
    assert summary.stats.reconnects == 1
    assert {"reconnect", "restart"} & {g.reason for g in log.gaps}
    assert log.n_samples > 20_000
    assert any(n.level in ("warning", "error") for n in log.notices)


class SetClock(SystemClock):
    """The computer's, whose wall clock is set forwards by an hour at 0.8 s, and back by two days at 1.6 s."""

    JUMPS_S = ((0.8, 3600.0), (1.6, -2 * 86400.0))

    def __init__(self) -> None:
        self.begin_ns: int | None = None  # of the samples

    def wall_offset_ns(self) -> int:
        passed = 0.0 if self.begin_ns is None else (self.now_ns() - self.begin_ns) / 1e9
        return super().wall_offset_ns() + round(1e9 * sum(by for at, by in self.JUMPS_S if passed > at))


def test_the_clock_of_the_host_is_set_forwards_and_back(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """The place where the product reads time says other times; with a real clock: tests/guest/test_host.py."""
    clock, recorder, stop, path = SetClock(), Recorder(), threading.Event(), tmp_path / "a.mcap"
    device = ramp_device("serial16", seconds=None)

    class Begin(Recorder):
        def readings(self, batch: Sequence[Reading]) -> None:
            if clock.begin_ns is None and any(isinstance(r, Block) for r in batch):
                clock.begin_ns = clock.now_ns()

    def notify(notice: Notice) -> None:
        recorder.readings([notice])
        if notice.code == "wall_clock_set" and "-17" in notice.text:
            stop.set()

    with Served("serial:pty", device, speed=1.0) as served:
        summary = acquire_from(
            RIG, make_driver(parse_link(served.url)), [LogWriter(path, clock=clock), Begin()], PATIENCE_S, stop,
            make=MomentEstimator, clock=clock, notify=notify,
        )  # fmt: skip
    log = read_log(path)
    assert_ramp(log)
    times = [r.t_host_ns for r in log.readings(joined=False) if isinstance(r, Block)]
    assert times == sorted(times)
    span_s = (times[-1] - times[0]) / 1e9
    assert span_s == pytest.approx(log.seconds, abs=1.0)
    moved = [r.text for r in recorder.delivered if isinstance(r, Notice) and r.code == "wall_clock_set"]
    assert ["+36" in moved[0], "-17" in moved[-1]] == [True, True]
    assert log.started is not None
    assert abs(log.started.timestamp() - time.time()) < PATIENCE_S + span_s
    how = "forwards by an hour, then back by two days, in a session on a pty"
    row = f"clock of the computer is set | {how} | told, no index and no time of the log jumps"
    record_property("reliability", f"{row} | {summary.lost_samples} lost; {log.seconds:.1f} s of samples, in place")


@pytest.mark.slow
def test_the_clock_in_the_log_holds_the_truth(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    """50 ppm, bursts of 16 ms, a busy host: the stated bound holds the simulated device's true time."""
    device = ramp_device("serial16", seconds=None, clock_ppm=50.0, jitter_s=1e-3, burst_s=0.016)
    busy = threading.Event()

    def spin() -> None:
        while not busy.is_set():
            sum(range(1000))

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        begin_ns = time.monotonic_ns()
        with Served("serial:pty", device, speed=1.0) as served:
            ready_ns = time.monotonic_ns()
            record(make_driver(parse_link(served.url)), tmp_path / "a.mcap", 4.5)
    finally:
        busy.set()
        thread.join()
    log = read_log(tmp_path / "a.mcap")
    clock = log.clock
    assert clock is not None
    row = "clock, whole path | device at +50 ppm, bursts of 16 ms, a spinning thread | the bound in the log is true"
    record_property("reliability", f"{row} | bound {clock.bound_ns / 1e6:.1f} ms")
    # sample i of the device is taken i / (rate * (1 + 50 ppm)) after its start, which lies in [begin, ready]; which
    # of the device's samples the log begins with, its own time says
    block = next(r for r in log.readings() if isinstance(r, Block))
    assert block.t_device_ns is not None
    ahead = round(block.t_device_ns * 25_600e-9) - block.index
    for index in (log.stop - 25_600, log.stop):
        stated = clock.offset_ns + index * 1e9 / clock.rate_hz
        truth = (index + ahead) * 1e9 / (25_600.0 * (1 + 50e-6))
        assert begin_ns + truth - clock.bound_ns <= stated <= ready_ns + truth + clock.bound_ns
