"""Serial devices of others, on bytes built here from the makers' descriptions: whole, cut anywhere, damaged."""

from __future__ import annotations

import os
import pty
import struct
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ramp_device import Record

from daq.commands.cli.app import main
from daq.log.reader import read_log
from drivers.contract.errors import LinkError
from drivers.contract.link_config import SerialConfig
from drivers.contract.reading import LinkStats
from drivers.devices import DEVICE_PROFILES, PacketDecoder
from drivers.foreign.mapped import MappedDecoder
from drivers.links.links import make_driver, parse_link
from drivers.protocol.device_info import Expected

RATE_HZ = 200.0
STEP_NS = round(1e9 / RATE_HZ)
G = np.round(np.random.default_rng(0).uniform(-1.9, 1.9, (800, 3)), 4)  # g, or any unit


def witmotion(x: float, y: float, z: float) -> bytes:
    head = struct.pack("<BB4h", 0x55, 0x51, *(round(v / 16 * 32768) for v in (x, y, z)), 2500)
    gyro = struct.pack("<BB4h", 0x55, 0x52, 1, -2, 3, 0x5555)  # another packet between them, full of sync bytes
    return b"".join(part + bytes([sum(part) & 0xFF]) for part in (head, gyro))


def mip(x: float, y: float, z: float) -> bytes:
    fields = struct.pack(">BB3f", 14, 0x04, x, y, z) + struct.pack(">BB3f", 14, 0x05, 1.0, 2.0, 3.0)
    packet = struct.pack(">4B", 0x75, 0x65, 0x80, len(fields)) + fields
    one = two = 0
    for byte in packet:
        one = (one + byte) & 0xFF
        two = (two + one) & 0xFF
    return packet + bytes([one, two])


def m_a352(x: float, y: float, z: float) -> bytes:
    body = struct.pack(">Hi3iH", 0xFE00, -5000, *(round(v * 2**24) for v in (x, y, z)), 7)
    words = struct.unpack(f">{len(body) // 2}H", body)
    return b"\x80" + body + struct.pack(">H", sum(words) & 0xFFFF) + b"\x0d"


def lines(x: float, y: float, z: float) -> bytes:
    return f"{x:.4f}, {y:+.4f};{z:.3e}\r\n".encode()


PACKET_OF_SAMPLE: dict[str, Callable[[float, float, float], bytes]] = {
    "witmotion": witmotion, "mip": mip, "m_a352": m_a352, "lines": lines,
}  # fmt: skip
FIRST_SAMPLE_READ = {"lines": 1}  # the first line may be the end of one
TOLERANCE_G = {"witmotion": 16 / 32768, "mip": 1e-6, "m_a352": 1e-7, "lines": 6e-3}


def decoder(name: str) -> PacketDecoder:
    profile = DEVICE_PROFILES[name]
    signals = dict(zip("xyz", profile.signals, strict=False))
    inner = MappedDecoder(LinkStats(), profile.dbc, signals, Expected(RATE_HZ))
    return PacketDecoder(inner, profile.make())


def decoded(name: str, pieces: list[tuple[bytes, int]]) -> tuple[Record, PacketDecoder]:
    own, record = decoder(name), Record(ramp=False)
    for data, t_ns in pieces:
        record.take(own.feed(data, t_ns))
    return record, own


def timely(name: str, values: np.ndarray = G) -> list[tuple[bytes, int]]:
    return [(PACKET_OF_SAMPLE[name](*row), (k + 1) * STEP_NS) for k, row in enumerate(values.tolist())]


def values(record: Record) -> np.ndarray:
    scale = np.array([s.scale for s in record.infos[-1].signals])
    offset = np.array([s.offset for s in record.infos[-1].signals])
    return np.concatenate([b.counts for b in record.blocks]) * scale + offset


def test_every_profile_is_tested_and_listed_in_the_link() -> None:
    assert set(PACKET_OF_SAMPLE) == set(DEVICE_PROFILES)
    with pytest.raises(LinkError) as error:
        parse_link("nothing:")
    assert "|".join(DEVICE_PROFILES) in str(error.value)


@pytest.mark.parametrize("name", PACKET_OF_SAMPLE)
def test_the_numbers_of_the_makers_description_come_out(name: str) -> None:
    record, own = decoded(name, timely(name))
    found = values(record)
    assert not record.gaps
    assert len(found) > 600
    begin = FIRST_SAMPLE_READ.get(name, 0)
    np.testing.assert_allclose(found, G[begin : begin + len(found)], rtol=0, atol=TOLERANCE_G[name])
    assert record.infos[-1].signals[0].unit == ("" if name == "lines" else "g")
    assert own.stats.crc_errors == 0


@pytest.mark.parametrize("name", PACKET_OF_SAMPLE)
@settings(max_examples=15, deadline=None)
@given(cuts=st.lists(st.integers(1, 40), min_size=1, max_size=20))
def test_any_cut_of_the_stream_gives_the_same(name: str, cuts: list[int]) -> None:
    stream = b"".join(data for data, _ in timely(name, G[:60]))
    own, found, at, k = DEVICE_PROFILES[name].make(), [], 0, 0
    while at < len(stream):
        piece = stream[at : at + cuts[k % len(cuts)]]
        at, k = at + len(piece), k + 1
        packets = own.feed(piece)
        found += [bytes(p[:n]) for p, n in zip(packets.frames.payload, packets.frames.lengths, strict=True)]
        assert not packets.holes.any()
    whole = DEVICE_PROFILES[name].make().feed(stream).frames
    alike = [bytes(p[:n]) for p, n in zip(whole.payload, whole.lengths, strict=True)]
    # the first line of text may be the end of one; by itself the number of columns of a piece is not known
    assert found == alike or (name == "lines" and found == alike[len(alike) - len(found) :])


