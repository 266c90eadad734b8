"""The driver seam (drivers/reading.py): one suite that every driver passes. A new driver needs a line in DRIVERS."""

from __future__ import annotations

import contextlib
import copy
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import can
import numpy as np
import pytest
from promises import PATIENCE_S, within
from ramp_device import Record, Served, ramp_device
from sessions import make_block, write_log

from daq.log.reader import read_log
from daq.session.replay import ReplayDriver
from drivers.can.slcan_codec import encode_line
from drivers.contract.link_config import CanConfig, CaptureConfig, SerialConfig, SlcanConfig, VirtualConfig
from drivers.contract.reading import Driver, LinkStats
from drivers.links import links
from drivers.links.links import make_driver, parse_link

Make = Callable[[], AbstractContextManager[Driver]]


@contextmanager
def served(link: str, layout: str) -> Iterator[Driver]:
    device = ramp_device(layout, 8000.0 if layout == "classic" else 25_600.0, fault_rates={"drop": 0.02})
    with Served(link, device) as one:
        yield make_driver(parse_link(one.url))


@contextmanager
def garbage(link: str) -> Iterator[Driver]:
    """Somebody who talks nonsense, in between a few good frames."""
    listener = socket.create_server(("127.0.0.1", 0))

    def talk() -> None:
        try:
            client, _ = listener.accept()
        except OSError:
            return
        rng = np.random.default_rng(7)
        with client, contextlib.suppress(OSError):  # the driver may leave first
            for _ in range(60):
                client.sendall(rng.bytes(4000))
                client.sendall(b"\0" * 50 + b"\r\x07\rt123\r" + encode_line(0x300, rng.bytes(64), True))

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield make_driver(parse_link(f"{link}:socket://127.0.0.1:{listener.getsockname()[1]}"))
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join()


@contextmanager
def virtual() -> Iterator[Driver]:
    device = ramp_device("fd16", fault_rates={"drop": 0.02, "duplicate": 0.02, "stuck": 0.01})
    yield make_driver(VirtualConfig(None), device=device)


@contextmanager
def can_bus() -> Iterator[Driver]:
    channel = f"contract-{os.urandom(4).hex()}"
    stop = threading.Event()

    def talk() -> None:
        rng = np.random.default_rng(7)
        with can.Bus(channel, interface="virtual") as bus:
            while not stop.wait(0.005):
                for frame in ramp_device("fd16").next(20):
                    number = frame.identifier
                    bus.send(can.Message(arbitration_id=number, data=frame.data, is_extended_id=False, is_fd=True))
                nonsense = rng.bytes(int(rng.integers(64)))
                bus.send(can.Message(arbitration_id=int(rng.integers(0x2FF, 0x309)), data=nonsense,
                                     is_extended_id=False, is_fd=True))  # fmt: skip

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield make_driver(CanConfig("virtual", channel))
    finally:
        stop.set()
        thread.join()


@contextmanager
def capture() -> Iterator[Driver]:
    data = Path(__file__).parents[1] / "data" / "canedge_imu"
    signals = {"x": "gnss_imu.AccelerationX"}
    yield make_driver(CaptureConfig(str(data / "canedge_imu.log")), dbc=(data / "canmod-gps.dbc").read_bytes(),
                      signals=signals)  # fmt: skip


@contextmanager
def replay() -> Iterator[Driver]:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        write_log(path, [make_block(256 * k, 256) for k in range(50)])
        yield ReplayDriver(read_log(path), 1.0)


DRIVERS: dict[str, Make] = {
    "virtual": virtual,
    "can": can_bus,
    "serial": lambda: served("serial:pty", "serial16"),
    "serial socket": lambda: served("serial:socket://127.0.0.1:0", "serial24"),
    "serial garbage": lambda: garbage("serial"),
    "slcan": lambda: served("slcan:pty", "fd16"),
    "slcan classic": lambda: served("slcan:socket://127.0.0.1:0", "classic"),
    "slcan garbage": lambda: garbage("slcan"),
    "capture": capture,
    "replay": replay,
}
FINITE = {"virtual", "capture", "replay"}


