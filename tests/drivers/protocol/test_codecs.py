"""The pure codecs: any split gives the same, garbage never raises, memory is bounded, the next good frame is found."""

from __future__ import annotations

import zlib

import can
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.can.can_frames import EXTENDED_FLAG, REMOTE_FLAG
from drivers.can.slcan_codec import FD_LENGTHS, MAX_LINE, SlcanCodec, encode_line
from drivers.serial import cobs

BODIES = st.lists(st.binary(min_size=1, max_size=600), min_size=1, max_size=8)
CUTS = st.lists(st.integers(0, 3000), max_size=12)


def pieces(wire: bytes, cuts: list[int]) -> list[bytes]:
    at = sorted({min(cut, len(wire)) for cut in cuts})
    return [wire[a:b] for a, b in zip([0, *at], [*at, len(wire)], strict=True)]


def bodies_of(deframer: cobs.Deframer, chunks: list[bytes]) -> list[bytes | None]:
    out: list[bytes | None] = []
    for chunk in chunks:
        found = deframer.feed(chunk)
        out += [
            None if stop < 0 else found.data[start:stop].tobytes()
            for start, stop in zip(found.starts, found.stops, strict=True)
        ]
    return out


def peek(deframer: cobs.Deframer) -> int:
    return len(deframer._tail)


@given(BODIES, CUTS)
def test_serial_round_trip_at_any_split(bodies: list[bytes], cuts: list[int]) -> None:
    wire = b"".join(cobs.encode(body) for body in bodies)
    assert bodies_of(cobs.Deframer(), pieces(wire, cuts)) == bodies


@given(st.binary(max_size=3000), CUTS, st.binary(min_size=1, max_size=300))
def test_serial_garbage_then_a_good_frame(garbage: bytes, cuts: list[int], body: bytes) -> None:
    deframer = cobs.Deframer()
    found = bodies_of(deframer, [*pieces(garbage, cuts), b"\0", cobs.encode(body)])
    assert found[-1] == body
    assert peek(deframer) <= cobs.MAX_FRAME


@given(st.lists(st.binary(max_size=9000), max_size=6))
def test_serial_memory_is_bounded(chunks: list[bytes]) -> None:
    deframer = cobs.Deframer()
    for chunk in chunks:
        deframer.feed(chunk.replace(b"\0", b"\1"))
        assert peek(deframer) <= cobs.MAX_FRAME


