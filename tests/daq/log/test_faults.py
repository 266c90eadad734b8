"""Disks that are full, slow or gone, for real: acquisition goes on with a notice, and the log stays readable."""

from __future__ import annotations

import os
import resource
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from promises import PATIENCE_S, within
from sessions import RATE_HZ, counts_at, make_block, make_session

from daq.base.contract.errors import LogError
from daq.log.file import LogFile
from daq.log.reader import read_log
from daq.log.recover import recover
from daq.log.writer import LogWriter
from drivers.contract.reading import Notice

ROWS = 256
Property = Callable[[str, object], None]


class Feeder:
    """The core loop's place: blocks into the writer, the time each call took, and the notices to the operator."""

    def __init__(self, writer: LogWriter, start: bool = True) -> None:
        self.writer = writer
        self.index = 0
        self.slowest_s = 0.0
        self.notices: list[Notice] = []
        if start:
            writer.start(make_session())

    def feed(self, blocks: int, pause_s: float = 0.0) -> None:
        for _ in range(blocks):
            block = make_block(self.index, ROWS)
            self.index += ROWS
            begin = time.perf_counter()
            self.writer.readings([block])
            self.slowest_s = max(self.slowest_s, time.perf_counter() - begin)
            time.sleep(pause_s)
        self.notices += self.writer.health().notices

    def until(self, condition: Callable[[], bool], timeout_s: float = PATIENCE_S, blocks: int = 10) -> None:
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, f"not within {timeout_s} s; notices: {[n.text for n in self.notices]}"
            self.feed(blocks)
            time.sleep(0.01)

    def notified(self, code: str) -> bool:
        return any(n.code == code for n in self.notices)

    def close(self) -> None:
        self.writer.close()
        self.notices += self.writer.health().notices


