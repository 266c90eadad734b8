"""Windows, analyses and keys of tasks."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daq.base.contract.errors import ConfigError
from daq.batch.archive import LogSource, RigSource
from daq.batch.task import Task, Windows, analyses, memory_bytes

RIG_SOURCE = RigSource(path="rig.toml", digest="0")
FIT_TASK = Task(log=LogSource(url="/a.mcap", stamp="1", machine="", rig=RIG_SOURCE), name="fit", version="1")


def test_windows_lie_wholly_within_a_log() -> None:
    windows = Windows.asked("60s", "1h")
    assert windows == Windows(length_s=60.0, every_s=3600.0)
    assert windows.starts(2 * 3600.0 + 59.0) == [0.0, 3600.0]
    assert windows.starts(2 * 3600.0 + 60.0) == [0.0, 3600.0, 7200.0]
    assert windows.starts(59.0) == []
    assert Windows.asked("1.5min", None) == Windows(length_s=90.0, every_s=90.0)
    assert Windows.asked(None, None) is None
    cut = FIT_TASK.windows(windows, 3661.0, ["fit", "compare"])
    assert [(t.name, t.from_s, t.seconds) for t in cut] == [
        ("fit", 0.0, 60.0), ("compare", 0.0, 60.0), ("fit", 3600.0, 60.0), ("compare", 3600.0, 60.0),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("window", "every", "words"),
    [("0s", None, "is no length of time"), ("a minute", None, "60s"), (None, "1h", "give both"),
     ("60s", "30s", "would overlap")],
)  # fmt: skip
def test_windows_that_are_none_are_refused(window: str | None, every: str | None, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Windows.asked(window, every)


def test_the_key_changes_with_log_rig_task_window_and_version() -> None:
    others = [
        replace(FIT_TASK, log=replace(FIT_TASK.log, stamp="2")),
        replace(FIT_TASK, log=replace(FIT_TASK.log, rig=replace(RIG_SOURCE, digest="1"))),
        replace(FIT_TASK, name="compare"),
        replace(FIT_TASK, from_s=0.0, seconds=60.0),
        replace(FIT_TASK, version="2"),
    ]
    assert len({task.key for task in (FIT_TASK, *others)}) == 6
    assert replace(FIT_TASK, log=replace(FIT_TASK.log, machine="other")).key == FIT_TASK.key


def test_analyses_are_checked_and_ordered() -> None:
    assert analyses("diagnose, fit,fit") == ["fit", "diagnose"]
    for text, words in (("fit,fits", '"fits" is no analysis'), (" , ", "names no analysis")):
        with pytest.raises(ConfigError, match=words):
            analyses(text)


def test_memory_grows_with_the_record() -> None:
    assert memory_bytes("diagnose", 6_000_000) > memory_bytes("fit", 6_000_000) > memory_bytes("fit", 0) > 0