@pytest.fixture(params=DRIVERS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def driver(name: str) -> Iterator[Driver]:
    with DRIVERS[name]() as made:
        yield made
        made.close()


def read_for(driver: Driver, record: Record, seconds: float) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until and not driver.exhausted:
        record.take(driver.read(0.1))


def totals(stats: LinkStats) -> list[int]:
    names = ("frames", "bytes", "crc_errors", "resyncs", "reconnects", "restarts", "duplicates", "lost_samples")
    return [getattr(stats, each) for each in names] + [stats.other[key] for key in sorted(stats.other)]


def test_every_kind_of_link_is_in_this_suite(name: str) -> None:
    assert {each.split()[0] for each in DRIVERS} == set(links.LINK_FORMS)


def test_each_index_is_in_one_block_or_gap_and_stats_only_grow(name: str, driver: Driver) -> None:
    assert driver.kind == name.split()[0]
    driver.open()
    record, before = Record(ramp=False), totals(driver.stats)
    heard, begun = "garbage" in name, time.monotonic()
    while not driver.exhausted and time.monotonic() - begun < (1.0 if heard else PATIENCE_S):
        readings = driver.read(0.1)
        record.take(readings)  # checks the axis
        heard = heard or bool(record.samples and record.infos)
        other = copy.deepcopy(driver.stats)
        other.other = {}
        now = totals(other)
        assert all(b >= a for a, b in zip(before, now, strict=False))
        before = now
    if "garbage" not in name:
        assert record.samples > 0
        assert record.infos
    if driver.kind != "replay":
        assert sum(gap.count for gap in record.gaps) == driver.stats.lost_samples
    driver.close()


def test_construction_does_nothing_and_close_is_idempotent(driver: Driver) -> None:
    driver.close()
    driver.open()
    driver.open()
    driver.close()
    driver.close()


def test_read_before_open_and_after_close_is_empty(driver: Driver) -> None:
    assert driver.read(0.0) == []
    driver.open()
    record = Record(ramp=False)
    read_for(driver, record, 0.2)
    driver.close()
    started = time.monotonic()
    record.take(driver.read(0.0))  # what was held
    assert driver.read(0.0) == []
    assert driver.read(30.0) == []
    within(time.monotonic() - started, 1.0)


def test_close_wakes_a_read(driver: Driver) -> None:
    driver.open()
    stop, ended = threading.Event(), threading.Event()

    def read() -> None:
        while not stop.is_set():
            driver.read(30.0)
        ended.set()

    thread = threading.Thread(target=read)
    thread.start()
    time.sleep(0.1)
    stop.set()
    driver.close()
    asked = time.monotonic()
    assert ended.wait(PATIENCE_S)
    within(time.monotonic() - asked, 1.0)
    thread.join()


def test_timeout_is_kept(driver: Driver) -> None:
    driver.open()
    for _ in range(5):
        started = time.monotonic()
        driver.read(0.05)
        within(time.monotonic() - started, 1.0)
    driver.close()


def test_exhausted(name: str, driver: Driver) -> None:
    driver.open()
    record = Record(ramp=False)
    read_for(driver, record, 10.0 if name in FINITE else 0.3)
    assert driver.exhausted == (name in FINITE)
    if name in FINITE:
        assert driver.read(0.1) == []
    driver.close()


def test_other_configurations_are_constructed_without_io() -> None:
    for config in (SerialConfig("/nonexistent"), SlcanConfig("/nonexistent"), CanConfig("socketcan", "nonexistent0"),
                   CaptureConfig("/nonexistent.log")):  # fmt: skip
        driver = make_driver(config)
        assert not driver.exhausted
        driver.close()