@contextmanager
def file_size_limit(limit: int) -> Iterator[None]:
    """The operating system refuses to let any file of ours grow beyond this: EFBIG, as a full disk gives ENOSPC."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def assert_right(path: Path, complete: bool) -> int:
    """What is in the log is right, every hole is a gap; samples there."""
    log = read_log(path)
    assert log.complete is complete, log.damage
    counts = log.counts()
    there = counts[:, 0] != np.iinfo(np.int32).min
    np.testing.assert_array_equal(counts[there], counts_at(log.first, len(counts))[there])
    assert sum(g.count for g in log.gaps) == log.lost_samples == int((~there).sum())
    return log.n_samples


def test_a_full_disk_that_gets_room_again_costs_nothing(tmp_path: Path, record_property: Property) -> None:
    feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
    feeder.feed(100)
    with file_size_limit(400_000):
        feeder.until(lambda: feeder.notified("log_fault"))
        feeder.feed(100, 0.002)
        during = read_log(tmp_path / "a.mcap")  # readable while the fault lasts
        assert during.n_samples > 0
    feeder.until(lambda: feeder.notified("log_recovered"))
    feeder.feed(50)
    feeder.close()
    within(feeder.slowest_s, 0.2)
    assert [n.code for n in feeder.notices] == ["log_fault", "log_recovered"]
    assert "File too large" in feeder.notices[0].text
    assert assert_right(tmp_path / "a.mcap", complete=True) == feeder.index
    row = "disk full, then room again | limit on the file's size (EFBIG) | acquisition goes on, told, nothing lost"
    record_property("reliability", f"{row} | 0 samples lost; slowest call {1e3 * feeder.slowest_s:.1f} ms")


def test_a_full_disk_and_names_that_are_no_text(tmp_path: Path, record_property: Property) -> None:
    """What is said of the fault names the log, and goes into it; so do the link and the DBC."""
    path = tmp_path / os.fsdecode(b"a\xff.mcap")
    session = make_session()
    odd = os.fsdecode(b"\xff.dbc")
    session = replace(session, device=odd, attachments=session.attachments | {odd: b"x"}, metadata={"link": odd})
    feeder = Feeder(LogWriter(path), start=False)
    feeder.writer.start(session)
    feeder.feed(100)
    with file_size_limit(400_000):
        feeder.until(lambda: feeder.notified("log_fault"))
        feeder.writer.readings([n for n in feeder.notices if n.code == "log_fault"])  # as the pipeline does
    feeder.until(lambda: feeder.notified("log_recovered"))
    feeder.close()
    assert assert_right(path, complete=True) == feeder.index
    log = read_log(path)
    assert "a\\udcff.mcap" in log.notices[-1].text
    assert (log.head.device, log.metadata["link"]) == ("\\udcff.dbc", "\\udcff.dbc")
    assert log.attachments["\\udcff.dbc"] == b"x"
    row = "names that are no text, and a full disk | bytes above 127 in the names of log, link, DBC; a full disk"
    record_property("reliability", f"{row} | the log goes on | 0 samples lost")


def test_a_disk_full_for_long_costs_the_newest_by_name(tmp_path: Path, record_property: Property) -> None:
    feeder = Feeder(LogWriter(tmp_path / "a.mcap", limit_bytes=1 << 20))
    with file_size_limit(300_000):
        feeder.until(lambda: feeder.notified("log_overflow"))
        feeder.feed(2000)
    feeder.until(lambda: feeder.notified("log_resumed"))
    feeder.feed(20, 0.01)
    feeder.close()
    within(feeder.slowest_s, 0.2)
    stored = assert_right(tmp_path / "a.mcap", complete=True)
    log = read_log(tmp_path / "a.mcap")
    assert {g.reason for g in log.gaps} == {"storage"}
    assert stored + log.lost_samples == feeder.index
    assert feeder.writer.health().dropped == log.lost_samples > 100_000
    row = "disk full beyond the queue | limit on the file's size, queue of 1 MiB | newest dropped, exact gap `storage`"
    measured = f"{log.lost_samples} of {feeder.index} samples not stored, all in gaps"
    record_property("reliability", f"{row} | {measured}; slowest call {1e3 * feeder.slowest_s:.1f} ms")
    assert "samples from" in next(n.text for n in feeder.notices if n.code == "log_overflow")


def test_a_disk_that_stays_full_leaves_a_readable_log_and_a_quick_end(
    tmp_path: Path, record_property: Property
) -> None:
    feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
    with file_size_limit(500_000):
        feeder.until(lambda: feeder.notified("log_fault"))
        begin = time.monotonic()
        feeder.close()
        took = time.monotonic() - begin
        within(took, 2.0)
        assert feeder.notified("log_incomplete")
        stored = assert_right(tmp_path / "a.mcap", complete=False)
        assert stored > 30_000
        dropped = feeder.writer.health().dropped
        assert feeder.index - stored <= dropped <= feeder.index
        row = "disk still full at the end | limit on the file's size | told, the log readable, the end within 2 s"
        lacking = f"{feeder.index - stored} samples not in the log, counted as up to {dropped}"
        record_property("reliability", f"{row} | {took:.2f} s; {lacking}")
        assert (tmp_path / "a.mcap").stat().st_size == 500_000


def test_the_folder_that_we_were_started_in_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_property: Property
) -> None:
    """A name without a folder means nothing any more."""
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.chdir(home)
    feeder = Feeder(LogWriter("a.mcap"))
    feeder.feed(100)
    feeder.until(lambda: Path("a.mcap").stat().st_size > 0)
    shutil.rmtree(home)
    feeder.until(lambda: feeder.notified("log_restored"))
    shutil.rmtree(home)
    home.write_text("in its way")  # until the end
    feeder.feed(50)
    feeder.close()
    assert assert_right(tmp_path / "a.mcap", complete=True) == feeder.index
    assert feeder.notices[-1].text.endswith(f"cannot be put back; the log is {tmp_path / 'a.mcap'}")
    row = (
        "the folder that `run` was started in is removed | `--out` names no folder; twice, and a file stands in its way"
    )
    record_property("reliability", f"{row} | the log put back whole, then in the nearest folder | 0 samples lost")


def test_the_log_folder_is_removed(tmp_path: Path, record_property: Property) -> None:
    folder = tmp_path / "logs" / "today"
    folder.mkdir(parents=True)
    feeder = Feeder(LogWriter(folder / "a.mcap"))
    feeder.feed(200, 0.002)
    shutil.rmtree(tmp_path / "logs")
    feeder.until(lambda: feeder.notified("log_restored"))
    feeder.feed(50, 0.002)
    feeder.close()
    assert assert_right(folder / "a.mcap", complete=True) == feeder.index
    row = "log folder removed | rm -r while it is written | told, the log put back whole"
    record_property("reliability", f"{row} | 0 samples lost")


def test_the_log_is_removed_and_its_name_taken(tmp_path: Path) -> None:
    feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
    feeder.feed(50, 0.002)
    (tmp_path / "a.mcap").unlink()
    (tmp_path / "a.mcap").write_text("somebody else's")
    feeder.until(lambda: feeder.notified("log_restored"))
    feeder.close()
    assert (tmp_path / "a.mcap").read_text() == "somebody else's"
    assert feeder.writer.path == tmp_path / "a-1.mcap"
    assert assert_right(tmp_path / "a-1.mcap", complete=True) == feeder.index


def test_the_folder_is_removed_and_cannot_be_made_again(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    feeder = Feeder(LogWriter(folder / "a.mcap"))
    feeder.feed(50, 0.002)
    shutil.rmtree(folder)
    folder.write_text("a file stands in the way")
    feeder.until(lambda: feeder.notified("log_fault"))
    assert "removed" in feeder.notices[0].text
    folder.unlink()
    feeder.until(lambda: feeder.notified("log_restored"))
    feeder.close()
    assert assert_right(folder / "a.mcap", complete=True) == feeder.index


def test_a_log_whose_folder_never_comes_back_is_saved_elsewhere(tmp_path: Path, record_property: Property) -> None:
    """Its bytes live only as long as we hold it open: the end is the last moment to save them."""
    folder = tmp_path / "disk" / "logs"
    folder.mkdir(parents=True)
    feeder = Feeder(LogWriter(folder / "a.mcap"))
    feeder.feed(200, 0.002)
    shutil.rmtree(folder)
    folder.write_text("a file stands in the way")
    feeder.until(lambda: feeder.notified("log_fault"))
    begin = time.monotonic()
    feeder.close()
    took = time.monotonic() - begin
    assert feeder.writer.path == tmp_path / "disk" / "a.mcap"
    assert str(feeder.writer.path) in feeder.notices[-1].text
    assert not feeder.notified("log_incomplete")
    assert assert_right(feeder.writer.path, complete=True) == feeder.index
    assert folder.read_text() == "a file stands in the way"
    how = "and a file stands in its way until the end"
    row = f"log folder removed | {how} | told, the log complete in the nearest folder within 2 s"
    record_property("reliability", f"{row} | 0 samples lost, {took:.2f} s")
    within(took, 2.0)


def test_without_a_thread_for_the_disk_the_log_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
    feeder.feed(20)
    starts = threading.Thread.start

    def refuse(thread: threading.Thread) -> None:
        if thread.name == "log sync":
            raise RuntimeError("can't start new thread")
        starts(thread)

    monkeypatch.setattr("threading.Thread.start", refuse)
    handles = len(os.listdir("/proc/self/fd"))
    feeder.feed(150, 0.01)  # more than one flush to the disk
    assert len(os.listdir("/proc/self/fd")) <= handles
    feeder.close()
    assert not feeder.notices
    assert assert_right(tmp_path / "a.mcap", complete=True) == feeder.index


def test_without_a_free_handle_the_log_goes_on(tmp_path: Path, record_property: Property) -> None:
    """As when others hold all the open files that a process may have: asking for the disk takes one."""
    feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
    feeder.feed(10, pause_s=0.01)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    held = os.dup(0)
    os.close(held)  # the lowest that is free: below it, none is
    resource.setrlimit(resource.RLIMIT_NOFILE, (held, hard))
    try:
        begin = time.monotonic()
        while time.monotonic() - begin < 2.5:
            feeder.feed(1, pause_s=0.02)
        begin = time.monotonic()
        feeder.close()
        took = time.monotonic() - begin
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    row = "no open file to be had | limit of the process, 2.5 s and at the end | complete log within 2 s, nothing told"
    record_property("reliability", f"{row} | {took:.2f} s, {len(feeder.notices)} notices")
    assert [n.text for n in feeder.notices] == []
    assert assert_right(tmp_path / "a.mcap", complete=True) == feeder.index
    within(took, 2.0)


def test_the_log_is_moved_while_it_is_written(tmp_path: Path, record_property: Property) -> None:
    feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
    feeder.feed(50, 0.01)
    (tmp_path / "a.mcap").rename(tmp_path / "b.mcap")
    feeder.until(lambda: feeder.notified("log_moved"))
    feeder.close()
    assert feeder.writer.path == tmp_path / "b.mcap"
    assert str(feeder.writer.path) in feeder.notices[0].text
    assert len(feeder.notices) == 1
    assert not (tmp_path / "a.mcap").exists()
    assert assert_right(tmp_path / "b.mcap", complete=True) == feeder.index
    row = "log moved | `mv` while it is written | told, complete under its new name, which the summary gives"
    record_property("reliability", f"{row} | 0 samples lost")


def test_a_log_that_is_out_of_reach_is_reported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As behind an unmounted disk, which a test may not do: the file lives, and has no name that leads to it."""
    feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
    feeder.feed(50, 0.01)
    monkeypatch.setattr("os.readlink", lambda path: "/a.mcap")
    (tmp_path / "a.mcap").rename(tmp_path / "b.mcap")
    feeder.until(lambda: feeder.notified("log_hidden"))
    feeder.feed(100, 0.01)
    feeder.close()
    assert len(feeder.notices) == 1
    assert feeder.writer.path == tmp_path / "a.mcap"
    assert assert_right(tmp_path / "b.mcap", complete=True) == feeder.index


