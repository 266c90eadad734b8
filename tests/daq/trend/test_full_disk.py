"""Segments on a disk that is really full: a small tmpfs. As root: sudo .venv-test/bin/python -m pytest -m root."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from mounts import in_namespace, light_rig

from daq.commands.cli.app import main
from daq.log.reader import read_log
from daq.trend.folder import beginning
from daq.trend.names import segments

pytestmark = [pytest.mark.root, pytest.mark.timeout(600)]
ROTORSCOPE = f"{shlex.quote(sys.executable)} -m daq"
SEGMENT_COUNT_BEFORE = 4
UNTIL_SEGMENTS = f"until [ $(ls disk/press/*.mcap 2>/dev/null | wc -l) -ge {SEGMENT_COUNT_BEFORE} ]; do sleep 0.1; done"
RATE_HZ = 25_600
Row = Callable[[str, object], None]


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return light_rig(tmp_path)


def test_another_program_fills_the_disk_and_the_oldest_segments_make_room(
    rig: Path, tmp_path: Path, record_property: Row
) -> None:
    """What waited in memory is stored by and by: more of it than the room that is left free."""
    (tmp_path / "fill.sh").write_text(
        f"{UNTIL_SEGMENTS}; head -c 100M /dev/zero > disk/other || true; sleep 12; rm disk/other\n"
    )
    run = f"{ROTORSCOPE} run {rig} --link virtual: --seconds 28 --out disk/press --segment 1s --json run.json"
    done = in_namespace(
        "mkdir disk; mount -t tmpfs -o size=3m tmpfs disk; bash fill.sh 2>/dev/null &"
        f" {run} --keep 1d --keep-free 1MB || status=$?; wait; cp -a disk/press press; exit ${{status:-0}}",
        tmp_path,
    )
    summary = json.loads((tmp_path / "run.json").read_text())
    kept = [read_log(s.path) for s in segments(tmp_path / "press")]
    row = "disk full, with segments and `--keep-free` | another program fills a tmpfs of 3 MB for 12 s under `run`"
    measured = f"0 of {summary['samples']} samples not logged, {len(kept)} segments stay, status {done.returncode}"
    record_property("reliability", f"{row} | the oldest segments make room, no sample is lost | {measured}")
    assert "No space left on device; acquisition goes on" in done.stderr
    assert done.returncode == 0, done.stderr
    assert summary["samples"] == 28 * RATE_HZ
    assert summary["not_logged"] == summary["lost_samples"] == 0
    assert all(log.complete for log in kept)
    assert [a.stop for a in kept[:-1]] == [b.first for b in kept[1:]]
    assert kept[-1].stop == 28 * RATE_HZ
    assert main(["trend", str(tmp_path / "press"), "--quiet"]) == 0


def test_the_disk_is_full_to_the_end(rig: Path, tmp_path: Path, record_property: Row) -> None:
    """Without --keep nothing is removed: acquisition goes on, and what could be stored can be read."""
    run = f"{ROTORSCOPE} run {rig} --link virtual: --seconds 15 --out disk/press --segment 1s --json run.json"
    done = in_namespace(
        f"mkdir disk; mount -t tmpfs -o size=2m tmpfs disk; {run} || status=$?; cp -a disk/press press; exit $status",
        tmp_path,
    )
    summary = json.loads((tmp_path / "run.json").read_text())
    logs = [read_log(s.path) for s in segments(tmp_path / "press") if beginning(s.path) is not None]
    stored = sum(log.n_samples for log in logs)
    row = "disk full to the end, with segments | a tmpfs of 2 MB under `run` without `--keep`"
    measured = f"{summary['samples']} samples acquired, {stored} stored and read, status {done.returncode}"
    record_property("reliability", f"{row} | acquisition goes on, told, what was stored is read | {measured}")
    assert done.returncode == 4, done.stderr
    assert "No space left on device; acquisition goes on" in done.stderr
    assert summary["samples"] == 15 * RATE_HZ
    assert 0 < summary["not_logged"] < summary["samples"] <= stored + summary["not_logged"]
    assert all(log.complete for log in logs[:-1])
    assert sum(log.lost_samples for log in logs) == 0
    assert main(["replay", str(tmp_path / "press"), "--check", "--quiet"]) == 0