@given(st.binary(min_size=1, max_size=300), st.integers(0, 10_000))
def test_one_flipped_bit_never_passes(body: bytes, bit: int) -> None:
    wire = bytearray(cobs.encode(body))
    at = bit % (8 * (len(wire) - 1))
    wire[at // 8] ^= 1 << at % 8
    found = bodies_of(cobs.Deframer(), [b"\0", cobs.encode(b"first"), bytes(wire)])
    assert found[0] == b"first"
    assert body not in found[1:]


@given(st.binary(max_size=2000))
@example(b"\0" * 600)
@example(b"\1" * 254)
@example(b"\1" * 508 + b"\0")
def test_compiled_cobs_and_crc_equal_plain_ones(data: bytes) -> None:
    out = bytearray()
    for k, piece in enumerate(pieces_of := data.split(b"\0")):
        while len(piece) >= 254:
            out += b"\xff" + piece[:254]
            piece = piece[254:]
            if not piece and k == len(pieces_of) - 1:
                break
        else:
            out += bytes((len(piece) + 1,)) + piece
    assert cobs.stuff(data) == bytes(out)
    frame = cobs.stuff(data + zlib.crc32(data).to_bytes(4, "little")) + b"\0"
    assert bodies_of(cobs.Deframer(), [b"\0", frame]) == ([data] if data else [])


def test_overlong_frame_is_dropped_unseen() -> None:
    deframer = cobs.Deframer()
    bodies_of(deframer, [cobs.encode(b"x")])
    long = cobs.encode(bytes(5000))
    assert bodies_of(deframer, [long, cobs.encode(b"y")]) == [None, b"y"]
    assert bodies_of(deframer, [*pieces(long, list(range(0, 5000, 100))), cobs.encode(b"z")]) == [None, b"z"]


def test_first_torn_frame_is_no_error() -> None:
    wire = cobs.encode(bytes(100))
    assert bodies_of(cobs.Deframer(), [wire[30:] + cobs.encode(b"x")]) == [b"x"]


FRAMES = st.lists(
    st.tuples(st.integers(0, 0x7FF), st.booleans(), st.booleans(), st.sampled_from(FD_LENGTHS), st.randoms()),
    min_size=1, max_size=8,
)  # fmt: skip


def lines_of(codec: SlcanCodec, chunks: list[bytes]) -> tuple[list[tuple[int, bytes]], int]:
    out, bad = [], 0
    for chunk in chunks:
        lines = codec.feed(chunk, 0)
        bad += int(lines.damaged.sum())
        out += [
            (int(i), row[:n].tobytes())
            for i, n, row in zip(lines.frames.ids, lines.frames.lengths, lines.frames.payload, strict=True)
        ]
    return out, bad


@given(FRAMES, CUTS, st.sampled_from([None, 12_345]))
def test_slcan_round_trip_at_any_split(frames: list, cuts: list[int], stamp: int | None) -> None:
    want, wire = [], b""
    for identifier, extended, fd, length, random in frames:
        data = random.randbytes(length if fd else min(length, 8))
        number = identifier | (EXTENDED_FLAG if extended else 0)
        want.append((number, data))
        wire += encode_line(number, data, fd, brs=length % 2 == 0, stamp_ms=stamp)
    assert lines_of(SlcanCodec(), pieces(wire, cuts)) == (want, 0)


@given(st.binary(max_size=2000), CUTS)
def test_slcan_garbage_then_a_good_line(garbage: bytes, cuts: list[int]) -> None:
    codec = SlcanCodec()
    good = encode_line(0x123, b"\1\2\3", fd=False)
    found, _ = lines_of(codec, [*pieces(garbage, cuts), b"\r", *[good] * 9])
    assert found[-1] == (0x123, b"\1\2\3")
    assert len(codec._tail) <= MAX_LINE


@given(st.lists(st.binary(max_size=1000), max_size=6))
def test_slcan_memory_is_bounded(chunks: list[bytes]) -> None:
    codec = SlcanCodec()
    for chunk in chunks:
        codec.feed(chunk.replace(b"\r", b"0"), 0)
        assert len(codec._tail) <= MAX_LINE


@pytest.mark.parametrize(
    "line",
    [
        b"t1238112233445566778G",  # bad hex: kills python-can's Notifier thread
        b"t12381122334455667",  # a digit short
        b"t123811223344556677",  # a byte short: python-can takes it as dlc 8 with 7 bytes
        b"t123911223344556677889",  # dlc 9 on classic CAN
        b"t8008" + b"00" * 8,  # identifier beyond 11 bits
        b"T200000008" + b"00" * 8,  # beyond 29 bits
        b"t1238112233445566778899",  # a byte too many
        b"b123F" + b"00" * 63,  # FD, a byte short
        b"t", b"t12", b"hello world",
    ],
)  # fmt: skip
def test_slcan_damaged_line_is_counted_and_passed_over(line: bytes) -> None:
    codec = SlcanCodec()
    good = encode_line(0x123, bytes(8), fd=False)
    found, bad = lines_of(codec, [good + line + b"\r" + good])
    assert found == [(0x123, bytes(8))] * 2
    assert bad == 1


@pytest.mark.promise(
    "a lost line end of a serial CAN adapter", "with and without stamps, at any split", "both frames read"
)
@pytest.mark.parametrize("stamp_ms", [None, 0x1234])
@given(cuts=CUTS)
def test_slcan_a_line_end_that_is_lost_costs_no_frame(stamp_ms: int | None, cuts: list[int]) -> None:
    want = [(0x100 + k, bytes([k] * (k % 9))) for k in range(12)] + [
        (0x18FF0001 | EXTENDED_FLAG, bytes(8)),
        (0x100, b""),
    ]
    lines = [encode_line(number, data, fd=False, stamp_ms=stamp_ms) for number, data in want]
    wire = b"".join(line[:-1] if k in (3, 7, 8, 11, 12) else line for k, line in enumerate(lines))
    assert lines_of(SlcanCodec(), pieces(wire, cuts)) == (want, 0)


def test_slcan_time_stamps_are_used() -> None:
    codec = SlcanCodec()
    codec.feed(encode_line(1, b"", False, stamp_ms=59_990), 1_000_000_000)
    lines = codec.feed(b"".join(encode_line(1, b"", False, stamp_ms=59_990 + 5 * k) for k in (1, 2, 4)), 1_500_000_000)
    assert (np.diff(lines.frames.t_ns) / 1e6).tolist() == [5.0, 10.0]


def stamped_line(stamp_ms: int) -> bytes:
    return encode_line(1, b"", False)[:-1] + f"{stamp_ms:04X}\r".encode()


@pytest.mark.parametrize("modulus", [60_000, 65_536])
@pytest.mark.parametrize("batch", [1, 50])
def test_slcan_stamps_wrap_at_a_minute_or_at_16_bits(modulus: int, batch: int) -> None:
    """Twice, 10 ms apart."""
    codec, times = SlcanCodec(), []
    stamps = [(58_000 + 10 * k) % modulus for k in range(14_000)]
    for k in range(0, len(stamps), batch):
        wire = b"".join(stamped_line(each) for each in stamps[k : k + batch])
        times += codec.feed(wire, 10_000_000 * (k + batch)).frames.t_ns.tolist()
    assert set(np.diff(times).tolist()) == {10_000_000}


@pytest.mark.parametrize("modulus", [60_000, 65_536])
def test_slcan_stamps_that_wrapped_in_a_silence(modulus: int) -> None:
    codec = SlcanCodec()
    first = codec.feed(stamped_line(50_000), 0).frames.t_ns[0]
    after = codec.feed(stamped_line((50_000 + 30_000) % modulus), 30_100_000_000).frames.t_ns[0]
    assert (after - first) / 1e6 == 30_000


@pytest.mark.parametrize("end", [b"\r", b"\r\n", b"\n"])
@given(cuts=CUTS)
def test_slcan_line_ends_of_any_kind(end: bytes, cuts: list[int]) -> None:
    wire = b"".join(encode_line(k, bytes(k), fd=False)[:-1] + end for k in range(9))
    assert lines_of(SlcanCodec(), pieces(wire, cuts)) == ([(k, bytes(k)) for k in range(9)], 0)


def test_slcan_stamp_cannot_pass_for_data() -> None:
    """Two bytes lost from a stamped line look like a whole line without a stamp."""
    codec = SlcanCodec()
    stamped = encode_line(0x123, bytes(8), fd=False, stamp_ms=1)
    found, bad = lines_of(codec, [stamped, stamped[:5] + stamped[9:], stamped])
    assert len(found) == 2
    assert bad == 1


def test_slcan_replies_are_no_frames() -> None:
    lines = SlcanCodec().feed(b"\r\rz\rV1013\r\x07F00\r" + encode_line(1, b"", False), 0)
    assert (len(lines.frames), lines.replies, lines.refused, int(lines.damaged.sum())) == (1, 3, 1, 0)


def test_slcan_remote_frames_have_no_data() -> None:
    lines = SlcanCodec().feed(b"r1238\rR000001234\r", 0)
    assert lines.frames.ids.tolist() == [0x123 | REMOTE_FLAG, 0x123 | REMOTE_FLAG | EXTENDED_FLAG]
    assert lines.frames.lengths.tolist() == [0, 0]


@settings(max_examples=50)
@given(FRAMES)
def test_slcan_lines_equal_what_python_can_sends(frames: list) -> None:
    """python-can's own encoder is the oracle, over a loop:// port."""
    bus = can.Bus("loop://", interface="slcan", sleep_after_open=0, bitrate=None)
    try:
        bus.serialPortOrig.reset_input_buffer()
        bus.serialPortOrig.timeout = 10.0  # python-can's is 0.1 s, which a busy machine exceeds
        for identifier, extended, fd, length, random in frames:
            data = random.randbytes(length if fd else min(length, 8))
            bus.send(can.Message(arbitration_id=identifier, is_extended_id=extended, data=data, is_fd=fd,
                                 bitrate_switch=fd))  # fmt: skip
            wire = bus.serialPortOrig.read(bus.serialPortOrig.in_waiting)
            assert encode_line(identifier | (EXTENDED_FLAG if extended else 0), data, fd) == wire
    finally:
        bus.shutdown()
