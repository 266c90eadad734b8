"""When a recording was made: a log is dated by its samples, and says where no date is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from sessions import make_info, make_session, make_status

from daq.base.contract.dates import Recorded, unix_ns, utc_text
from daq.commands.files.facts import info
from daq.log.reader import read_log
from daq.log.writer import LogWriter
from daq.session import replay
from drivers.contract import Block, Info, Notice

START_NS = 1_700_000_000 * 10**9
PERIOD_NS = 39_062  # a block comes with its last sample


def write(path: Path, first_ns: int, recorded: Recorded | None, notice_first: bool = True) -> None:
    """One second whose first sample is of `first_ns` on the clock of the blocks."""
    about = replace(make_session(), metadata={"command": "import", "started": "today"})
    writer = LogWriter(path, live=False, recorded=recorded)
    writer.start(about)
    if notice_first:
        writer.readings([Notice(5, "warning", "odd", "of the file")])
    writer.status(make_status(0))
    counts = np.arange(12800 * 4, dtype=np.int32).reshape(12800, 4)
    for k in (0, 1):
        writer.readings([Block(12800 * k, counts, first_ns + (k + 1) * 500_000_000 - PERIOD_NS)])
    writer.close()


def stamps(path: Path) -> list[int]:
    with path.open("rb") as file:
        return [m.log_time for _, _, m in make_reader(file).iter_messages()]


def test_a_recording_with_a_date_keeps_it(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", START_NS, Recorded())
    log = read_log(tmp_path / "a.mcap")
    assert abs(log.started_ns - START_NS) < 1000
    assert log.metadata["started"] == info(log)["started"] == "2023-11-14T22:13:20.000000Z"
    assert START_NS <= min(stamps(log.path)) <= max(stamps(log.path)) <= START_NS + 10**9
    assert unix_ns(log.metadata["imported"]) > START_NS


@pytest.mark.promise("a record without a date", "import, info, export", "none says 1970 or today")
def test_a_recording_without_a_date_says_so_and_is_not_of_1970(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", 0, Recorded(), notice_first=False)
    log = read_log(tmp_path / "a.mcap")
    assert log.started_ns is None
    assert info(log)["started"] is None
    assert log.metadata["started"] == "unknown"
    assert min(stamps(log.path)) > START_NS


@pytest.mark.promise("the date of a record", "import, replay, export", "survives")
def test_the_date_survives_a_replay_and_its_absence_too(tmp_path: Path) -> None:
    for first_ns, started in ((START_NS, "2023-11-14T22:13:20.000000Z"), (0, None)):
        write(tmp_path / "a.mcap", first_ns, Recorded())
        source = read_log(tmp_path / "a.mcap")
        driver = replay.ReplayDriver(source)
        writer = LogWriter(tmp_path / "b.mcap", live=False, recorded=Recorded(driver.wall_offset_ns))
        writer.start(make_session())
        for reading in source.readings():
            writer.readings([reading])
        writer.close()
        assert info(read_log(tmp_path / "b.mcap"))["started"] == started


def test_a_live_log_is_of_now_from_its_first_message_on(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", 10**9, None)
    assert min(stamps(tmp_path / "a.mcap")[:2]) > START_NS


@pytest.mark.parametrize("text", ["2023-11-14T22:13:20Z", "2023-11-14T23:13:20.000+01:00"])
def test_times_as_text(text: str) -> None:
    assert unix_ns(text) == START_NS
    assert utc_text(START_NS) == "2023-11-14T22:13:20.000000Z"
    assert unix_ns("2023-11-14T22:13:20") is None  # of which zone
    assert unix_ns("yesterday") is None


def test_a_signal_of_one_bit_gives_a_log_that_is_read(tmp_path: Path) -> None:
    described = Info(make_info().signals[:1], 100.0, "", 1)
    writer = LogWriter(tmp_path / "a.mcap", live=False)
    writer.start(replace(make_session(), info=described))
    bits = (np.arange(300) % 3 == 0).astype(np.int32)[:, None] - 1
    writer.readings([Block(0, bits, 10**9)])
    writer.close()
    log = read_log(tmp_path / "a.mcap")
    np.testing.assert_array_equal(log.counts(), bits)
    assert not log.unclipped([0])[1].any()
