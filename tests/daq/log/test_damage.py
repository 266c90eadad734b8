"""Cut, flipped and footerless logs: never a wrong number, all that is intact; and recovery bit for bit."""

from __future__ import annotations

import json
import re
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from sessions import RIG_TEXT, counts_at, make_block, make_estimate, make_info, make_session, make_stream, truth

from daq.base.console.file_kinds import LOG_MAGIC
from daq.base.contract.dates import Recorded
from daq.base.contract.errors import LogError
from daq.commands.files.facts import info
from daq.log import codec as codec
from daq.log.encoder import LogEncoder
from daq.log.file import LogFile
from daq.log.reader import Recording, read_log
from daq.log.recover import recover
from daq.log.scan import SIGNATURE_AT, ZSTD_SIGNATURE
from drivers.contract.reading import Block, Gap, Info, Notice

SCHEMAS = Path(__file__).parents[2] / "data" / "schemas"
STREAM = make_stream(60, 200)
FIRST, COUNTS = truth(STREAM)
SCALE = np.array([s.scale for s in make_info().signals])
Property = Callable[[str, object], None]
PROMISED = "no wrong number, every intact chunk read, every hole a gap"
FLUSH_EVERY = 6  # readings, so that the file has about ten chunks


class Bytes(bytes):
    """So that a failing example is readable."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes>"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Bytes:
    """A log of many chunks, written without threads so that it is always the same."""
    file = LogFile(tmp_path_factory.mktemp("whole") / "whole.mcap")
    encoder = LogEncoder(file)
    encoder.start(make_session(), 1_700_000_000 * 10**9)
    for k, reading in enumerate(STREAM):
        encoder.reading(reading)
        if k % 10 == 9 and isinstance(reading, Block):
            encoder.estimate(make_estimate(reading.index))
        if k % FLUSH_EVERY == 0:
            encoder.flush()
    encoder.finish()
    file.push()
    file.close()
    return Bytes(file.path.read_bytes())


def assert_only_truth(log: Recording) -> int:
    """Every number in the log is right, wherever it is; the number of samples."""
    counts, samples = log.counts(), log.samples()
    assert FIRST <= log.first <= log.stop <= FIRST + len(COUNTS)
    expected = COUNTS[log.first - FIRST : log.stop - FIRST]
    there = counts[:, 0] != np.iinfo(np.int32).min
    np.testing.assert_array_equal(counts[there], expected[there])
    np.testing.assert_array_equal(samples[there], expected[there] * SCALE)
    assert np.isnan(samples[~there]).all()
    assert there.sum() == log.n_samples
    for logged in log.estimates:
        assert codec.encode_estimate(logged.estimate) == codec.encode_estimate(make_estimate(logged.estimate.index))
    for notice in log.notices:
        assert notice == next(r for r in STREAM if isinstance(r, Notice))
    assert log.rate_hz == 25600.0
    assert log.info == make_info()
    if "rig.toml" in log.attachments:
        assert log.rig_text == RIG_TEXT
    missing: NDArray[np.bool_] = np.zeros(log.stop - log.first, bool)
    for gap in log.gaps:
        missing[gap.index - log.first : gap.index - log.first + gap.count] = True
    np.testing.assert_array_equal(missing, ~there)  # every lost sample is in a gap
    return log.n_samples


def read(path: Path, data: bytes) -> Recording | None:
    path.write_bytes(data)
    try:
        return read_log(path)
    except LogError as error:
        message = str(error)
    assert "\n" not in message
    assert str(path) in message
    return None


def test_the_whole_log_is_whole(tmp_path: Path, whole: Bytes) -> None:
    log = read(tmp_path / "a.mcap", whole)
    assert log is not None
    assert log.complete
    assert assert_only_truth(log) == len(COUNTS) - 107


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1))
def test_cut_anywhere(tmp_path: Path, whole: Bytes, record_property: Property, share: float) -> None:
    record_property("reliability", f"cut log | cut at 120 random places | {PROMISED} | held")
    length = int(share * (len(whole) - 1))
    log = read(tmp_path / "a.mcap", whole[:length])
    if log is None:
        assert length < len(whole) * 0.2  # before the first chunk with samples is whole
        return
    assert not log.complete
    samples = assert_only_truth(log)
    assert samples >= (len(COUNTS) - 107) * (length / len(whole) - 0.2)


def test_a_record_of_false_length_swallows_no_chunk(tmp_path: Path, whole: Bytes) -> None:
    damaged = bytearray(whole)
    damaged[55] ^= 1
    damaged[8 + 1 + 2] ^= 1  # 64 KiB longer: the header's length has no checksum
    log = read(tmp_path / "a.mcap", bytes(damaged))
    assert log is not None
    assert not log.complete
    assert assert_only_truth(log) >= (len(COUNTS) - 107) * 0.8


def test_a_chunk_of_false_packed_size_costs_itself_alone(tmp_path: Path, whole: Bytes) -> None:
    damaged = bytearray(whole)
    damaged[whole.index(ZSTD_SIGNATURE) + len(ZSTD_SIGNATURE) + 2] ^= 1  # 64 KiB longer
    log = read(tmp_path / "a.mcap", bytes(damaged))
    assert log is not None
    assert assert_only_truth(log) >= (len(COUNTS) - 107) * 0.8


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_bits_flipped(tmp_path: Path, whole: Bytes, record_property: Property, data: st.DataObject) -> None:
    record_property("reliability", f"flipped bits | 1 to 4 bits flipped, 250 times | {PROMISED} | held")
    damaged = bytearray(whole)
    for at in data.draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=4)):
        damaged[at] ^= 1 << data.draw(st.integers(0, 7))
    log = read(tmp_path / "a.mcap", bytes(damaged))
    assert log is not None  # one bit costs a chunk, never the log
    samples = assert_only_truth(log)
    assert samples >= (len(COUNTS) - 107) * 0.4
    assert log.complete == (damaged == whole)  # also where the byte is part of no sample
    assert log.complete or log.damage


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(number=st.floats(0, 1, exclude_max=True), at=st.integers(0, 8), bit=st.integers(0, 7))
def test_a_chunk_whose_kind_or_length_is_damaged_is_read(
    tmp_path: Path, whole: Bytes, number: float, at: int, bit: int
) -> None:
    """Its content has a checksum of its own. As the end of the file, or as another kind, it hid what follows."""
    starts = [m.start() - SIGNATURE_AT for m in re.finditer(re.escape(ZSTD_SIGNATURE), whole)]
    damaged = bytearray(whole)
    damaged[starts[int(number * len(starts))] + at] ^= 1 << bit
    log = read(tmp_path / "a.mcap", bytes(damaged))
    assert log is not None
    assert not log.complete
    assert assert_only_truth(log) == len(COUNTS) - 107


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.floats(0, 1), length=st.integers(1, 4000), junk=st.binary(max_size=3000))
def test_a_piece_overwritten_or_taken_out(
    tmp_path: Path, whole: Bytes, record_property: Property, at: float, length: int, junk: bytes
) -> None:
    record_property("reliability", f"overwritten log | junk at 80 random places | {PROMISED} | held")
    start = int(at * len(whole))
    log = read(tmp_path / "a.mcap", whole[:start] + junk + whole[start + length :])
    if log is not None:
        assert_only_truth(log)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(order=st.permutations(range(8)))
def test_pieces_in_another_order(tmp_path: Path, whole: Bytes, order: list[int]) -> None:
    size = len(whole) // 8 + 1
    log = read(tmp_path / "a.mcap", b"".join(whole[k * size : (k + 1) * size] for k in order))
    if log is not None:
        assert_only_truth(log)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.3, 0.99), flip=st.floats(0, 1))
def test_recovery_is_bit_for_bit_and_whole_again(tmp_path: Path, whole: Bytes, share: float, flip: float) -> None:
    damaged = bytearray(whole[: int(share * len(whole))])
    damaged[int(flip * (len(damaged) - 1))] ^= 0x10
    before = read(tmp_path / "cut.mcap", bytes(damaged))
    assert before is not None
    recovery = recover(tmp_path / "cut.mcap", tmp_path / "mended.mcap")
    after = read_log(tmp_path / "mended.mcap")
    assert after.complete
    assert recovery.samples == before.n_samples == after.n_samples
    np.testing.assert_array_equal(after.counts(), before.counts())
    assert after.gaps == before.gaps
    assert [e.data for e in after.estimates] == [e.data for e in before.estimates]
    assert after.attachments == before.attachments
    assert after.metadata == before.metadata
    assert after.notices[:-1] == before.notices
    assert after.notices[-1].code == "recovered"
    assert recovery.lost in after.notices[-1].text
    assert "at most the last second" in recovery.lost
    jsonschema.validate(recovery.to_json(), json.loads((SCHEMAS / "recover.json").read_text()))
    jsonschema.validate(info(after), json.loads((SCHEMAS / "info.json").read_text()))


def test_recovery_of_a_whole_log_and_its_mistakes(tmp_path: Path, whole: Bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(whole)
    assert recover(tmp_path / "a.mcap", tmp_path / "b.mcap").lost == "nothing: the log was complete and intact"
    with pytest.raises(LogError, match="choose another --out"):
        recover(tmp_path / "a.mcap", tmp_path / "a.mcap")
    (tmp_path / "none.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(LogError, match="nothing in it is intact"):
        recover(tmp_path / "none.mcap", tmp_path / "c.mcap")
    with pytest.raises(LogError, match="cannot write"):
        recover(tmp_path / "a.mcap", tmp_path / "no" / "folder.mcap")


@pytest.mark.parametrize(
    ("name", "remedy"), [("my.toml", "is a rig file by its ending, and no log: rotorscope check"),
                         ("device.dbc", "is a DBC by its ending, and no log: rotorscope init --from")]
)  # fmt: skip
def test_a_file_of_another_kind_is_named_with_the_command_that_takes_it(tmp_path: Path, name: str, remedy: str) -> None:
    (tmp_path / name).write_text('[rig]\nname = "a"\n')
    with pytest.raises(LogError, match=remedy):
        read_log(tmp_path / name)


def test_every_chunk_can_be_read_alone(tmp_path: Path) -> None:
    """Also those that ended because they were full, as behind a slow disk."""
    file = LogFile(tmp_path / "a.mcap")
    encoder = LogEncoder(file)
    encoder.start(make_session(), 0)
    for k in range(400):
        encoder.reading(make_block(256 * k, 256))
    encoder.finish()
    file.push()
    file.close()
    data = (tmp_path / "a.mcap").read_bytes()
    starts = [m.start() - SIGNATURE_AT for m in re.finditer(re.escape(ZSTD_SIGNATURE), data)]
    alone = [read(tmp_path / "b.mcap", LOG_MAGIC + data[a:b]) for a, b in pairwise([*starts, len(data)])]
    assert len(alone) > 3
    assert sum(log.n_samples for log in alone if log is not None) == 400 * 256


def test_a_lost_chunk_is_a_gap_that_says_so(tmp_path: Path, whole: Bytes) -> None:
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 1
    log = read(tmp_path / "a.mcap", bytes(damaged))
    assert log is not None
    holes = [g for g in log.gaps if g.reason == "log"]
    assert len(holes) == 1
    assert any("damaged chunk" in line for line in log.damage)
    recovery = recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert f"{holes[0].count} samples in 1 damaged places ({holes[0].count} from {holes[0].index})" in recovery.lost


def test_info_fits_its_schema(tmp_path: Path, whole: Bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(whole)
    out = info(read_log(tmp_path / "a.mcap"))
    jsonschema.validate(out, json.loads((SCHEMAS / "info.json").read_text()))
    assert out["complete"]
    assert out["lost_samples"] == 107
    assert out["gaps"][0] == {"index": Gap(FIRST + 20 * 200, 37, "crc").index, "count": 37, "reason": "crc"}


def test_hostile_sizes_allocate_nothing(tmp_path: Path, record_property: Property) -> None:
    """A chunk that claims to unpack to 4 GiB, a record longer than the file, and a megabyte of false chunk starts."""
    import struct

    import zstandard

    bomb = zstandard.compress(bytes(200 << 20))
    chunk = struct.pack("<QQQII4sQ", 0, 0, 200 << 20, 0, 4, b"zstd", len(bomb)) + bomb
    half = zstandard.compress(bytes(63 << 20))
    half = struct.pack("<QQQII4sQ", 0, 0, 63 << 20, zlib.crc32(bytes(63 << 20)), 4, b"zstd", len(half)) + half
    record = struct.pack("<BQHIQQ", 5, 22, 8, 0, 0, 0)
    many = record * (10_000_000 // len(record))
    small = zstandard.compress(many)
    small = struct.pack("<QQQII4sQ", 0, 0, len(many), zlib.crc32(many), 4, b"zstd", len(small)) + small
    begin = time.process_time()
    for body in (
        (struct.pack("<BQ", 6, len(half)) + half) * 16,  # a gigabyte in 40 kB
        (struct.pack("<BQ", 6, len(small)) + small) * 16,  # five million messages of nothing
        struct.pack("<BQ", 6, len(chunk)) + chunk,
        struct.pack("<BQ", 6, 2**63) + bytes(100),
        (struct.pack("<BQ", 6, 1 << 20) + bytes(28) + b"\x04\x00\x00\x00zstd") * 20_000,
    ):
        assert read(tmp_path / "a.mcap", b"\x89MCAP0\r\n" + body) is None
    assert time.process_time() - begin < 10
    row = "hostile log | zip bombs, an endless record, 20 000 false chunk starts | one line, bounded memory and time"
    record_property("reliability", f"{row} | held")


def test_the_test_data_do_not_repeat() -> None:
    assert len(np.unique(counts_at(0, 5000)[:, 0])) > 3000


def test_a_chunk_holds_at_most_a_second_also_of_an_import(tmp_path: Path) -> None:
    for recorded in (None, Recorded()):
        file = LogFile(tmp_path / "a.mcap")
        encoder = LogEncoder(file, recorded)
        info = Info(make_info().signals, 100.0)
        encoder.start(replace(make_session(), info=info), 0)
        width = len(info.signals)
        rows = 5000 if recorded else 30
        for k in range(15000 // rows):
            encoder.reading(Block(k * rows, np.ones((rows, width), np.int32), 10**18 + k))
        encoder.finish()
        file.push()
        file.close()
        data = (tmp_path / "a.mcap").read_bytes()
        starts = [m.start() - SIGNATURE_AT for m in re.finditer(re.escape(ZSTD_SIGNATURE), data)]
        damaged = bytearray(data)
        damaged[starts[70] + 80] ^= 1
        log = read(tmp_path / "b.mcap", bytes(damaged))
        assert log is not None
        assert 0 < log.lost_samples <= 100
