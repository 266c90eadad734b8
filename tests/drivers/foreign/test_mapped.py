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
from drivers.contract.reading import Block, Gap, Info, LinkStats, Notice, Reading
from drivers.foreign.mapped import MappedDecoder
from drivers.foreign.signal_plan import Bits, compile_plan
from drivers.links.links import make_driver
from drivers.protocol.device_info import Expected

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


@pytest.mark.promise("a J1939 DBC", "known by BA_DEF_DEF_ alone", "codes from 0xFB.. are no values")
def test_j1939_by_the_default_of_the_whole_file() -> None:
    """BA_DEF_DEF_ alone says the protocol."""
    default = b'BA_DEF_ "ProtocolType" STRING ;\nBA_DEF_DEF_ "ProtocolType" "%s";\n'
    silent = DBC.replace(b'BA_ "VFrameFormat" BO_ 2565877246 3;\n', b"")
    for protocol, of_j1939 in ((b"J1939", True), (b"", False)):
        plan = compile_plan(silent + default % protocol, {"x": "ACS.Lateral"})
        assert (plan.messages[0].pages[0].fields[0].first_code == 0xFB00) is of_j1939


def test_j1939_not_available_is_a_gap_and_a_second_source_is_reported() -> None:
    frames = []
    for k in range(50):
        lateral = 0xFFFF if 20 <= k < 23 else 32000
        frames.append((0x08F02D0B | EXTENDED_FLAG, struct.pack("<3Hxx", lateral, 32000, 32000), 10 * MS * k))
        frames.append((0x08F02D11 | EXTENDED_FLAG, struct.pack("<3Hxx", 1, 1, 1), 10 * MS * k + MS))
    record = decode(frames, {"x": "ACS.Lateral"})
    assert [(gap.index, gap.count, gap.reason) for gap in record.gaps] == [(20, 3, "source")]
    assert np.allclose(values(record), 0.0)
    assert record.codes() == {"other_source", "no_value"}


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
    field = plan.messages[0].pages[0].fields[0]
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


def test_blocks_are_copies() -> None:
    frames = [(0x600, struct.pack(">2f", 1.0, 2.0), 10 * MS * k) for k in range(40)]
    record = decode(frames, {"x": "IMU_A.Ax"})
    assert isinstance(record.blocks[0], Block)
    assert record.blocks[0].counts.flags.owndata or record.blocks[0].counts.base is not None


NESTED = b"""VERSION ""
NS_ :
BS_: 500000 : 0,0
BU_: d
BO_ 256 Acc: 8 d
 SG_ Top M : 0|8@1+ (1,0) [0|0] "" d
 SG_ Sub m1M : 8|8@1+ (1,0) [0|0] "" d
 SG_ X m2 : 16|16@1- (0.01,0) [0|0] "m/s^2" d
 SG_ Y m3 : 16|16@1- (0.01,0) [0|0] "m/s^2" d
 SG_ T m0 : 16|16@1- (0.01,0) [0|0] "degC" d
 SG_ Z : 32|16@1- (0.01,0) [0|0] "m/s^2" d
BO_ 512 Pages: 8 d
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" d
 SG_ V m0 : 8|16@1- (0.01,0) [0|0] "m/s^2" d
 SG_ V m1 : 24|16@1- (0.01,0) [0|0] "m/s^2" d
BO_ 768 A: 2 d
 SG_ S : 0|16@1- (0.01,0) [0|1] "m/s^2" d
BO_ 769 B: 2 d
 SG_ S : 0|16@1- (0.01,0) [0|0] "m/s^2" d
SG_MUL_VAL_ 256 Sub Top 1-1;
SG_MUL_VAL_ 256 X Sub 2-2;
SG_MUL_VAL_ 256 Y Sub 3-3;
SG_MUL_VAL_ 256 T Top 0-0;
VAL_ 769 S 32767 "SNA" -32768 "Error" 0 "Zero" ;
"""


