"""Frames of other makers' devices: cantools is the oracle, the formats are real ones (links.md)."""

from __future__ import annotations

import struct

import can
import cantools
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from ramp_device import Record, read_until

from drivers.can.can_frames import EXTENDED_FLAG, CanFrames
from drivers.contract.errors import LinkError
from drivers.contract.link_config import CanConfig
from drivers.contract.reading import Block, LinkStats
from drivers.foreign.mapped import MappedDecoder
from drivers.foreign.signal_plan import Bits, compile_plan
from drivers.links.links import make_driver
from drivers.protocol.device_info import Expected
from drivers.protocol.time_axis import TimeAxis

MS = 1_000_000

# J1939 PGN 61485 (acceleration sensor), ifm JN2300, a Racelogic-like float32 pair, a multiplexed device
DBC = b"""VERSION ""
NS_ :
BS_:
BU_: d
BO_ 2565877246 ACS: 8 d
 SG_ Lateral : 0|16@1+ (0.01,-320) [-320|320] "m/s^2" d
 SG_ Longitudinal : 16|16@1+ (0.01,-320) [-320|320] "m/s^2" d
 SG_ Vertical : 32|16@1+ (0.01,-320) [-320|320] "m/s^2" d
BO_ 2231304985 JN2300: 6 d
 SG_ X : 0|16@1- (0.001,0) [0|0] "g" d
 SG_ Y : 16|16@1- (0.001,0) [0|0] "g" d
 SG_ Z : 32|16@1- (0.001,0) [0|0] "g" d
BO_ 1536 IMU_A: 8 d
 SG_ Ax : 7|32@0- (1,0) [-100|100] "m/s^2" d
 SG_ Ay : 39|32@0- (1,0) [0|0] "m/s^2" d
BO_ 1537 IMU_B: 4 d
 SG_ Az : 7|32@0- (1,0) [-100|100] "m/s^2" d
BO_ 80 Wit: 8 d
 SG_ Page M : 8|8@1+ (1,0) [0|255] "" d
 SG_ AccX m81 : 16|16@1- (0.0047884,0) [0|0] "m/s^2" d
 SG_ GyrX m82 : 16|16@1- (1,0) [0|0] "" d
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 2565877246 3;
SIG_VALTYPE_ 1536 Ax : 1;
SIG_VALTYPE_ 1536 Ay : 1;
SIG_VALTYPE_ 1537 Az : 1;
"""


def decode(frames: list[tuple[int, bytes, int]], signals: dict[str, str], rate_hz: float = 100.0) -> Record:
    decoder = MappedDecoder(LinkStats(), DBC, signals, Expected(rate_hz), recorded=True)
    record = Record(ramp=False)
    record.take(decoder.feed(CanFrames.build(frames), 0, final=True))
    return record


def values(record: Record) -> np.ndarray:
    signals = record.infos[0].signals
    counts = np.concatenate([block.counts for block in record.blocks])
    return counts * [s.scale for s in signals] + [s.offset for s in signals]


def test_j1939_from_any_source_address() -> None:
    """cantools' decode_message ignores frame_id_mask; the frame's source and priority differ from the DBC's."""
    raw = [(32000 + 100 * k, 33000, 31000) for k in range(50)]
    frames = [(0x08F02D0B | EXTENDED_FLAG, struct.pack("<3Hxx", *row), 10 * MS * k) for k, row in enumerate(raw)]
    record = decode(frames, {"x": "ACS.Lateral", "z": "ACS.Vertical"})
    assert np.allclose(values(record)[:, 0], [-320 + 0.01 * row[0] for row in raw])
    assert np.allclose(values(record)[:, 1], -10.0)


def test_j1939_not_available_is_a_gap_and_a_second_source_is_told() -> None:
    frames = []
    for k in range(50):
        lateral = 0xFFFF if 20 <= k < 23 else 32000
        frames.append((0x08F02D0B | EXTENDED_FLAG, struct.pack("<3Hxx", lateral, 32000, 32000), 10 * MS * k))
        frames.append((0x08F02D11 | EXTENDED_FLAG, struct.pack("<3Hxx", 1, 1, 1), 10 * MS * k + MS))
    record = decode(frames, {"x": "ACS.Lateral"})
    assert [(gap.index, gap.count, gap.reason) for gap in record.gaps] == [(20, 3, "source")]
    assert np.allclose(values(record), 0.0)
    assert record.codes() == {"other_source"}


