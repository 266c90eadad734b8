"""Cables pulled for real: ptys, TCP, RFC 2217. Back within 5 s, one gap, no busy loop, never an exception."""

from __future__ import annotations

import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import serial
import serial.rfc2217
from promises import PATIENCE_S, least_share, within
from ramp_device import Record, Served, ramp_device, read_for, read_until

from drivers.can.slcan_codec import encode_line
from drivers.contract.errors import LinkOpenError
from drivers.contract.link_config import SerialConfig, SlcanConfig
from drivers.contract.reading import Driver
from drivers.links.links import make_driver, parse_link
from drivers.serial import cobs
from drivers.simulated.simulated import SimulatedDevice


class Cable:
    """A pty behind a fixed name (as udev gives a USB port), which can be pulled and plugged in again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master = -1
        self.plug()

    def plug(self) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self._slave = slave
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(slave))

    def send(self, data: bytes) -> None:
        while data:
            data = data[os.write(self._master, data) :]

    def pull(self) -> None:
        os.close(self._master)
        os.close(self._slave)
        self.path.unlink()


@pytest.fixture
def cable(tmp_path: Path) -> Iterator[Cable]:
    cable = Cable(tmp_path / "ttyUSB")
    yield cable
    if cable.path.is_symlink():
        cable.pull()


def wire(device: SimulatedDevice, frames: int, slcan: bool = False) -> bytes:
    if slcan:
        return b"".join(encode_line(f.identifier, f.data, fd=True) for f in device.next(frames))
    return b"".join(cobs.encode(f.data) for f in device.next(frames))


@pytest.mark.parametrize("slcan", [False, True])
def test_pulled_and_plugged_in_again(cable: Cable, slcan: bool) -> None:
    device = ramp_device("fd16" if slcan else "serial16", seconds=None)
    rows = device.config.frame_rows
    config = SlcanConfig(str(cable.path)) if slcan else SerialConfig(str(cable.path))
    driver = make_driver(config)
    driver.open()
    cable.send(wire(device, 20, slcan)[:-30])  # the last frame is torn
    record = read_until(driver, Record(), lambda r: r.samples >= 19 * rows)
    cable.pull()
    read_until(driver, record, lambda r: "link_lost" in r.codes())
    assert least_share(time.thread_time, lambda seconds: read_for(driver, record, seconds), 0.02) < 0.02
    device.next(100)
    cable.plug()
    back = time.monotonic()
    read_until(driver, record, lambda r: "link_back" in r.codes())
    within(time.monotonic() - back, 5.0)
    cable.send(wire(device, 20, slcan))
    read_until(driver, record, lambda r: r.samples >= 39 * rows)
    driver.close()
    assert [(gap.count, gap.reason) for gap in record.gaps] == [(101 * rows, "reconnect")]
    assert record.offset == 0
    assert driver.stats.reconnects == 1


@pytest.mark.slow
def test_what_stays_away_is_said_with_the_reason_once_each(cable: Cable) -> None:
    """Under another name, or its name taken by something else: "trying again" alone would be said for ever."""
    driver = make_driver(SerialConfig(str(cable.path)))
    driver.open()
    cable.send(wire(ramp_device("serial16", seconds=None), 20))
    record = read_until(driver, Record(), lambda r: r.samples >= 20 * 64)
    cable.pull()
    read_until(driver, record, lambda r: "link_missing" in r.codes())
    cable.path.write_text("no port")
    read_until(driver, record, lambda r: len([n for n in r.notices if n.code == "link_missing"]) == 2)
    read_for(driver, record, 2.0)
    cable.path.unlink()
    cable.plug()
    read_until(driver, record, lambda r: "link_back" in r.codes())
    driver.close()
    missing, other = (n.text for n in record.notices if n.code == "link_missing")
    assert missing.endswith("No such file or directory: check the name with `rotorscope ports`; it is tried again")
    assert "is no serial port" in other


def test_device_restarted_while_away_is_one_restart_gap(cable: Cable) -> None:
    driver = make_driver(SerialConfig(str(cable.path)))
    driver.open()
    cable.send(wire(ramp_device("serial16", seconds=None), 20))
    record = read_until(driver, Record(), lambda r: r.samples >= 20 * 64)
    cable.pull()
    read_until(driver, record, lambda r: "link_lost" in r.codes())
    again = ramp_device("serial16", seconds=None)
    again._epoch = 2
    cable.plug()
    read_until(driver, record, lambda r: "link_back" in r.codes())
    cable.send(wire(again, 20))
    read_until(driver, record, lambda r: r.samples >= 40 * 64)
    driver.close()
    assert [gap.reason for gap in record.gaps] == ["restart"]
    assert 0.05 * 25_600 < record.gaps[0].count < 5 * 25_600


def test_tcp_device_goes_and_returns() -> None:
    device = ramp_device("serial16", seconds=None)
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    driver = make_driver(parse_link(f"serial:socket://127.0.0.1:{port}"))
    driver.open()
    client, _ = listener.accept()
    client.sendall(wire(device, 10))
    record = read_until(driver, Record(), lambda r: r.samples >= 640)
    client.close()
    listener.close()
    read_until(driver, record, lambda r: "link_lost" in r.codes())
    device.next(5)
    time.sleep(0.5)
    listener = socket.create_server(("127.0.0.1", port))
    listener.settimeout(PATIENCE_S)
    accepted: list[socket.socket] = []
    thread = threading.Thread(target=lambda: accepted.append(listener.accept()[0]))
    thread.start()
    read_until(driver, record, lambda r: "link_back" in r.codes())
    thread.join()
    accepted[0].sendall(wire(device, 10))
    read_until(driver, record, lambda r: r.samples >= 1280)
    driver.close()
    accepted[0].close()
    listener.close()
    assert [(gap.count, gap.reason) for gap in record.gaps] == [(320, "reconnect")]


def test_hung_up_with_data_still_unread(cable: Cable) -> None:
    """What came before the hang-up is delivered before the loss is reported."""
    device = ramp_device("serial16", seconds=None)
    listener = socket.create_server(("127.0.0.1", 0))
    driver = make_driver(parse_link(f"serial:socket://127.0.0.1:{listener.getsockname()[1]}"))
    driver.open()
    client, _ = listener.accept()
    client.sendall(wire(device, 200))
    client.close()
    listener.close()
    record = read_until(driver, Record(), lambda r: "link_lost" in r.codes())
    driver.close()
    assert record.samples == 200 * 64


class Rfc2217Server:
    """pyserial's own server side, in front of a loop:// port: what is written to it comes out of the network."""

    def __init__(self) -> None:
        self.port = serial.serial_for_url("loop://", timeout=0.05)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.number = self._listener.getsockname()[1]
        self._stop = False
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def write(self, data: bytes) -> None:
        self._connection.sendall(data)

    def _serve(self) -> None:
        self._connection, _ = self._listener.accept()
        self._connection.settimeout(0.01)
        manager = serial.rfc2217.PortManager(self.port, self)
        while not self._stop:
            data = self.port.read(self.port.in_waiting)
            if data:
                self.write(b"".join(manager.escape(data)))
            try:
                received = self._connection.recv(1024)
            except TimeoutError:
                continue
            if not received:
                break
            list(manager.filter(received))

    def close(self) -> None:
        self._stop = True
        self._thread.join()
        self._connection.close()
        self._listener.close()
        self.port.close()


