"""Compiled code finds a place, and nobody else's."""

from __future__ import annotations

import os
import pickle
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from daq.commands.cache_place import CACHE_VARIABLE, CHECKED_FILE, choose, clean

RIG = Path(__file__).parents[3] / "configs" / "tiwari_vyas_1997.toml"
NOWHERE = Path("/proc/nowhere")  # a read-only installation


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Nothing of numba's own can be written (root can write anything but this): only the temporary files."""
    monkeypatch.delenv(CACHE_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nowhere")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_numba_is_left_alone_where_it_can_write(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(CACHE_VARIABLE, raising=False)
    choose()
    assert CACHE_VARIABLE not in os.environ


def test_a_read_only_installation_without_a_home(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    choose(NOWHERE)
    first = Path(os.environ[CACHE_VARIABLE])
    assert first.parent == nowhere
    assert stat.S_IMODE(first.stat().st_mode) == 0o700
    monkeypatch.delenv(CACHE_VARIABLE)
    choose(NOWHERE)
    assert Path(os.environ[CACHE_VARIABLE]) == first  # what was compiled is there the next time


@pytest.mark.parametrize("trap", ["others may write", "link", "file"])
def test_a_place_that_another_may_have_prepared_is_not_taken(nowhere: Path, trap: str) -> None:
    choose(NOWHERE)
    first = Path(os.environ.pop(CACHE_VARIABLE))
    if trap == "others may write":
        first.chmod(0o777)
    else:
        first.rmdir()
        (nowhere / "theirs").mkdir()
        first.symlink_to(nowhere / "theirs") if trap == "link" else first.write_text("")
    choose(NOWHERE)
    taken = Path(os.environ[CACHE_VARIABLE])
    assert taken != first
    assert taken.parent == nowhere
    assert stat.S_IMODE(taken.stat().st_mode) == 0o700


@pytest.mark.slow  # compiles twice
def test_compiled_code_that_a_power_cut_spoilt_is_compiled_again(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """Files that were not written to the disk before it: empty, cut, or zeros."""
    code = (
        "from daq.commands import cache_place; cache_place.clean(); "
        "from drivers.serial import cobs; print(cobs.encode(b'a').hex())"
    )
    environment = os.environ | {CACHE_VARIABLE: str(tmp_path / "cache"), "PYTHONPATH": str(RIG.parents[1])}

    def encode() -> tuple[str, list[Path]]:
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout, sorted((tmp_path / "cache").rglob("*.nb[ic]"))

    said, files = encode()
    assert len(files) >= 2
    for k, path in enumerate(files):
        data = path.read_bytes()
        path.write_bytes((b"", data[: len(data) // 2], data[:-100] + bytes(100))[k % 3])
        (path.parent / CHECKED_FILE).write_bytes(b"of the start before the power cut")
    assert encode() == (said, files)
    row = "power cut | compiled code on the disk is empty, cut, or ends in zeros | compiled again, no word"
    record_property("reliability", f"{row} | {len(files)} files, status 0")


def _some_code(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "whole.nbi").write_bytes(pickle.dumps("x"))
    (folder / "cut.nbi").write_bytes(pickle.dumps("x")[:-1])
    (folder / "zeros.nbc").write_bytes(pickle.dumps("x")[:-1] + bytes(9))
    (folder / "empty.nbc").write_bytes(b"")


def test_whole_files_of_compiled_code_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    ours, theirs = tmp_path / "drivers_1", tmp_path / "others_1"
    for folder in (ours, theirs):
        _some_code(folder)
    clean()
    assert {path.name for path in ours.iterdir()} <= {"whole.nbi", CHECKED_FILE}
    assert len(list(theirs.iterdir())) == 4


@pytest.mark.parametrize("mark", [None, b"", bytes(36), b"another-start"])
def test_compiled_code_is_looked_at_once_after_the_computer_has_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mark: bytes | None
) -> None:
    """mark : what a power cut left of it, or one that is older than the power cut."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    (tmp_path / "boot_id").write_text("this-start\n")
    folder = tmp_path / "drivers_1"
    _some_code(folder)
    if mark is not None:
        (folder / CHECKED_FILE).write_bytes(mark)
    clean(boot_id=tmp_path / "boot_id")
    assert sorted(path.name for path in folder.iterdir()) == [CHECKED_FILE, "whole.nbi"]
    _some_code(folder)
    clean(boot_id=tmp_path / "boot_id")
    assert len(list(folder.iterdir())) == 5, "looked at again"
    (tmp_path / "boot_id").write_text("the-next-start\n")
    clean(boot_id=tmp_path / "boot_id")
    assert sorted(path.name for path in folder.iterdir()) == [CHECKED_FILE, "whole.nbi"]


def test_compiled_code_is_looked_at_each_time_where_the_system_names_no_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    for _ in range(2):
        _some_code(tmp_path / "drivers_1")
        clean(boot_id=tmp_path / "nowhere")
        assert len(list((tmp_path / "drivers_1").glob("*.nb[ic]"))) == 1