def test_ifm_extended_identifier_is_not_the_standard_one() -> None:
    frames = [(0x04FF0319 | EXTENDED_FLAG, struct.pack("<3h", k, -k, 1000), 10 * MS * k) for k in range(40)]
    frames += [(0x319, struct.pack("<3h", 9, 9, 9), 10 * MS * k) for k in range(40)]
    record = decode(frames, {"x": "JN2300.X", "y": "JN2300.Y"})
    assert record.samples == 40
    assert values(record)[39].tolist() == pytest.approx([0.039, -0.039])
    assert record.infos[0].signals[0].unit == "g"


def test_several_messages_are_one_sample() -> None:
    frames = []
    for k in range(60):
        frames.append((0x600, struct.pack(">2f", 1.5 * k / 60, -k), 10 * MS * k))
        if k not in (30, 31):
            frames.append((0x601, struct.pack(">f", 9.81), 10 * MS * k + MS))
    record = decode(frames, {"x": "IMU_A.Ax", "y": "IMU_A.Ay", "z": "IMU_B.Az"})
    assert [(gap.index, gap.count) for gap in record.gaps] == [(30, 2)]
    assert np.allclose(values(record)[-1], [1.5 * 59 / 60, -59, 9.81], atol=1e-6)


def test_a_float_that_is_no_number_is_a_gap() -> None:
    wrong = float("nan")
    frames = [(0x600, struct.pack(">2f", wrong if k == 20 else 1.0, 0), 10 * MS * k) for k in range(40)]
    record = decode(frames, {"x": "IMU_A.Ax"})
    assert [(gap.index, gap.count) for gap in record.gaps] == [(20, 1)]


def test_multiplexed_signal() -> None:
    frames = []
    for k in range(40):
        frames.append((0x50, struct.pack("<BBhxxxx", 0x55, 0x51, 100 + k), 10 * MS * k))
    record = decode(frames, {"x": "Wit.AccX"})
    assert values(record)[:, 0].tolist() == pytest.approx([0.0047884 * (100 + k) for k in range(40)])


def test_short_frame_is_a_gap() -> None:
    frames = [(0x600, struct.pack(">2f", 1.0, 2.0)[: 4 if k == 20 else 8], 10 * MS * k) for k in range(40)]
    record = decode(frames, {"x": "IMU_A.Ay"})
    assert [(gap.index, gap.count) for gap in record.gaps] == [(20, 1)]


@given(st.data())
def test_any_signal_is_read_as_cantools_reads_it(data: st.DataObject) -> None:
    length = data.draw(st.integers(1, 32))
    big, signed = data.draw(st.booleans()), data.draw(st.booleans())
    if big:
        first = data.draw(st.integers(0, 64 * 8 - length))
        start = first // 8 * 8 + 7 - first % 8
    else:
        start = data.draw(st.integers(0, 64 * 8 - length))
    text = f"""VERSION ""
NS_ :
BS_:
BU_: d
BO_ 5 M: 64 d
 SG_ S : {start}|{length}@{0 if big else 1}{"-" if signed else "+"} (0.5,3) [0|0] "m" d
"""
    payloads = data.draw(st.lists(st.binary(min_size=64, max_size=64), min_size=1, max_size=5))
    message = cantools.database.load_string(text).get_message_by_name("M")
    plan = compile_plan(text.encode(), {"s": "M.S"})
    field = plan.messages[0].fields[0]
    array = np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, 64)
    counts, valid = field.read(array, np.full(len(payloads), 64, np.uint8))
    want = [message.decode(payload)["S"] for payload in payloads]
    assert valid.all()
    assert (counts * field.signal.scale + field.signal.offset).tolist() == pytest.approx(want)


@given(st.integers(0, 448), st.booleans(), st.binary(min_size=64, max_size=64))
def test_64_bits_anywhere(first: int, big: bool, payload: bytes) -> None:
    start = first // 8 * 8 + 7 - first % 8 if big else first
    array = np.frombuffer(payload, np.uint8)[None]
    got = int(Bits.of(start, 64, big).read(array)[0])
    bits = int.from_bytes(payload, "big" if big else "little")
    assert got == (bits >> (448 - first if big else first)) & (2**64 - 1)


def test_too_wide_is_refused() -> None:
    text = b'VERSION ""\nNS_ :\nBS_:\nBU_: d\nBO_ 5 M: 8 d\n SG_ S : 0|40@1+ (1,0) [0|0] "" d\n'
    with pytest.raises(LinkError, match="40 bits"):
        compile_plan(text, {"s": "M.S"})


