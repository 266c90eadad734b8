"""Every byte of protocol v1: the documented vectors, the shipped DBC with cantools as the oracle, round trips."""

from __future__ import annotations

import zlib
from pathlib import Path

import cantools
import numpy as np
import pytest
import vectors
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.slcan_codec import encode_line
from drivers.contract.reading import Signal
from drivers.protocol import protocol
from drivers.protocol.protocol import LAYOUT_OF_NAME, InfoRecord
from drivers.protocol.protocol_dbc import dbc_text
from drivers.serial import cobs
from drivers.serial.serial_decoder import pack_samples
from drivers.simulated.simulated import DeviceConfig

ROOT = Path(__file__).parents[3]
RECORD = InfoRecord(
    layout=1,
    channels=4,
    channel=2,
    count_bits=16,
    serial_number=0x52530001,
    rate_hz=25600.0,
    signal=Signal("b2x", "m/s^2", 0.015625),
    full_scale=511.984375,
    epoch=3,
    firmware=7,
)
FLAGS = np.array([0x34], np.uint8)


def array(text: str) -> np.ndarray:
    return np.frombuffer(bytes.fromhex(text), np.uint8)[None, :]


def test_vectors_are_in_the_document() -> None:
    page = (ROOT / "docs" / "protocol.md").read_text()
    for vector in vectors.EVERY:
        assert vector in page


def test_fd16_vector() -> None:
    counts = np.arange(28, dtype=np.int32).reshape(1, 7, 4)
    counts[0, 0] = [1, -1, 32767, -32767]
    packed = protocol.pack_fd16(np.array([0x1234]), np.array([2], np.uint8), FLAGS, np.array([0x12345678]), counts)
    assert packed.tobytes().hex(" ") == vectors.FD16
    frames = protocol.unpack_fd16(array(vectors.FD16), 4)
    assert frames.position[0] == 0x1234 * 7
    assert (frames.lost[0], frames.epoch[0]) == (2, 3)
    assert frames.time_us is not None
    assert frames.time_us[0] == 0x12345678
    assert np.array_equal(frames.counts, counts)


def test_fd24_vector() -> None:
    counts = np.arange(20, dtype=np.int32).reshape(1, 5, 4)
    counts[0, 0] = [1, -1, 8388607, -8388607]
    packed = protocol.pack_fd24(np.array([0x1234]), np.array([2], np.uint8), FLAGS, counts)
    assert packed.tobytes().hex(" ") == vectors.FD24
    assert np.array_equal(protocol.unpack_fd24(array(vectors.FD24), 4).counts, counts)


def test_classic_vector() -> None:
    counts = np.array([[1, -1, 16383, -16383]], np.int32)
    assert protocol.pack_classic(np.array([5]), counts).tobytes().hex(" ") == vectors.CLASSIC
    counter, back = protocol.unpack_classic(array(vectors.CLASSIC), 4)
    assert counter[0] == 5
    assert np.array_equal(back, counts)


def test_sync_vectors() -> None:
    assert protocol.pack_sync(1000005, 0x34, 200001000).hex(" ") == vectors.SYNC
    assert protocol.unpack_sync(bytes.fromhex(vectors.SYNC)) == (1000005, 0x34, 200001000)
    assert protocol.pack_sync_fd(1000005, 0x34, 39062695).hex(" ") == vectors.SYNC_FD
    assert protocol.unpack_sync_fd(bytes.fromhex(vectors.SYNC_FD)) == (1000005, 0x34, 39062695)


def test_info_vectors() -> None:
    assert protocol.pack_info(RECORD).hex(" ") == vectors.INFO
    assert protocol.unpack_info(bytes.fromhex(vectors.INFO)) == RECORD
    parts = protocol.pack_info_parts(RECORD)
    assert parts[0].hex(" ") == vectors.INFO_PART_0
    assert len(parts) == 11
    assert all(len(part) == 8 for part in parts)
    assert b"".join(part[2:] for part in parts)[:64].hex(" ") == vectors.INFO


def test_serial_vectors() -> None:
    assert zlib.crc32(b"123456789") == 0xCBF43926
    body = pack_samples(128, 2, 0x34, 5000, np.array([[1, -1], [256, 0]], np.int32))
    assert body.hex(" ") == vectors.SERIAL_BODY
    assert cobs.encode(body).hex(" ") == vectors.SERIAL_WIRE
    bodies = cobs.Deframer().feed(bytes.fromhex(vectors.SERIAL_WIRE))
    assert bodies.data[bodies.starts[0] : bodies.stops[0]].tobytes() == body


@pytest.mark.parametrize(("data", "encoded"), vectors.COBS)
def test_cobs_vectors(data: str, encoded: str) -> None:
    assert cobs.stuff(bytes.fromhex(data)) == bytes.fromhex(encoded)


def test_slcan_vector() -> None:
    assert encode_line(0x302, bytes.fromhex(vectors.CLASSIC), fd=False) == vectors.SLCAN_CLASSIC.encode() + b"\r"