@pytest.mark.promise(
    "packets in bursts on a line that is nearly full",
    "each of four devices at 200 Hz, handed over every 16 ms, one packet missing",
    "the rate is that of the device, one sample is lost",
)
@pytest.mark.parametrize("name", PACKET_OF_SAMPLE)
def test_bursts_of_an_adapter_are_no_other_rate_and_no_loss(name: str) -> None:
    """Were packets stamped by the bytes behind them, a burst would show the rate of the line."""
    burst_ns = 16_000_000
    pieces = [(data, -(-t_ns // burst_ns) * burst_ns) for data, t_ns in timely(name, np.tile(G, (3, 1)))]
    del pieces[1000]
    bursts = {t_ns: b"".join(data for data, own in pieces if own == t_ns) for _, t_ns in pieces}
    record, _ = decoded(name, [(data, t_ns) for t_ns, data in bursts.items()])
    assert record.infos[-1].rate_hz == RATE_HZ
    assert [g.count for g in record.gaps] == [1]
    assert abs(record.gaps[0].index - 1000) <= 10


@pytest.mark.parametrize("name", PACKET_OF_SAMPLE)
def test_a_damaged_packet_is_one_gap_in_its_place(name: str) -> None:
    pieces = timely(name)
    for k in (150, 151, 300):
        data = bytearray(pieces[k][0])
        data[len(data) // 2 if name != "witmotion" else 6] ^= 0x80
        pieces[k] = (bytes(data), pieces[k][1])
    record, own = decoded(name, pieces)
    found = values(record)
    begin = FIRST_SAMPLE_READ.get(name, 0)
    assert [(g.index + begin, g.count, g.reason) for g in record.gaps] == [(150, 2, "crc"), (300, 1, "crc")]
    left = np.delete(G, [150, 151, 300], axis=0)[begin:]
    np.testing.assert_allclose(found, left[: len(found)], rtol=0, atol=TOLERANCE_G[name])
    assert own.stats.crc_errors == 3


@pytest.mark.parametrize("name", PACKET_OF_SAMPLE)
@settings(max_examples=60, deadline=None)
@given(junk=st.binary(max_size=600), split=st.integers(1, 50))
def test_garbage_never_raises_and_a_good_packet_behind_it_is_found(name: str, junk: bytes, split: int) -> None:
    framer = DEVICE_PROFILES[name].make()
    for at in range(0, len(junk), split):
        framer.feed(junk[at : at + split])
    good = PACKET_OF_SAMPLE[name](0.5, -0.25, 0.125)
    seen = 0
    for _ in range(40):  # a false length may swallow what follows it, never for long
        seen += len(framer.feed(good).frames)
    assert seen >= (1 if name == "lines" else 10)


def test_a_megabyte_takes_little_time() -> None:
    for name in PACKET_OF_SAMPLE:
        data = b"".join(PACKET_OF_SAMPLE[name](*row) for row in G.tolist()) * 30
        start = time.process_time()
        framer = DEVICE_PROFILES[name].make()
        count = sum(len(framer.feed(data[at : at + 65536]).frames) for at in range(0, len(data), 65536))
        assert count >= 0.99 * 24_000
        assert time.process_time() - start < 2.0, name


@pytest.mark.parametrize(
    ("link", "words"),
    [
        ("serial:/dev/x?device=witmotoin", "did you mean 'witmotion'?"),
        ("serial:/dev/x?device=abc", "there are witmotion, mip, m_a352, lines"),
        ("serial:/dev/x?device=mip", "Acceleration.X"),
        ("serial:/dev/x?devise=mip", "did you mean 'device'?"),
    ],
)
def test_a_wrong_device_is_one_line(link: str, words: str) -> None:
    with pytest.raises(LinkError) as error:
        make_driver(parse_link(link))
    assert words in str(error.value)
    assert isinstance(parse_link("serial:/dev/x?device=mip&baud=115200"), SerialConfig)


def test_an_example_rig_records_from_a_port(tmp_path: Path) -> None:
    """The rig file that init copies, a pty for the port, packets at 200 Hz, a log of the values."""
    rig, log = str(tmp_path / "rig.toml"), str(tmp_path / "a.mcap")
    assert main(["init", "--example", "witmotion_serial", "--out", rig, "--quiet"]) == 0
    master, slave = pty.openpty()
    tty.setraw(slave)
    stop = threading.Event()

    def send() -> None:
        begin = time.monotonic()
        for k in range(2000):
            if stop.wait(max(0.0, begin + k / RATE_HZ - time.monotonic())):
                return
            os.write(master, witmotion(*G[k % len(G)].tolist()))

    sender = threading.Thread(target=send)
    sender.start()
    try:
        link = f"serial:{os.ttyname(slave)}?baud=115200&device=witmotion"
        assert main(["run", rig, "--link", link, "--seconds", "3", "--out", log, "--quiet"]) == 0
    finally:
        stop.set()
        sender.join()
    record = read_log(log)
    assert record.channels == ("x", "y")
    y = record.samples()
    assert len(y) >= 590
    np.testing.assert_allclose(np.nanmax(np.abs(y)), 1.9 * 9.80665, rtol=0.02)
