"""Compiled code finds a place, and nobody else's."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from daq.cache_place import VARIABLE, choose


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Nothing of numba's own can be written (root can write anything but this): only the temporary files."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("daq.cache_place.__file__", "/proc/nowhere/daq/cache_place.py")
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nowhere")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_numba_is_left_alone_where_it_can_write(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    choose()
    assert VARIABLE not in os.environ


def test_a_read_only_installation_without_a_home(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    choose()
    first = Path(os.environ[VARIABLE])
    assert first.parent == nowhere
    assert stat.S_IMODE(first.stat().st_mode) == 0o700
    monkeypatch.delenv(VARIABLE)
    choose()
    assert Path(os.environ[VARIABLE]) == first  # what was compiled is there the next time


@pytest.mark.parametrize("trap", ["others may write", "link", "file"])
def test_a_place_that_another_may_have_prepared_is_not_taken(nowhere: Path, trap: str) -> None:
    choose()
    first = Path(os.environ.pop(VARIABLE))
    if trap == "others may write":
        first.chmod(0o777)
    else:
        first.rmdir()
        (nowhere / "theirs").mkdir()
        first.symlink_to(nowhere / "theirs") if trap == "link" else first.write_text("")
    choose()
    taken = Path(os.environ[VARIABLE])
    assert taken != first
    assert taken.parent == nowhere
    assert stat.S_IMODE(taken.stat().st_mode) == 0o700