def test_shipped_dbc_is_the_generated_one() -> None:
    assert (ROOT / "configs" / "rotorscope.dbc").read_text() == dbc_text()


@pytest.mark.parametrize("channels", [1, 2, 4, 8])
def test_dbc_describes_every_frame(channels: int) -> None:
    database = cantools.database.load_string(dbc_text(channels))
    rng = np.random.default_rng(channels)
    for name in ("fd16", "fd24"):
        layout = LAYOUT_OF_NAME[name]
        rows, limit = layout.rows(channels), 2 ** (layout.bits - 1)
        counts = rng.integers(-limit, limit, (1, rows, channels)).astype(np.int32)
        seq, lost = np.array([51234]), np.array([200], np.uint8)
        flags = protocol.make_flags(np.array([True]), 9)
        if name == "fd16":
            payload = protocol.pack_fd16(seq, lost, flags, np.array([4_000_000_000]), counts)
        else:
            payload = protocol.pack_fd24(seq, lost, flags, counts)
        want = database.decode_message(name, payload.tobytes())
        head = [want[key] for key in ("sequence", "device_lost", "clipped", "version", "epoch")]
        assert head == [51234, 200, 1, 1, 9]
        assert name == "fd24" or want["time"] == 4_000_000_000
        signals = [want[f"s{row}_c{channel}"] for row in range(rows) for channel in range(channels)]
        assert signals == counts.ravel().tolist()


def test_dbc_describes_sync_info_and_classic() -> None:
    database = cantools.database.load_file(ROOT / "configs" / "rotorscope.dbc")
    classic = database.decode_message("classic", bytes.fromhex(vectors.CLASSIC))
    assert classic == {"counter": 5, "s0_c0": 1, "s0_c1": -1, "s0_c2": 16383, "s0_c3": -16383}
    sync = database.decode_message("sync", bytes.fromhex(vectors.SYNC))
    assert (sync["index"], sync["version"], sync["epoch"], sync["time"]) == (1000005, 1, 3, 200001000)
    sync = database.decode_message("sync_fd", bytes.fromhex(vectors.SYNC_FD))
    assert (sync["index"], sync["version"], sync["epoch"], sync["time"]) == (1000005, 1, 3, 39062695)
    info = database.decode_message("info", bytes.fromhex(vectors.INFO))
    assert (info["rate"], info["scale"], info["offset"], info["range"]) == (25600.0, 0.015625, 0.0, 511.984375)
    assert (info["serial_number"], info["firmware"], info["channel"]) == (0x52530001, 7, 2)
    assert int(info["name_low"]).to_bytes(8, "little").rstrip(b"\0") == b"b2x"
    assert database.get_message_by_name("info_part").frame_id == protocol.BASE_ID + protocol.ID_INFO_PART
    assert {m.frame_id - protocol.BASE_ID for m in database.messages} == set(range(7))


@pytest.mark.parametrize("name", LAYOUT_OF_NAME)
@given(data=st.data())
def test_info_round_trip(name: str, data: st.DataObject) -> None:
    layout = LAYOUT_OF_NAME[name]
    channels = data.draw(st.integers(1, layout.max_channels))
    number = st.floats(1e-9, 1e9)
    record = InfoRecord(
        layout=layout.code, channels=channels, channel=data.draw(st.integers(0, channels - 1)),
        count_bits=data.draw(st.integers(2, 32)),
        serial_number=data.draw(st.integers(0, 2**32 - 1)), rate_hz=data.draw(st.floats(1e-3, 1e7)),
        signal=Signal(data.draw(st.text("abcxyz019_", max_size=16)), data.draw(st.sampled_from(protocol.UNIT_OF_CODE)),
               data.draw(number), data.draw(number)),
        full_scale=data.draw(number), epoch=data.draw(st.integers(0, 15)),
    )  # fmt: skip
    assert protocol.unpack_info(protocol.pack_info(record)) == record


@given(st.binary(min_size=64, max_size=64))
def test_info_of_any_bytes_is_a_record_or_none(data: bytes) -> None:
    record = protocol.unpack_info(data)
    assert record is None or record.version != 1 or 0 < record.rate_hz <= 1e7


def test_rows_of_the_document() -> None:
    assert [LAYOUT_OF_NAME["fd16"].rows(n) for n in range(1, 9)] == [28, 14, 9, 7, 5, 4, 4, 3]
    assert [LAYOUT_OF_NAME["fd24"].rows(n) for n in range(1, 9)] == [20, 10, 6, 5, 4, 3, 2, 2]


def test_device_config_refuses_what_cannot_be_sent() -> None:
    with pytest.raises(ValueError, match="carries 1 to 4 channels"):
        DeviceConfig(100.0, tuple("abcde"), layout="classic")
    with pytest.raises(ValueError, match="there are fd16"):
        DeviceConfig(100.0, ("a",), layout="fd17")
    with pytest.raises(ValueError, match="no fault"):
        DeviceConfig(100.0, ("a",), fault_rates={"fire": 1.0})
