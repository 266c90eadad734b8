"""A part of a log: the same samples as the whole has there, and a cost that does not grow with the log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sessions import RATE_HZ, make_block, make_info, make_session, make_stream, truth

from daq.base.contract.errors import ConfigError
from daq.base.contract.part import Part
from daq.log.encoder import LogEncoder
from daq.log.file import LogFile
from daq.log.reader import read_log
from daq.log.recover import recover
from drivers.contract.reading import Block, Info, Reading, Signal

WIRE_STREAM = make_stream(90, 600)  # 430 kB
FIRST_INDEX, TRUE_COUNTS = truth(WIRE_STREAM)
WALL_NS = 1_700_000_000 * 10**9
SIGNAL_NAMES = [s.name for s in make_info().signals]


def write(path: Path, stream: list[Reading], flush_every: int = 6) -> Path:
    file = LogFile(path)
    encoder = LogEncoder(file)
    encoder.start(make_session(), WALL_NS)
    for k, reading in enumerate(stream):
        encoder.reading(reading)
        if k % flush_every == 0:
            encoder.flush()
    encoder.finish()
    file.push()
    file.keep()
    file.close()
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Whole; cut; with a damaged chunk; recovered, in which not every chunk can be read alone."""
    folder = tmp_path_factory.mktemp("part")
    whole = write(folder / "whole.mcap", WIRE_STREAM)
    cut, hurt = folder / "cut.mcap", folder / "hurt.mcap"
    data = bytearray(whole.read_bytes())
    cut.write_bytes(data[: len(data) * 3 // 4])
    data[len(data) // 2] ^= 4
    hurt.write_bytes(data)
    recover(hurt, folder / "mended.mcap")
    return [whole, cut, hurt, folder / "mended.mcap"]


@pytest.mark.promise(
    "a part of a log, whole, cut, damaged or recovered",
    "60 random parts and channels",
    "bit for bit what the whole holds there",
)
@settings(max_examples=60)
@given(st.integers(0, 3), st.integers(0, len(TRUE_COUNTS) - 2), st.integers(1, 20_000), st.sets(st.integers(0, 3)))
def test_a_part_holds_what_the_whole_holds_there(logs: list[Path], log: int, row: int, rows: int, of: set[int]) -> None:
    whole, names = read_log(logs[log]), tuple(SIGNAL_NAMES[k] for k in sorted(of))
    part = Part(from_s=row / RATE_HZ, seconds=rows / RATE_HZ, channels=names)
    columns = sorted(of) or [0, 1, 2, 3]
    stop = min(row + rows, whole.stop - whole.first)
    if row >= stop:
        with pytest.raises(ConfigError, match="is .* s long"):
            read_log(whole.path, part=part)
        return
    got = read_log(whole.path, part=part)
    expected = whole.counts()[row:stop, columns]
    shift = got.first - whole.first - row  # a damaged place at the start of the part is no gap of the part
    assert shift >= 0
    assert (expected[:shift] == np.iinfo(np.int32).min).all()
    assert got.channels == tuple(SIGNAL_NAMES[k] for k in columns)
    there = got.counts()
    np.testing.assert_array_equal(there, expected[shift : shift + len(there)])
    assert (expected[shift + len(there) :] == np.iinfo(np.int32).min).all()
    np.testing.assert_array_equal(got.samples(), whole.samples()[row + shift : row + shift + len(there)][:, columns])
    assert got.n_samples + got.lost_samples == len(there)
    again = [r for joined in (True, False) for r in got.readings(joined) if isinstance(r, Block)]
    assert sum(len(b.counts) for b in again) == 2 * got.n_samples
    if whole.started_ns is not None and got.n_samples and got.started_ns is not None:
        assert abs(got.started_ns - whole.started_ns - (row + shift) * 1e9 / RATE_HZ) < 1e6


@pytest.mark.parametrize("log", range(4))
def test_a_part_by_date_is_the_part_by_time(logs: list[Path], log: int) -> None:
    started_ns = read_log(logs[log]).started_ns
    assert started_ns is not None
    dated = read_log(logs[log], part=Part(from_ns=started_ns + 10**8, to_ns=started_ns + 2 * 10**8))
    timed = read_log(logs[log], part=Part(from_s=0.1, to_s=0.2))
    assert (dated.first, dated.stop) == (timed.first, timed.stop)


def test_a_date_is_that_of_the_host_where_the_devices_clock_drifts(tmp_path: Path) -> None:
    stream: list[Reading] = []
    for k in range(4000):  # 80 s of a device that is 0.1 % slow
        block = make_block(512 * k, 512)
        stream.append(replace(block, t_host_ns=10**12 + round((block.index + 512) * 1.001e9 / RATE_HZ)))
    log = write(tmp_path / "a.mcap", stream, flush_every=50)
    started_ns = read_log(log).started_ns
    assert started_ns is not None
    part = read_log(log, part=Part(from_ns=started_ns + 60 * 10**9, seconds=1.0))
    assert part.first == pytest.approx(60 / 1.001 * RATE_HZ, abs=5)
    assert part.started_ns == pytest.approx(started_ns + 60 * 10**9, abs=3e5)
    assert part.stop - part.first == RATE_HZ


def test_a_short_piece_of_a_long_log_costs_as_much_as_of_a_short_one(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    read_bytes, size = {}, {}
    for blocks in (400, 6400):
        log = write(tmp_path / "a.mcap", [make_block(512 * k, 512) for k in range(blocks)], flush_every=20)
        before = _read_bytes()
        part = read_log(log, part=Part(from_s=0.6 * blocks * 512 / RATE_HZ, seconds=0.1))
        part.samples()
        read_bytes[blocks] = _read_bytes() - before
        size[blocks] = log.stat().st_size
        assert part.n_samples == 2560
        assert part.complete
        assert part.findings.chunks < 40
    measured = " and ".join(f"{read_bytes[n] / 1e6:.1f} of {size[n] / 1e6:.1f} MB" for n in size)
    row = "0.1 s from the middle of a log | of 8 and 128 s | the cost does not grow with the log"
    record_property("reliability", f"{row} | {measured} read")
    assert read_bytes[6400] < 5e6 < 0.3 * log.stat().st_size


def _read_bytes() -> int:
    about = Path("/proc/self/io")
    if not about.exists():
        pytest.skip("this system does not say what a process reads")
    return int(about.read_text().split("rchar: ")[1].split()[0])


def test_a_part_of_another_description_keeps_its_own_channels(tmp_path: Path) -> None:
    """The channel that is asked for is found by the device's whole description, also where it has changed."""
    info, swapped = make_info(), make_info()
    swapped = replace(info, signals=info.signals[::-1])
    early, late = make_block(0, 25600), make_block(25600, 25600)
    late = replace(late, counts=late.counts[:, ::-1].copy())
    log = write(tmp_path / "a.mcap", [info, early, swapped, late])
    two = read_log(log, part=Part(channels=(SIGNAL_NAMES[1],)))
    np.testing.assert_array_equal(two.samples()[:, 0], read_log(log).samples()[:, 1])
    replayed = [r for r in two.readings() if isinstance(r, Info)]
    assert [[s.name for s in r.signals] for r in replayed] == [[SIGNAL_NAMES[1]], [SIGNAL_NAMES[1]]]
    other = replace(info, signals=(Signal("else", "m/s^2", 1.0),))
    log = write(tmp_path / "b.mcap", [info, early, other, replace(late, counts=late.counts[:, :1].copy())])
    part = read_log(log, part=Part(channels=(SIGNAL_NAMES[1],)))
    assert np.isnan(part.samples()[25600:]).all()
    assert part.others


ASKED = [
    (("5", "3", None, None), "--from 5 is not before the end, 3"),
    (("5", "5", None, None), "empty"),
    ((None, "0", None, None), "empty"),
    (("-1", None, None, None), "no time from the start"),
    (("nan", None, None, None), "no time from the start"),
    (("1e300", None, None, None), "no time from the start"),
    (("noon", None, None, None), "is no time"),
    (("9999-12-31T23:59:59-12:00", "1", 1.0, None), "give one of them"),
    ((None, "2", 1.0, None), "give one of them"),
    ((None, None, 0.0, None), "no length"),
    ((None, None, None, " , "), "names none"),
    (("2024-05-01T12:00:00Z", "2024-05-01T12:00:00+01:00", None, None), "is not before"),
]


@pytest.mark.parametrize(("given_", "why"), ASKED)
def test_what_is_no_part_is_refused_in_one_line(given_: tuple[str, str, float, str], why: str) -> None:
    with pytest.raises(ConfigError, match=why) as refused:
        Part.asked(*given_)
    assert "\n" not in str(refused.value)


def test_dates_with_and_without_a_zone() -> None:
    assert Part.asked("2023-11-14T22:13:20.000001Z", None, None, None).from_ns == WALL_NS + 1000
    here = datetime.fromtimestamp(1_700_000_000, UTC).astimezone().replace(tzinfo=None).isoformat()
    assert Part.asked(None, here, None, None).to_ns == WALL_NS


def test_a_part_of_no_log_is_refused_with_what_the_log_is(logs: list[Path]) -> None:
    start = read_log(logs[0]).started_ns
    assert start is not None
    for part, why in (
        (Part(from_s=1000.0), r"is 2\.11\d* s long"),
        (Part(to_ns=start - 10**9), "begins at 2023-11-14T22:30:00"),
        (Part(channels=("b9",)), 'no channel "b9"; it has b1x, b1y'),
        (Part(from_s=0.10001, to_s=0.10002), "no sample lies"),
    ):
        with pytest.raises(ConfigError, match=why) as refused:
            read_log(logs[0], part=part)
        assert "\n" not in str(refused.value)