def test_live_on_a_bus() -> None:
    """The same path for a live device: 200 frames a second of an ifm sensor on a virtual bus."""
    driver = make_driver(CanConfig("virtual", "ifm"), dbc=DBC, signals={"x": "JN2300.X"}, expected=Expected(200.0))
    driver.open()
    sender = can.Bus("ifm", interface="virtual", preserve_timestamps=True)
    for k in range(500):  # a gap is certain when nothing has caught up for a second
        if k not in (100, 101, 102):
            data = struct.pack("<3h", k, 0, 0)
            sender.send(can.Message(arbitration_id=0x04FF0319, data=data, timestamp=1000 + k / 200))
    record = read_until(driver, Record(ramp=False), lambda r: r.samples > 150)
    driver.close()
    sender.shutdown()
    assert [(gap.index, gap.count) for gap in record.gaps] == [(100, 3)]


@given(st.lists(st.tuples(st.sampled_from([0x600, 0x601, 0x50, 0x18F02DFE | EXTENDED_FLAG]), st.binary(max_size=64),
                          st.integers(-(10**12), 10**12)), max_size=60), st.integers(1, 20))  # fmt: skip
@example([(0x50, b"", 0), (0x600, b"\x7f\x81", 0)], 1)  # a signalling NaN
def test_any_frames_at_any_times_never_raise(frames: list[tuple[int, bytes, int]], batch: int) -> None:
    signals = {"a": "IMU_A.Ax", "b": "IMU_B.Az", "c": "Wit.AccX", "d": "ACS.Lateral"}
    for rate_hz in (None, 100.0):
        decoder = MappedDecoder(LinkStats(), DBC, signals, Expected(rate_hz))
        record = Record(ramp=False)
        for start in range(0, len(frames), batch):
            record.take(decoder.feed(CanFrames.build(frames[start : start + batch]), 0))
        record.take(decoder.feed(CanFrames.build([]), 0, final=True))


class TestTimeAxis:
    def place(self, times_ms: list[float], rate_hz: float | None, batch: int = 7) -> list[int]:
        axis = TimeAxis(rate_hz)
        t_ns = (np.array(times_ms) * 1e6).astype(np.int64)
        out = [axis.place(t_ns[k : k + batch]) for k in range(0, len(t_ns), batch)]
        return [*np.concatenate([*out, axis.place(np.empty(0, np.int64), final=True)]).tolist()]

    def test_late_and_bunched_samples_are_not_missing(self) -> None:
        """50 ms late, then all at once: nothing is lost."""
        times = [10.0 * k + (50 - 10 * (k - 60) if 60 <= k < 65 else 0) for k in range(200)]
        assert self.place(times, 100.0) == list(range(200))

    def test_bursts_of_16_ms_at_1_khz(self) -> None:
        assert self.place([np.ceil(k / 16) * 16 for k in range(600)], 1000.0, 16) == list(range(600))

    def test_missing_samples_are_missing(self) -> None:
        kept = [k for k in range(400) if not 100 <= k < 107 and k != 250]
        assert self.place([10.0 * k for k in kept], 100.0) == kept

    def test_missing_amid_bursts(self) -> None:
        kept = [k for k in range(900) if not 300 <= k < 340]
        assert self.place([np.ceil(k / 16) * 16 for k in kept], 1000.0, 16) == kept

    def test_a_clock_300_ppm_off_is_followed(self) -> None:
        for ppm in (300, -300):
            times = [10.0 * k * (1 + ppm * 1e-6) for k in range(20_000)]
            assert self.place(times, 100.0, 50) == list(range(20_000))

    def test_rate_is_estimated(self) -> None:
        axis = TimeAxis(None)
        rng = np.random.default_rng(1)
        axis.place(((np.arange(100) / 333.0 + rng.normal(0, 1e-5, 100)) * 1e9).astype(np.int64))
        assert axis.rate_hz == pytest.approx(333.0, rel=1e-3)

    def test_certain_samples_are_not_held(self) -> None:
        axis = TimeAxis(100.0)
        t_ns = np.arange(50) * 10 * MS
        for k in range(50):
            assert len(axis.place(t_ns[k : k + 1])) == 1
        assert axis.held == 0

    @given(st.lists(st.integers(-(2**62), 2**62), max_size=40), st.integers(1, 9))
    def test_indices_always_rise(self, times: list[int], batch: int) -> None:
        got = self.place([t / 1e6 for t in times], 100.0, batch)
        assert len(got) == len(times)
        assert all(b > a for a, b in zip(got[:-1], got[1:], strict=True))


def test_blocks_are_copies() -> None:
    frames = [(0x600, struct.pack(">2f", 1.0, 2.0), 10 * MS * k) for k in range(40)]
    record = decode(frames, {"x": "IMU_A.Ax"})
    assert isinstance(record.blocks[0], Block)
    assert record.blocks[0].counts.flags.owndata or record.blocks[0].counts.base is not None