def test_rfc2217_url() -> None:
    server = Rfc2217Server()
    device = ramp_device("serial16", seconds=None)
    driver = make_driver(parse_link(f"serial:rfc2217://127.0.0.1:{server.number}?baud=115200"))
    driver.open()
    for _ in range(5):
        server.port.write(wire(device, 4))
        time.sleep(0.05)
    record = read_until(driver, Record(), lambda r: r.samples >= 20 * 64)
    assert not record.gaps
    driver.close()
    server.close()


def test_close_wakes_a_blocked_read(cable: Cable) -> None:
    driver = make_driver(SerialConfig(str(cable.path)))
    driver.open()
    ended: list[float] = []
    thread = threading.Thread(target=lambda: (driver.read(30.0), ended.append(time.monotonic())))
    thread.start()
    time.sleep(0.3)
    closed = time.monotonic()
    driver.close()
    thread.join(PATIENCE_S)
    assert ended
    within(ended[0] - closed, 0.25)


def test_silent_device_is_reported_once_and_costs_nothing(cable: Cable) -> None:
    device = ramp_device("serial16", seconds=None)
    driver = make_driver(SerialConfig(str(cable.path)))
    driver.open()
    cable.send(wire(device, 5))
    record = read_until(driver, Record(), lambda r: r.samples >= 320)
    share = least_share(time.thread_time, lambda seconds: read_for(driver, record, seconds), 0.02, window_s=1.5)
    assert share < 0.02
    assert [notice.code for notice in record.notices] == ["silent"]
    device.next(3)
    cable.send(wire(device, 5))
    read_until(driver, record, lambda r: r.samples >= 640)
    driver.close()
    assert [(gap.count, gap.reason) for gap in record.gaps] == [(192, "silent")]


