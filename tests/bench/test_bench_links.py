"""What a frame costs on each link, beside python-can and cantools in the same run.

pytest -m bench tests/bench/test_bench_links.py -s
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from device_process import ROWS
from device_process import frames as serial_frames
from ramp_device import ramp_device

from drivers.can.can_decoder import CanDecoder
from drivers.can.can_frames import CanFrames
from drivers.can.slcan_codec import encode_line
from drivers.contract.link_config import SerialConfig, SlcanConfig
from drivers.contract.reading import Block, Gap, LinkStats
from drivers.links.links import make_driver
from drivers.protocol import protocol
from drivers.protocol.protocol_dbc import dbc_text
from drivers.serial import cobs

pytestmark = [pytest.mark.bench, pytest.mark.timeout(600)]
SENDER = """
import os, sys
data = open(sys.argv[1], "rb").read()
fd = int(sys.argv[2])
sys.stdin.readline()
view = memoryview(data)
while view:
    view = view[os.write(fd, view[:65536]):]
sys.stdin.readline()
"""


def best(work: Callable[[], object], times: int = 5) -> float:
    """Least CPU seconds of a few runs."""
    took = []
    for _ in range(times):
        started = time.thread_time()
        work()
        took.append(time.thread_time() - started)
    return min(took)


@contextmanager
def sender(data: bytes, folder: Path) -> Iterator[tuple[str, Callable[[], None]]]:
    """A process that writes `data` to a pty as fast as the reader takes it, once asked to."""
    master, slave = os.openpty()
    tty.setraw(slave)
    path = folder / "wire.bin"
    path.write_bytes(data)
    process = subprocess.Popen(
        [sys.executable, "-c", SENDER, str(path), str(master)], stdin=subprocess.PIPE, pass_fds=[master]
    )

    def go() -> None:
        assert process.stdin is not None
        process.stdin.write(b"\n")
        process.stdin.flush()

    try:
        yield os.ttyname(slave), go
    finally:
        process.kill()
        process.communicate()
        os.close(master)
        os.close(slave)


def slcan_wire(n: int) -> bytes:
    return b"".join(encode_line(f.identifier, f.data, fd=True) for f in ramp_device("fd16", seconds=None).next(n))


def test_slcan_receive(tmp_path: Path) -> None:
    n, n_theirs = 60_000, 3_000
    with sender(slcan_wire(n), tmp_path) as (port, go):
        driver = make_driver(SlcanConfig(port, setup=False))
        driver.open()
        go()
        samples, started = 0, None
        cpu = 0.0
        while samples < 7 * n:
            begin = time.thread_time()
            readings = driver.read(1.0)
            cpu += time.thread_time() - begin
            started = started or time.monotonic()
            assert readings, f"{samples} of {7 * n} samples came"
            samples += sum(len(r.counts) for r in readings if isinstance(r, Block))
            assert not any(isinstance(r, Gap) for r in readings)
        wall = time.monotonic() - started
        driver.close()
    ours = cpu / n
    with sender(slcan_wire(n_theirs), tmp_path) as (port, go):
        bus = can.Bus(port, interface="slcan", sleep_after_open=0)
        go()
        begin = time.thread_time()
        got = 0
        while got < n_theirs:
            message = bus.recv(1.0)
            assert message is not None
            got += 1
        theirs = (time.thread_time() - begin) / n_theirs
        bus.shutdown()
    print(
        f"\nslcan receive, 64-byte frames on a pty: ours {1e6 * ours:.2f} us of CPU per frame, to samples and gaps "
        f"({n / wall:.0f} frames/s); python-can {1e6 * theirs:.1f} us, to messages; ratio {theirs / ours:.0f}"
    )
    assert theirs / ours > 100


def test_can_fd_decode() -> None:
    n = 20_000
    device = ramp_device("fd16", seconds=None)
    frames = [(f.identifier, f.data, 0) for f in device.next(n) if f.identifier == protocol.BASE_ID]
    info = [(f.identifier, f.data, 0) for f in ramp_device("fd16", seconds=None).next(1)][:4]
    batch = CanFrames.build(frames)

    def ours() -> None:
        for start in range(0, len(batch), 256):
            protocol.unpack_fd16(batch.payload[start : start + 256], 4)

    def whole() -> None:
        decoder = CanDecoder(LinkStats())
        decoder.feed(CanFrames.build(info), 0)
        for start in range(0, len(batch), 256):
            decoder.feed(batch.pick(slice(start, start + 256)), start * 273_000)

    message = cantools.database.load_string(dbc_text()).get_message_by_name("fd16")
    some = [data for _, data, _ in frames[:500]]

    def theirs() -> None:
        for data in some:
            message.decode(data)

    def theirs_raw() -> None:
        for data in some:
            message.decode(data, scaling=False, decode_choices=False)

    ours_s, whole_s = best(ours) / len(batch), best(whole) / len(batch)
    theirs_s, raw_s = best(theirs) / len(some), best(theirs_raw) / len(some)
    print(
        f"\nCAN FD decode, 7 x 4 int16 a frame, batches of 256: ours {1e6 * ours_s:.3f} us per frame; "
        f"cantools {1e6 * theirs_s:.1f} us, {1e6 * raw_s:.1f} us unscaled; ratio {theirs_s / ours_s:.0f}, "
        f"{raw_s / ours_s:.0f} unscaled. With identifiers, versions, continuity and gaps: {1e6 * whole_s:.3f} us"
    )
    assert raw_s / ours_s > 50


def test_cobs_and_crc() -> None:
    info, frames = serial_frames(400_000.0, 4.0)
    wire = info + b"".join(frames)
    for chunk in (4096, 65_536):
        pieces = [wire[k : k + chunk] for k in range(0, len(wire), chunk)]

        def deframe(pieces: list[bytes] = pieces) -> None:
            deframer = cobs.Deframer()
            for piece in pieces:
                deframer.feed(piece)

        seconds = best(deframe)
        print(
            f"\nCOBS + CRC-32 in pieces of {chunk} B: {len(wire) / seconds / 1e6:.0f} MB/s, "
            f"{1e6 * seconds / len(frames):.2f} us per frame of {len(wire) / len(frames):.0f} B"
        )
    assert len(wire) / seconds > 100e6
    zeros = np.zeros((ROWS, 4), np.int32)
    body = protocol.pack_int24(zeros.reshape(1, -1)).tobytes()
    took = best(lambda: [cobs.encode(body) for _ in range(1000)]) / 1000
    print(f"encode, nothing but zeros: {1e6 * took:.2f} us per frame of {len(body)} B")


def test_serial_pty_ingest(tmp_path: Path) -> None:
    """As fast as the pty goes: rows of four channels per second, and the reader's share of a core."""
    info, frames = serial_frames(400_000.0, 6.0)
    rows = ROWS * len(frames)
    with sender(info + b"".join(frames), tmp_path) as (port, go):
        driver = make_driver(SerialConfig(port))
        driver.open()
        go()
        got, started, cpu = 0, None, 0.0
        while got < rows:
            begin = time.thread_time()
            readings = driver.read(1.0)
            cpu += time.thread_time() - begin
            started = started or time.monotonic()
            assert readings
            assert not any(isinstance(r, Gap) for r in readings)
            got += sum(len(r.counts) for r in readings if isinstance(r, Block))
        wall = time.monotonic() - started
        driver.close()
    print(
        f"\nserial pty, 4 channels int16, 64 rows a frame: {rows / wall / 1e3:.0f} k rows/s "
        f"({4 * rows / wall / 1e3:.0f} k values/s) without a gap; reader's CPU {1e6 * cpu / rows:.3f} us per row, "
        f"{100 * cpu / rows * 400e3:.0f} % of a core at 400 k rows/s, {100 * cpu / rows * 60e3:.1f} % at 60 k rows/s"
    )
    assert rows / wall > 400e3
