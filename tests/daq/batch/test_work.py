"""What a worker makes of a log, whatever the log is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from made_up_archive import RIG_TOML, archive, record

from daq.base.console.output import version
from daq.batch.archive import find_logs, read_rig
from daq.batch.task import WINDOWS_TASK, Task
from daq.batch.work import answer


def task(log: Path | str, name: str = "severity", rig: Path | None = None, **more: float) -> Task:
    source = read_rig(str(rig or Path(log).parent / "rig.toml"))
    (found,) = find_logs([str(log)], lambda _url, _fields: source)
    return Task(log=found, name=name, version=version(), **more)  # type: ignore[arg-type]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    archive(tmp_path, 1)
    return tmp_path / "record000.npz"


def test_a_row_has_the_numbers_of_the_command(log: Path) -> None:
    row = answer(task(log))
    assert (row["status"], row["task"], row["log"], row["machine"]) == ("done", "severity", str(log), "rig")
    assert row["seconds"] == 4.0
    assert row["bound_mb"] == 451  # of 4 s of two channels at 6.4 kHz
    levels = row["rows"]["severity"]
    assert [one["channel"] for one in levels] == ["a", "b"]
    assert [one["velocity_rms_mm_s"] for one in levels] == pytest.approx([3.0, 3.0], rel=0.01)


def test_a_window_is_a_part_and_a_short_log_has_none(log: Path) -> None:
    assert answer(task(log, from_s=1.0, seconds=2.0))["seconds"] == 2.0
    assert answer(task(log, WINDOWS_TASK, seconds=2.0))["seconds"] == 4.0
    row = answer(task(log, WINDOWS_TASK, seconds=60.0))
    assert (row["status"], row["code"]) == ("failed", "log")
    assert "is 4 s long, and --window asks for 60 s" in row["reason"]


@pytest.mark.parametrize(
    ("name", "data", "code", "words"),
    [
        ("junk.mcap", b"no log at all" * 100, "log", "no Rotorscope log"),
        ("empty.mcap", b"", "log", "empty.mcap"),
        ("empty.npz", b"", "log", "empty.npz"),
        ("other.txt", b"text", "log", "other.txt"),
    ],
)
def test_files_that_are_no_logs_are_rows_with_a_reason(
    log: Path, name: str, data: bytes, code: str, words: str
) -> None:
    log.with_name(name).write_bytes(data)
    row = answer(task(log.with_name(name)))
    assert (row["status"], row["code"], row["rows"]) == ("failed", code, {})
    assert words in row["reason"]
    assert "\n" not in row["reason"]


def test_a_cut_file_a_wrong_rig_and_what_cannot_be_read_are_rows(log: Path) -> None:
    cut = log.with_name("cut.npz")
    cut.write_bytes(log.read_bytes()[:2000])
    assert answer(task(cut))["code"] == "log"
    wrong = log.with_name("wrong.toml")
    wrong.write_text(RIG_TOML.replace('name = "b"', 'name = "c"'))
    row = answer(task(log, rig=wrong))
    assert row["code"] == "log"
    assert '"c"' in row["reason"]
    asked = task(log)
    log.unlink()
    assert answer(asked)["code"] == "log"
    log.mkdir()  # what is there cannot be read, whoever asks
    assert answer(asked)["code"] == "log"


def test_a_record_that_cannot_answer_and_another_version_are_rows(log: Path) -> None:
    short = log.with_name("short.npz")
    record(short, seconds=0.05)
    row = answer(task(short, "fit"))
    assert (row["code"], row["bound_mb"]) == ("record", 550)
    assert str(short) in row["reason"]
    row = answer(replace(task(log), version="0.0.1"))
    assert (row["code"], "install one version" in row["reason"]) == ("rig", True)


def test_a_log_comes_over_the_network_once(log: Path) -> None:
    """Through a file system in memory, which any address of fsspec is to us."""
    import fsspec

    system = fsspec.filesystem("memory")
    system.pipe("/bucket/record.npz", log.read_bytes())
    asked = task("memory://bucket/record.npz", rig=log.with_name("rig.toml"))
    assert answer(asked)["status"] == "done"
    system.rm("/bucket/record.npz")
    row = answer(replace(asked, from_s=1.0, seconds=2.0))
    assert (row["status"], row["log"]) == ("done", "memory:///bucket/record.npz")
    system.pipe("/bucket/junk.mcap", b"junk")
    row = answer(task("memory://bucket/junk.mcap", rig=log.with_name("rig.toml")))
    assert row["reason"].startswith("memory:///bucket/junk.mcap:")