def run(
    frames: list[tuple[int, bytes, int]], signals: dict[str, str], dbc: bytes = NESTED, rate_hz: float | None = 100.0,
    recorded: bool = True,
) -> Record:  # fmt: skip
    decoder = MappedDecoder(LinkStats(), dbc, signals, Expected(rate_hz), recorded=recorded)
    record = Record(ramp=False)
    built = CanFrames.build(frames)
    for k in range(0, len(frames), 50):
        record.take(decoder.feed(built.pick(slice(k, k + 50)), 0))
    record.take(decoder.feed(CanFrames.build([]), 0, final=True))
    return record


@pytest.mark.promise("multiplexed signals", "nested, ranges, other pages between", "only the right page is a sample")
def test_pages_of_nested_multiplexers_are_told_apart_and_others_are_no_losses() -> None:
    frames = []
    for k in range(60):
        frames.append((256, struct.pack("<BBhh", 1, 2, k, -k), 10 * MS * k))
        frames.append((256, struct.pack("<BBhh", 0, 2, 9999, 0), 10 * MS * k + MS))  # a temperature
        frames.append((256, struct.pack("<BBhh", 1, 3, 2 * k, 0), 10 * MS * k + 2 * MS))
    record = run(frames, {"x": "Acc.X", "y": "Acc.Y"})
    assert not record.gaps
    assert np.allclose(values(record), np.array([[k, 2 * k] for k in range(60)]) * 0.01)


def test_a_signal_on_two_pages_and_one_on_every_page() -> None:
    frames = [(512, struct.pack("<Bhh", k % 2, k, k) + bytes(3), 10 * MS * k) for k in range(60)]
    assert np.allclose(values(run(frames, {"v": "Pages.V"}))[:, 0], 0.01 * np.arange(60))
    frames = [(256, struct.pack("<BBhh", 1, 2, k, -k), 10 * MS * k) for k in range(60)]
    assert np.allclose(values(run(frames, {"x": "Acc.X", "z": "Acc.Z"}))[-1], [0.59, -0.59])


@pytest.mark.promise('codes for "not available"', "value tables, J1939", "missing, and said which")
def test_codes_for_no_value_are_missing_and_named_values_are_not() -> None:
    raw = [32767 if k == 20 else -32768 if k == 30 else 0 if k == 40 else k for k in range(60)]
    record = run([(769, struct.pack("<h", each), 10 * MS * k) for k, each in enumerate(raw)], {"s": "B.S"})
    assert [(gap.index, gap.count) for gap in record.gaps] == [(20, 1), (30, 1)]
    assert any("SNA" in notice.text and "Error" in notice.text for notice in record.notices)


@pytest.mark.parametrize(
    ("code", "name", "is_value"),
    [(32767, "Sensor fault", False), (32767, "Overload", False), (-32767, "nicht verfügbar", False),
     (20, "SignalNotPresent", False), (20, "Invalid_data", False), (32766, "ungültig", False), (0, "NaN", False),
     (32767, "+16 g", True), (0, "no load", True), (20, "Maximum", True)],
)  # fmt: skip
def test_a_name_shows_whether_its_code_is_a_value(code: int, name: str, is_value: bool) -> None:
    dbc = NESTED.replace(b'32767 "SNA" -32768 "Error" 0 "Zero"', f'{code} "{name}"'.encode())
    frames = [(769, struct.pack("<h", code if k == 30 else 100 + k), 10 * MS * k) for k in range(60)]
    record = run(frames, {"s": "B.S"}, dbc=dbc)
    assert [(gap.index, gap.count) for gap in record.gaps] == ([] if is_value else [(30, 1)])


@pytest.mark.promise("wrong limits in a DBC", "[0,1] for a real signal", "kept, said")
def test_values_beyond_untrue_limits_stay_and_its_extreme_codes_do_not() -> None:
    raw = [32767 if k == 20 else 10 * k for k in range(60)]
    record = run([(768, struct.pack("<h", each), 10 * MS * k) for k, each in enumerate(raw)], {"s": "A.S"})
    assert [(gap.index, gap.count) for gap in record.gaps] == [(20, 1)]
    assert {"outside_limits", "no_value"} <= record.codes()


