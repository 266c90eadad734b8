"""Disks as only root can make them: sudo .venv-test/bin/python -m pytest -m root, on Linux.

Each command runs in a mount namespace of its own, so nothing is seen outside and nothing is left.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from cable import Cable
from mounts import in_namespace, light_rig

from daq.commands.cli.app import main
from daq.log.reader import read_log

pytestmark = [pytest.mark.root, pytest.mark.timeout(600)]
ROTORSCOPE = f"{shlex.quote(sys.executable)} -m daq"
Row = Callable[[str, object], None]


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return light_rig(tmp_path)


@contextmanager
def plugged_in(folder: Path) -> Iterator[str]:
    cable = Cable(folder / "tty")
    try:
        yield f"serial:{folder / 'tty'}"
    finally:
        cable.close()


def test_the_disk_of_the_log_is_read_only(rig: Path, tmp_path: Path, record_property: Row) -> None:
    run = f"{ROTORSCOPE} run {rig} --link virtual: --seconds 9 --out disk/a.mcap"
    done = in_namespace(f"mkdir disk; mount -t tmpfs -o ro tmpfs disk; {run}", tmp_path)
    (line,) = done.stderr.splitlines()
    assert line.startswith("rotorscope: cannot write the log disk/a.mcap: Read-only file system; choose another --out")
    assert done.returncode == 4
    row = "log on a read-only disk | `run --out` on a tmpfs mounted `ro` | refused before the link is opened"
    record_property("reliability", f"{row} | one line, status {done.returncode}")


def test_the_disk_of_the_log_becomes_read_only(rig: Path, tmp_path: Path, record_property: Row) -> None:
    """As Linux does it to a disk with errors: ext4 on a file, its journal aborted under the open log."""
    subprocess.run("truncate -s 32M image; mkfs.ext4 -q -F image; mkdir disk", shell=True, check=True, cwd=tmp_path)
    (tmp_path / "break.sh").write_text(
        "until [ $(stat -c %s disk/a.mcap 2>/dev/null || echo 0) -gt 100000 ]; do sleep 0.1; done\n"
        "sync disk/a.mcap; cp disk/a.mcap before; mount -o remount,abort disk; touch broken\n"
    )
    with plugged_in(tmp_path) as link:
        done = in_namespace(
            f"mount -o loop image disk; bash break.sh & {ROTORSCOPE} run {rig} --link {link} --seconds 25"
            " --out disk/a.mcap --json run.json || status=$?; wait; cp disk/a.mcap after; exit $status",
            tmp_path,
        )
    assert (tmp_path / "broken").exists(), done.stderr
    assert done.returncode == 4
    assert "error: disk/a.mcap: Read-only file system; acquisition goes on" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("rotorscope: disk/a.mcap could not be completed: Read-only")
    summary = json.loads((tmp_path / "run.json").read_text())
    before, after = (tmp_path / name for name in ("before", "after"))
    assert after.read_bytes().startswith(before.read_bytes())
    assert main(["recover", str(after), "--out", str(tmp_path / "b.mcap"), "--quiet"]) == 0
    log = read_log(tmp_path / "b.mcap")
    assert 0 < log.n_samples < summary["samples"]
    assert log.lost_samples == 0
    row = "the log's disk becomes read-only | ext4 whose journal is aborted, under `rotorscope run`"
    promised = "told, acquisition goes on, what was written can be read"
    assert log.n_samples + summary["not_logged"] >= summary["samples"] > summary["not_logged"] > 0
    assert f"; up to {summary['not_logged']} of them are not in the log" in done.stdout
    measured = (
        f"told, {summary['samples']} samples acquired, {log.n_samples} written before and read, up to "
        f"{summary['not_logged']} said not to be in the log, status 4"
    )
    record_property("reliability", f"{row} | {promised} | {measured}")


@pytest.mark.parametrize("how", ["missing", "full"])
def test_no_shared_memory_and_no_temporary_files(rig: Path, tmp_path: Path, how: str, record_property: Row) -> None:
    """Files of others are read, and drawn in Rerun, by processes of their own."""
    assert main(["simulate", str(rig), "--out", str(tmp_path / "a.mcap"), "--seconds", "5", "--quiet"]) == 0
    assert main(["export", str(tmp_path / "a.mcap"), "--to", str(tmp_path / "a.mat"), "--quiet"]) == 0
    assert main(["export", str(tmp_path / "a.mcap"), "--to", str(tmp_path / "a.mf4"), "--quiet"]) == 0
    work = [
        f"import a.mat --rig {rig} --out b.mcap --rate 25600",
        f"import a.mf4 --rig {rig} --out c.mcap",
        "export b.mcap --to d.mf4",
        f"run {rig} --link virtual: --seconds 3 --rerun e.rrd --out e.mcap",
    ]
    mount = "mount -t tmpfs -o size=4k tmpfs /dev/shm; head -c 4096 /dev/zero > /dev/shm/f"
    if how == "missing":
        mount = "umount -l /dev/shm; mount -t tmpfs -o ro,size=4k tmpfs /dev/shm"
    full = "mkdir full; mount -t tmpfs -o size=4k tmpfs full; head -c 4096 /dev/zero > full/f"
    commands = "; ".join(f"{ROTORSCOPE} {one} --quiet" for one in work)
    done = in_namespace(f"{mount}; {full}; {commands}", tmp_path, TMPDIR=str(tmp_path / "full"))
    assert (done.returncode, done.stderr) == (0, "")
    for name in "bce":
        assert read_log(tmp_path / f"{name}.mcap").lost_samples == 0
    row = f"/dev/shm {'cannot be written' if how == 'missing' else 'full'}, and no room for temporary files"
    record_property(
        "reliability", f"{row} | import .mat, .mf4, export, `run --rerun FILE` | done as ever | status 0, 0 lost"
    )