def test_another_program_cuts_the_log(tmp_path: Path, record_property: Property) -> None:
    """As `> a.mcap` or a copy onto it do."""
    feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
    feeder.until(lambda: (tmp_path / "a.mcap").stat().st_size > 100_000)
    before = feeder.index
    os.truncate(tmp_path / "a.mcap", 10)
    feeder.until(lambda: feeder.notified("log_cut"))
    feeder.feed(100, 0.01)
    feeder.close()
    assert [n.code for n in feeder.notices] == ["log_cut"]
    lost = feeder.index - assert_right(tmp_path / "a.mcap", complete=False)
    assert recover(tmp_path / "a.mcap", tmp_path / "b.mcap").samples == feeder.index - lost
    assert 0 < lost <= before
    row = "log cut by another program | truncated to 10 bytes while it is written | told, status 4, the rest readable"
    record_property("reliability", f"{row} | {lost} of {feeder.index} samples lost, what came afterwards is there")


def test_a_cut_between_two_writes_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second makes the file as long as it should be, with a hole in it."""
    file = LogFile(tmp_path / "a.mcap")
    write = os.pwrite

    def cut_first(fd: int, data: memoryview, at: int) -> int:
        if at == 1000:
            os.truncate(tmp_path / "a.mcap", 10)
        return write(fd, data, at)

    monkeypatch.setattr("os.pwrite", cut_first)
    for piece in (b"a" * 1000, b"b" * 1000, b"c" * 1000):
        file.write(piece)
    file.push()
    assert (tmp_path / "a.mcap").stat().st_size == 3000
    assert file.cut


class StalledFile(LogFile):
    """A disk that takes no byte for a while: the write itself hangs."""

    gate = threading.Event()

    def push(self) -> None:
        self.gate.wait()
        super().push()


@pytest.mark.parametrize("seconds", [1.5])
def test_a_stalled_disk_never_makes_acquisition_wait(tmp_path: Path, seconds: float, record_property: Property) -> None:
    StalledFile.gate.clear()
    feeder = Feeder(LogWriter(tmp_path / "a.mcap", limit_bytes=1 << 20, file=StalledFile))
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        feeder.feed(5, 0.001)
    assert feeder.writer.health().lag_s > 1.0
    assert feeder.notified("log_overflow")
    StalledFile.gate.set()
    feeder.until(lambda: feeder.notified("log_resumed"))
    feeder.close()
    within(feeder.slowest_s, 0.2)
    stored = assert_right(tmp_path / "a.mcap", complete=True)
    assert stored < feeder.index
    row = f"disk stalls | a write that hangs for {seconds} s, queue of 1 MiB | the core loop never waits, exact gaps"
    measured = f"slowest call {1e3 * feeder.slowest_s:.1f} ms; {feeder.index - stored} samples in gaps"
    record_property("reliability", f"{row} | {measured}")


def test_a_disk_stalled_at_the_end_is_given_up(tmp_path: Path) -> None:
    StalledFile.gate.clear()
    feeder = Feeder(LogWriter(tmp_path / "a.mcap", file=StalledFile))
    feeder.feed(10)
    begin = time.monotonic()
    feeder.close()
    within(time.monotonic() - begin, 2.0)
    assert feeder.notified("log_incomplete")
    StalledFile.gate.set()


class StarvedFile(LogFile):
    """For a writer that gets little time: each chunk takes a while to make."""

    def write(self, data: bytes) -> int:
        if len(data) > 4096:
            time.sleep(0.15)
        return super().write(data)


def test_what_a_busy_computer_has_not_encoded_by_the_end_is_not_given_up(tmp_path: Path) -> None:
    """All that waited was taken in one piece, which was no progress: four minutes of a log were lost at its end."""
    feeder = Feeder(LogWriter(tmp_path / "a.mcap", file=StarvedFile))
    feeder.feed(round(20 * RATE_HZ) // ROWS)
    begin = time.monotonic()
    feeder.close()
    assert time.monotonic() - begin > 1.5
    assert not feeder.notified("log_incomplete")
    assert assert_right(tmp_path / "a.mcap", complete=True) == feeder.index


def test_a_log_that_cannot_be_created_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "none" / "a.mcap", tmp_path / "file" / "a.mcap", tmp_path):
        with pytest.raises(LogError, match=r"cannot write the log .*: .*; (choose another --out|create it first)"):
            LogWriter(path)


def test_dev_full(tmp_path: Path) -> None:
    """A device that is always full, behind a symbolic link."""
    (tmp_path / "a.mcap").symlink_to("/dev/full")
    feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
    feeder.until(lambda: feeder.notified("log_fault"))
    assert "No space left on device" in feeder.notices[0].text
    feeder.close()
    assert feeder.notified("log_incomplete")


def test_an_import_into_a_full_disk_fails_with_one_line(tmp_path: Path) -> None:
    for call in ("readings", "close"):
        writer = LogWriter(tmp_path / f"{call}.mcap", live=False, limit_bytes=1 << 20)
        feeder = Feeder(writer)
        feeder.feed(200 if call == "close" else 0)
        with file_size_limit(200_000), pytest.raises(LogError, match="File too large; make room or choose another"):
            writer.close() if call == "close" else feeder.feed(100_000)


@pytest.mark.slow
def test_memory_stays_bounded_while_the_disk_is_full(tmp_path: Path, record_property: Property) -> None:
    import psutil

    process = psutil.Process()
    feeder = Feeder(LogWriter(tmp_path / "a.mcap", limit_bytes=4 << 20))
    with file_size_limit(100_000):
        feeder.until(lambda: feeder.notified("log_overflow"), blocks=100)
        before = process.memory_info().rss
        feeder.feed(20_000)  # 5.1 M samples, 82 MB of counts
        grown = process.memory_info().rss - before
    feeder.close()
    row = f"disk full for {20_000 * ROWS / RATE_HZ:.0f} s of data | as above | memory bounded"
    record_property("reliability", f"{row} | {grown / 1e6:+.1f} MB")
    assert grown < 12e6


def test_no_handle_is_left_open(tmp_path: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        feeder = Feeder(LogWriter(tmp_path / "a.mcap"))
        feeder.feed(5)
        feeder.close()
    assert len(os.listdir("/proc/self/fd")) <= before + 1