@pytest.mark.promise("floats without a range", "metres to micrometres, Motorola and Intel", "full single precision")
@pytest.mark.parametrize("size", [3e-9, 1.0, 40_000.0, 1e12])
def test_a_float_keeps_its_precision_whatever_its_size(size: float) -> None:
    """Small at first: larger values than fit need larger steps, and are no gap."""
    want = [size * (1e-3 if k < 120 else 1.0) * np.sin(k) for k in range(240)]
    frames = [(0x600, struct.pack(">2f", 0.0, each), 10 * MS * k) for k, each in enumerate(want)]
    decoder = MappedDecoder(LinkStats(), DBC, {"y": "IMU_A.Ay"}, Expected(100.0))
    record, got = Record(ramp=False), []
    for frame in frames:
        for reading in decoder.feed(CanFrames.build([frame]), 0):
            record.take([reading])
            if isinstance(reading, Block):
                got += (reading.counts[:, 0] * record.infos[-1].signals[0].scale).tolist()
    assert not record.gaps
    assert len(record.infos) == 2
    assert np.allclose(got, want[: len(got)], atol=1e-7 * size, rtol=0)
    assert len(got) > 200


@pytest.mark.promise("order of messages", "higher identifier first, frames lost", "one instant a sample, in any order")
def test_frames_of_one_instant_are_one_row_in_any_order() -> None:
    names = {"a": "A.S", "b": "B.S"}
    frames = []
    for k in range(100):
        pair = [(768, struct.pack("<h", k)), (769, struct.pack("<h", -k))]
        pair = pair[::-1] if k % 3 else pair
        lost = k == 40 or (k == 41)
        for j, (identifier, data) in enumerate(pair):
            if not (lost and identifier == (768 if k == 40 else 769)):
                frames.append((identifier, data, 10 * MS * k + j * MS // 3))
    record = run(frames, names)
    assert [(gap.index, gap.count) for gap in record.gaps] == [(40, 2)]
    assert np.allclose(values(record).sum(axis=1), 0.0, atol=1e-9)


def test_rows_that_came_at_once_are_separated_by_order() -> None:
    """Host stamps: four rows in a burst of 40 ms."""
    frames = [(768 + j, struct.pack("<h", k), (k // 4 + 1) * 40 * MS) for k in range(200) for j in (0, 1)]
    record = run(frames, {"a": "A.S", "b": "B.S"}, recorded=False)
    assert not record.gaps
    assert record.samples >= 196
    assert (np.diff(values(record), axis=1) == 0).all()


@pytest.mark.promise("messages of different rates or clocks", "twice as fast; 0.5 % apart", "refused; told")
@pytest.mark.parametrize(
    ("ratio", "code", "fatal"), [(2.0, "unequal_rates", True), (1.005, "own_clocks", False), (1.0, "", False)]
)
def test_messages_of_other_rates_or_clocks_are_told(ratio: float, code: str, fatal: bool) -> None:
    a = [(768, struct.pack("<h", k), 10 * MS * k) for k in range(300)]
    b = [(769, struct.pack("<h", k), 4 * MS + round(10 * MS * k / ratio)) for k in range(300)]
    decoder = MappedDecoder(LinkStats(), NESTED, {"a": "A.S", "b": "B.S"}, Expected(100.0), recorded=True)
    decoder.feed(CanFrames.build(sorted(a + b, key=lambda frame: frame[2])), 0, final=True)
    assert [(each.code, each.fatal) for each in decoder.findings] == ([(code, fatal)] if code else [])


def test_a_slow_slip_is_reported_later() -> None:
    a = [(768, struct.pack("<h", k), 10 * MS * k) for k in range(12_000)]
    b = [(769, struct.pack("<h", k), 2 * MS + round(10 * MS * k * (1 + 3e-5))) for k in range(12_000)]
    assert "own_clocks" in run(sorted(a + b, key=lambda frame: frame[2]), {"a": "A.S", "b": "B.S"}).codes()


@pytest.mark.promise(
    "frames that outrun one source", "echo without marks, two devices of one identifier", "refused, told"
)
def test_an_echo_and_two_devices_of_one_identifier_are_found() -> None:
    for apart, same, code in ((MS // 5, True, "frames_twice"), (3 * MS, False, "interleaved")):
        frames = []
        for k in range(60):
            frames.append((768, struct.pack("<h", k), 10 * MS * k))
            frames.append((768, struct.pack("<h", k if same else 50 - k), 10 * MS * k + apart))
        decoder = MappedDecoder(LinkStats(), NESTED, {"a": "A.S"}, Expected(100.0), recorded=True)
        decoder.feed(CanFrames.build(frames), 0, final=True)
        assert [(each.code, each.fatal) for each in decoder.findings] == [(code, True)]


@pytest.mark.promise(
    "a device at another rate than the rig file says",
    "102.4 for 100 Hz and others",
    "its own rate used, said, no loss invented",
)
def test_a_device_at_another_rate_is_counted_at_its_own_and_told() -> None:
    for hz in (97.66, 102.4, 200.0):
        record = run([(768, struct.pack("<h", k), round(k * 1e9 / hz)) for k in range(400)], {"a": "A.S"})
        assert record.infos[0].rate_hz == pytest.approx(hz, rel=1e-4)
        assert not record.gaps
        assert any(f"set acquisition.rate_hz = {hz:g}" in notice.text for notice in record.notices)


@pytest.mark.promise(
    "damaged frames of a device without a counter", "check sums wrong, lines cut", "the gap where they were"
)
def test_a_damaged_frame_leaves_its_gap_where_it_was() -> None:
    """Bursts of four frames with the time of their end: only the damaged line says which one is missing."""
    decoder = MappedDecoder(LinkStats(), NESTED, {"a": "A.S"}, Expected(100.0))
    record, lost = Record(ramp=False), set(range(3, 390, 25))
    for burst in range(100):
        for k in range(4 * burst, 4 * burst + 4):
            if k in lost:
                decoder.cause("crc")
            else:
                record.take(decoder.feed(CanFrames.build([(768, struct.pack("<h", k), 40 * MS * (burst + 1))]), 0))
    assert {(gap.index, gap.count, gap.reason) for gap in record.gaps} == {(k, 1, "crc") for k in lost}


def test_what_came_is_said_when_no_sample_is_complete() -> None:
    signals = {"x": "ACS.Lateral"}
    for frames, text in (
        ([], "holds no frame"), ([(0x123, b"12", 0)], "of 0x123, and none of ACS"),
        ([(0x4FF0319 | EXTENDED_FLAG, bytes(8), 0)], "of 0x4FF0319, and none"),
    ):  # fmt: skip
        decoder = MappedDecoder(LinkStats(), DBC, signals, Expected(100.0))
        decoder.feed(CanFrames.build(frames), 0, final=True)
        assert text in decoder.nothing()
    decoder = MappedDecoder(LinkStats(), NESTED, {"a": "A.S"})
    decoder.feed(CanFrames.build([(768 | EXTENDED_FLAG, bytes(8), 0)]), 0, final=True)
    assert "29-bit identifier" in decoder.nothing()
    decoder = MappedDecoder(LinkStats(), DBC.replace(b" 3;", b" 1;"), signals)
    decoder.feed(CanFrames.build([(0x08F02D0B | EXTENDED_FLAG, bytes(8), 0)]), 0, final=True)
    assert "J1939" in decoder.nothing()


def test_frames_that_were_held_up_wait_and_the_reason_is_said() -> None:
    """Three seconds of frames at once: whether one is missing shows when they come at their pace again."""
    decoder, prompt = MappedDecoder(LinkStats(), DBC, {"x": "ACS.Lateral"}, Expected(100.0)), range(400)
    frame = struct.pack("<4H", 32000, 32000, 32000, 0xFFFF)
    times = [10 * MS * k for k in prompt] + [(6990 + k // 50) * MS for k in range(300)]
    frames = [(0x08F02D0B | EXTENDED_FLAG, frame, t_ns) for t_ns in times]
    out = decoder.feed(CanFrames.build(frames[:600]), times[599])
    assert sum(len(r.counts) for r in out if isinstance(r, Block)) == 400
    assert "held up" in decoder.nothing()
    more = [(0x08F02D0B | EXTENDED_FLAG, frame, (7000 + 10 * k) * MS) for k in range(400)]
    out = decoder.feed(CanFrames.build(frames[600:] + more), more[-1][2])
    assert sum(len(r.counts) for r in out if isinstance(r, Block)) == 700
    assert decoder.stats.lost_samples == 0


def test_what_was_held_comes_with_the_first_read_after_the_close() -> None:
    """Frames that came at once wait for an even second; a stop that comes before it must not lose them."""
    driver = make_driver(CanConfig("virtual", "held"), dbc=DBC, signals={"x": "JN2300.X"}, expected=Expected(200.0))
    driver.open()
    sender = can.Bus("held", interface="virtual", preserve_timestamps=True)
    for k in range(900):
        at_s = k / 200 if k < 598 else 3.02 + k * 1e-6 if k < 600 else 4.5 + k * 1e-6
        data = struct.pack("<3h", k, 0, 0)
        sender.send(can.Message(arbitration_id=0x04FF0319, data=data, timestamp=1000 + at_s))
    record = read_until(driver, Record(ramp=False), lambda r: r.samples >= 590)
    assert driver.read(0.2) == []
    driver.close()
    record.take(driver.read(0.0))
    assert driver.read(0.0) == []
    sender.shutdown()
    assert record.samples == 900
    assert not record.gaps


@pytest.mark.parametrize("hz", [100.0, None])
def test_at_a_stop_before_the_rate_is_measured_that_of_the_rig_file_is_taken(hz: float | None) -> None:
    """Reads at random for five seconds: all samples were lost at the stop."""
    decoder = MappedDecoder(LinkStats(), DBC, {"x": "ACS.Lateral"}, None if hz is None else Expected(hz))
    frame = (0x08F02D0B | EXTENDED_FLAG, struct.pack("<4H", 32000, 32000, 32000, 0xFFFF))
    reads_s = np.cumsum(np.random.default_rng(0).exponential(0.3, 40))
    out: list[Reading] = []
    for k in range(500):
        at_ns = round(reads_s[np.searchsorted(reads_s, k / 100)] * 1e9)
        out += decoder.feed(CanFrames.build([(*frame, at_ns)]), at_ns)
    assert not any(isinstance(r, Block) for r in out)
    held = decoder.finish(at_ns)
    assert sum(len(r.counts) for r in held if isinstance(r, Block)) == (0 if hz is None else 500)
    assert {r.rate_hz for r in held if isinstance(r, Info)} <= {hz}


@pytest.mark.promise(
    "clock of the computer is set, a device without a counter on SocketCAN",
    "the kernel's stamps leap by 0.3 s, an hour, two days, and back",
    "no loss is invented, no index shifts, and it is said",
)
@pytest.mark.parametrize(
    "jumps", [[(20, 3600.0)], [(20, 0.3)], [(20, -3600.0), (40, 3600.0)], [(20, 3600.0), (30, -2 * 86_400.0)]]
)
def test_stamps_of_a_clock_that_is_set_shift_nothing(jumps: list[tuple[int, float]]) -> None:
    """An hour forwards was counted as 360 000 samples lost."""
    decoder, out = MappedDecoder(LinkStats(), DBC, {"x": "ACS.Lateral"}, Expected(100.0)), list[Reading]()
    rng, kept = np.random.default_rng(0), np.delete(np.arange(6000), [1000, 3500, 5000])
    late_ns = 0
    for k in kept.tolist():
        late_ns = int(rng.exponential(2e-3) * 1e9) if k % 997 else 300 * MS
        stamp = 10**18 + 10 * MS * k + sum(round(by * 1e9) for at, by in jumps if k > 100 * at)
        frame = struct.pack("<4H", 32000 + k, 32000, 32000, 0xFFFF)
        out += decoder.feed(CanFrames.build([(0x08F02D0B | EXTENDED_FLAG, frame, stamp)]), 10 * MS * k + late_ns)
    assert {g.index for g in out if isinstance(g, Gap)} == {1000, 3500, 5000}
    assert decoder.stats.lost_samples == 3
    codes = [n.code for n in out if isinstance(n, Notice)]
    assert codes.count("clock_set_forwards") == sum(by > 0 for _, by in jumps)
    assert codes.count("clock_set_back") == sum(by < 0 for _, by in jumps)