def test_garbage_on_the_line_then_frames(cable: Cable) -> None:
    rng = np.random.default_rng(3)
    device = ramp_device("serial16", seconds=None)
    driver = make_driver(SerialConfig(str(cable.path)))
    driver.open()
    record = Record()
    for _ in range(20):
        cable.send(rng.bytes(1500))
        record.take(driver.read(0.05))
    cable.send(b"\0" + wire(device, 10))
    read_until(driver, record, lambda r: r.samples >= 640)
    assert driver.stats.crc_errors > 0
    driver.close()


def test_what_cannot_be_opened_is_said(tmp_path: Path) -> None:
    for link, text in [
        (f"serial:{tmp_path}/none", "rotorscope ports"),
        ("serial:socket://127.0.0.1:1", "listens"),
        ("slcan:socket://127.0.0.1", "HOST:PORT"),
        ("serial:rfc2217://127.0.0.1:1", "listens"),
        (f"serial:{__file__}", "is no serial port"),
    ]:
        with pytest.raises(LinkOpenError, match=text) as caught:
            make_driver(parse_link(link)).open()
        assert "\n" not in str(caught.value)


def test_a_port_held_by_another_is_said(cable: Cable) -> None:
    first, second = (make_driver(SerialConfig(str(cable.path))) for _ in range(2))
    first.open()
    with pytest.raises(LinkOpenError, match="another program holds"):
        second.open()
    first.close()


def test_slcan_refuses_a_bitrate_it_has_not() -> None:
    with pytest.raises(LinkOpenError, match="no bitrate 123"):
        make_driver(parse_link("slcan:/dev/null?bitrate=123"))
    with pytest.raises(LinkOpenError, match="no data_bitrate 7"):
        make_driver(parse_link("slcan:/dev/null?data_bitrate=7"))


def test_slcan_adapter_that_refuses_is_reported(cable: Cable) -> None:
    driver = make_driver(SlcanConfig(str(cable.path)))
    driver.open()
    cable.send(b"\r\x07\r")
    read_until(driver, Record(), lambda r: "adapter_refused" in r.codes())
    driver.close()


def test_reader_of_a_served_device_leaves_and_returns() -> None:
    device = ramp_device("serial16", seconds=None)
    with Served("serial:pty", device, speed=1.0) as served:
        first = served.driver()
        read_until(first, Record(), lambda r: r.samples > 0)
        first.close()
        again = served.driver()
        record = read_until(again, Record(), lambda r: r.samples > 6400)
        again.close()
    assert not [gap for gap in record.gaps if gap.reason != "device_lost"]


def test_each_reader_of_a_served_socket_has_every_frame(record_property: Callable[[str, object], None]) -> None:
    """One that reads nothing, and one that leaves, disturb no other."""
    device = ramp_device("serial16", seconds=None)
    with Served("serial:socket://127.0.0.1:0", device, speed=1.0) as served:
        host, _, port = served.url.removeprefix("serial:socket://").partition(":")
        drivers: list[Driver] = [served.driver() for _ in range(3)]
        with socket.create_connection((host, int(port))), socket.create_connection((host, int(port))) as leaver:
            leaver.close()
            records = [Record() for _ in drivers]
            for driver, record in zip(drivers, records, strict=True):
                read_until(driver, record, lambda r: r.samples > 12_800)
            late = served.driver()
            read_until(late, Record(), lambda r: r.samples > 1280)
        for driver in (*drivers, late):
            driver.close()
    lost = [sum(gap.count for gap in r.gaps if gap.reason != "device_lost") for r in records]
    row = "several readers of `simulate --serve serial:socket://` | 3 that read, 1 that does not, 1 that leaves, 1 late"
    record_property("reliability", f"{row} | each has every frame | {lost} of 12800 samples lost")
    assert lost == [0, 0, 0]


def test_five_devices_at_once() -> None:
    devices = [ramp_device("serial16", seconds=None, serial_number=k) for k in range(5)]
    served = [Served("serial:pty", device, speed=1.0) for device in devices]
    drivers: list[Driver] = [one.driver() for one in served]
    records = [Record() for _ in drivers]
    until = time.monotonic() + PATIENCE_S
    while any(record.samples < 1280 for record in records) and time.monotonic() < until:
        for driver, record in zip(drivers, records, strict=True):
            record.take(driver.read(0.01))
    for k, (driver, one, record) in enumerate(zip(drivers, served, records, strict=True)):
        driver.close()
        one.__exit__()
        assert record.infos[0].serial_number == f"{k:08X}"
