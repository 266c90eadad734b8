"""python-can's buses and their traps: real ones (virtual, socketcand over TCP), nothing replaced."""

from __future__ import annotations

import os
import pty
import socket
import struct
import subprocess
import sys
import threading
import time
import tty
import uuid
from collections.abc import Iterator

import can
import numpy as np
import pytest
from promises import PATIENCE_S, least_share, until, within
from ramp_device import Record, ramp_device, read_for, read_until

from drivers.can.can_bus import BusSource
from drivers.can.can_errors import describe_error
from drivers.can.can_frames import EXTENDED_FLAG, CanFrames
from drivers.can.slcan_codec import encode_line
from drivers.can.socketcan import BulkReceiver
from drivers.contract.errors import LinkError, LinkOpenError
from drivers.contract.link import LinkLost
from drivers.contract.link_config import CanConfig, VirtualConfig
from drivers.contract.reading import Driver
from drivers.links.links import make_driver, parse_link
from drivers.simulated.simulated import WireFrame


class Socketcand:
    """A socketcand server: says hello, opens, and sends a device's frames as text, 64-byte ones included."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._clients: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            try:
                client.sendall(b"< hi >")
                for _ in range(2):  # open, rawmode
                    if not client.recv(200):
                        raise ConnectionError
                    client.sendall(b"< ok >")
            except OSError:
                client.close()
                continue
            self._clients.append(client)

    def send(self, frames: list[WireFrame]) -> None:
        until(lambda: self._clients)
        text = "".join(f"< frame {f.identifier:03X} {f.due_s:.6f} {f.data.hex()} >" for f in frames)
        self._clients[-1].sendall(text.encode())

    def hang_up(self) -> None:
        for client in self._clients:
            client.close()
        self._clients = []

    def close(self) -> None:
        self.hang_up()
        if self._thread.is_alive():
            self._listener.shutdown(socket.SHUT_RDWR)  # closing alone leaves it listening while accept() waits
        self._listener.close()
        self._thread.join(5)


@pytest.fixture
def server() -> Iterator[Socketcand]:
    server = Socketcand()
    yield server
    server.close()


def socketcand_driver(server: Socketcand) -> Driver:
    return make_driver(parse_link(f"can:socketcand:can0?host=127.0.0.1&port={server.port}"))


def test_socketcand_64_byte_frames_are_read_though_is_fd_is_false(server: Socketcand) -> None:
    driver = socketcand_driver(server)
    driver.open()
    server.send(ramp_device("fd16").next(40))
    record = read_until(driver, Record(), lambda r: r.samples >= 280)
    driver.close()
    assert not record.gaps


def test_socketcand_server_closes_and_returns(server: Socketcand) -> None:
    """python-can would spin in recv() for ever, and for 10 s in its constructor when nobody listens."""
    device = ramp_device("fd16", seconds=None)
    driver = socketcand_driver(server)
    driver.open()
    server.send(device.next(40))
    record = read_until(driver, Record(), lambda r: r.samples >= 280)
    server.hang_up()
    read_until(driver, record, lambda r: {"link_lost", "link_back"} <= r.codes())
    device.next(100)
    server.send(device.next(40))
    read_until(driver, record, lambda r: r.samples >= 560)
    driver.close()
    assert record.lost("reconnect") == 700
    assert record.offset == 0
    assert driver.stats.reconnects == 1


def test_socketcand_gone_for_good_costs_nothing(server: Socketcand) -> None:
    driver = socketcand_driver(server)
    driver.open()
    server.send(ramp_device("fd16").next(10))
    record = read_until(driver, Record(), lambda r: r.samples >= 70)
    server.close()
    read_until(driver, record, lambda r: "link_lost" in r.codes())
    assert least_share(time.thread_time, lambda seconds: read_for(driver, record, seconds), 0.02) < 0.02
    driver.close()


def test_socketcand_nobody_listens_is_reported_at_once() -> None:
    driver = make_driver(parse_link("can:socketcand:can0?host=127.0.0.1&port=1"))
    started = time.monotonic()
    with pytest.raises(LinkOpenError, match="start socketcand"):
        driver.open()
    within(time.monotonic() - started, 3.0)


def test_virtual_queue_full_never_blocks_the_device() -> None:
    """python-can says "drops oldest" and blocks. The device counts what it cannot send, and says so."""
    device = ramp_device("fd16", seconds=None, rate_hz=200_000.0)
    driver = make_driver(VirtualConfig(1.0), device=device)
    driver.open()
    record = read_until(driver, Record(), lambda r: r.samples > 0)
    started = device.samples_made
    until(lambda: device.samples_made > started + 120_000)  # the reader stalls; 4096 frames are 28,000 samples
    started = device.samples_made
    time.sleep(0.2)
    assert device.samples_made > started
    read_until(driver, record, lambda r: r.lost("device_lost") > 0)
    driver.close()
    assert {gap.reason for gap in record.gaps} <= {"device_lost", "sequence"}
    assert record.offset == 0


def test_error_frames_become_notices() -> None:
    channel = str(uuid.uuid4())
    driver = make_driver(CanConfig("virtual", channel))
    driver.open()
    device = ramp_device("fd16", seconds=None)
    sender = can.Bus(channel, interface="virtual")

    def send(frames: list[WireFrame]) -> None:
        for frame in frames:
            sender.send(can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=False, is_fd=True))

    send(device.next(10))
    record = read_until(driver, Record(), lambda r: r.samples >= 70)
    for identifier, data in [(0x40, b""), (0x100, b""), (0x04, b"\0\x20"), (0x04, b"\0\x01"), (0x88, b""), (0x20, b"")]:
        sender.send(can.Message(arbitration_id=identifier, data=data.ljust(8, b"\0"), is_error_frame=True))
    device.next(5)
    send(device.next(10))
    read_until(driver, record, lambda r: r.samples >= 140)
    driver.close()
    sender.shutdown()
    want = {"bus_off", "bus_restarted", "error_passive", "controller_overflow", "bus_error", "no_ack"}
    assert record.codes() == want
    assert record.lost("reconnect") == 35


def test_every_error_bit_is_survived() -> None:
    for identifier in range(0x200):
        for state in (0, 1, 0x0C, 0x30, 0x40, 0xFF):
            for event in describe_error(identifier, bytes((0, state))):
                assert "\n" not in event.text
        assert isinstance(describe_error(identifier, b""), list)


def test_wrong_interface_and_wrong_channel_are_said() -> None:
    with pytest.raises(LinkOpenError, match="no interface 'socketcann'"):
        make_driver(parse_link("can:socketcann:can0")).open()
    with pytest.raises(LinkOpenError, match="socketcan:nonesuch0"):
        make_driver(parse_link("can:socketcan:nonesuch0")).open()
    with pytest.raises(LinkOpenError, match="host"):
        make_driver(parse_link("can:socketcand:can0")).open()


def test_interfaces_whose_library_is_missing_are_said_in_one_line() -> None:
    """Some of python-can's raise NameError. udp_multicast, which loses frames silently, needs a library of its own."""
    for interface in ("kvaser", "pcan", "vector", "nican", "ixxat", "usb2can", "neovi", "udp_multicast"):
        with pytest.raises(LinkError, match=f"can:{interface}:0") as caught:
            make_driver(parse_link(f"can:{interface}:0")).open()
        assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_makers_library_that_is_not_there_is_said_in_one_line() -> None:
    """python-can says more through a logger, which a program that has none prints."""
    opens = """
from drivers.links.links import LinkError, make_driver, parse_link
try:
    make_driver(parse_link("can:{}:0")).open()
except LinkError as error:
    print(error)
"""
    for interface, text in {"pcan": "library not found: check", "kvaser": "manufacturer is not installed"}.items():
        command = [sys.executable, "-c", opens.format(interface)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
        assert text in done.stdout
        assert done.stderr == ""


def test_python_cans_serial_interface_is_refused() -> None:
    """It has no check sum: after one lost byte 1 of 20 frames survived."""
    with pytest.raises(LinkOpenError, match="use serial: with protocol v1"):
        make_driver(parse_link("can:serial:/dev/ttyUSB0")).open()


def test_python_cans_slcan_as_a_bus_survives_what_kills_its_notifier() -> None:
    """Bad hex raises ValueError in recv(); a line a byte short arrives as dlc 8 with 7 bytes."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    device = ramp_device("fd16", seconds=None)
    driver = make_driver(parse_link(f"can:slcan:{os.ttyname(slave)}?option.sleep_after_open=0"))
    driver.open()
    good = [encode_line(f.identifier, f.data, fd=True) for f in device.next(3)]
    os.write(master, b"".join(good))
    record = read_until(driver, Record(), lambda r: r.samples >= 21)
    os.write(master, b"t3008112233445566778G\r")
    read_until(driver, record, lambda r: {"link_lost", "link_back"} <= r.codes())
    lines = [encode_line(f.identifier, f.data, fd=True) for f in device.next(3)]
    os.write(master, lines[0] + lines[1][:-3] + b"\r" + lines[2])
    read_until(driver, record, lambda r: r.samples >= 35)
    driver.close()
    os.close(master)
    os.close(slave)
    assert record.offset == 0
    assert [(gap.count, gap.reason) for gap in record.gaps] == [(7, "crc")]


def test_other_frames_on_the_bus_are_passed_over() -> None:
    source = ramp_device("fd16").next(20)
    decoder_frames = [(f.identifier, f.data, 0) for f in source]
    noise = [(0x123, bytes(8), 0), (0x300 | EXTENDED_FLAG, bytes(64), 0), (0x7FF, b"", 0)]
    mixed = [frame for pair in zip(decoder_frames, noise * 10, strict=False) for frame in pair]
    driver = make_driver(CanConfig("virtual", "unused"))
    record = Record()
    record.take(driver._decoder.feed(CanFrames.build(mixed), 1))  # type: ignore[attr-defined]
    assert record.samples == 7 * 20
    assert driver.stats.other["other_frames"] == 24


def test_a_second_device_on_the_bus() -> None:
    channel = str(uuid.uuid4())
    drivers = [make_driver(parse_link(f"can:virtual:{channel}?id={base}")) for base in ("0x300", "0x308")]
    for driver in drivers:
        driver.open()
    sender = can.Bus(channel, interface="virtual")
    for k, base in enumerate((0x300, 0x308)):
        for frame in ramp_device("fd16", base_id=base, serial_number=k).next(20):
            sender.send(can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=False, is_fd=True))
    for k, driver in enumerate(drivers):
        record = read_until(driver, Record(), lambda r: r.samples >= 140)
        assert record.infos[0].serial_number == f"{k:08X}"
        driver.close()
    sender.shutdown()


class TestBulkReceiver:
    """recvmmsg works on any datagram socket: here on a Unix pair, on real CAN in tests/guest."""

    def pair(self, kind: int = socket.SOCK_DGRAM) -> tuple[socket.socket, socket.socket, BulkReceiver]:
        ours, theirs = socket.socketpair(socket.AF_UNIX, kind)
        return theirs, ours, BulkReceiver(ours)

    def test_frames_of_both_kinds_and_the_kernels_fd_flag(self) -> None:
        theirs, ours, receiver = self.pair()
        fd = struct.pack("=IBBxx64s", 0x300, 64, 0x05, bytes(range(64)))  # BRS, and CANFD_FDF as Linux 6 adds it
        classic = struct.pack("=IB3x8s", EXTENDED_FLAG | 0x123, 3, b"\1\2\3")
        for frame in (fd, classic, fd):
            theirs.send(frame)
        frames = receiver.receive(1.0)
        assert frames is not None
        assert frames.ids.tolist() == [0x300, EXTENDED_FLAG | 0x123, 0x300]
        assert frames.lengths.tolist() == [64, 3, 64]
        assert frames.payload[0].tobytes() == bytes(range(64))
        assert frames.payload[1].tobytes() == b"\1\2\3".ljust(64, b"\0")
        theirs.send(classic)  # into a slot that held a longer frame
        frames = receiver.receive(1.0)
        assert frames is not None
        assert frames.payload[0, 3:].sum() == 0
        ours.close()
        theirs.close()

    def test_nothing_and_closed(self) -> None:
        theirs, ours, receiver = self.pair(socket.SOCK_SEQPACKET)
        assert receiver.receive(0.01) is None
        theirs.shutdown(socket.SHUT_RDWR)
        with pytest.raises(LinkLost):
            receiver.receive(0.1)
        theirs.close()
        ours.close()

    def test_impossible_lengths_are_bounded(self) -> None:
        theirs, ours, receiver = self.pair()
        theirs.send(struct.pack("=IBBxx64s", 1, 255, 0, bytes(64)))
        theirs.send(b"abc")
        frames = receiver.receive(1.0)
        assert frames is not None
        assert frames.lengths.tolist() == [64]
        theirs.close()
        ours.close()


def test_spinning_interface_is_taken_for_dead() -> None:
    class Spins:
        """Behaves as python-can's socketcand does after the server closed."""

        def recv(self, timeout: float) -> None:
            until = time.monotonic() + timeout
            while time.monotonic() < until:
                np.zeros(10).sum()

        def shutdown(self) -> None: ...

    source = BusSource(CanConfig("virtual", "x"), connect=lambda _: Spins())
    source.open()
    with pytest.raises(LinkLost, match="returns at once"):
        _receive_often(source)


def _receive_often(source: BusSource) -> None:
    end = time.monotonic() + PATIENCE_S  # on a busy machine it is not at once seen who spends the time
    while time.monotonic() < end:
        source.receive(0.05)
