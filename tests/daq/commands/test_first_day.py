"""Mistakes of a first day: each is one line that says what, where, the true cause and what to do."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from promises import PATIENCE_S

from daq.commands.cli.app import main

PROJECT_FOLDER = Path(__file__).parents[3]
CONFIGS_FOLDER = PROJECT_FOLDER / "configs"
OWN_RIG = "one_bearing.toml"
MAPPED_RIG = "canedge_imu.toml"
WITHOUT_RIGHTS = ("setpriv", "--bounding-set=-all", "--inh-caps=-all")  # root that is not let everywhere


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what a user gives in place of what was asked for."""
    for name in (OWN_RIG, MAPPED_RIG, "canmod-gps.dbc"):
        shutil.copy(CONFIGS_FOLDER / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    Path("empty.mcap").touch()
    Path("day.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(range(256)))
    Path("good.csv").write_text("time,drive_x,drive_y\n" + "".join(f"{k / 12800},{k},{-k}\n" for k in range(40)))
    Path("folder").mkdir()
    for name in ("z.zip", "zip.mcap"):
        with zipfile.ZipFile(name, "w") as file:
            file.write("good.csv")
    return tmp_path


def said(capsys: pytest.CaptureFixture[str], notes: int = 0) -> str:
    """The one line of the error. notes : lines before it, of what is done."""
    err = capsys.readouterr().err
    assert err.count("\n") == notes + 1, err
    return err.splitlines()[-1]


@pytest.mark.parametrize(
    ("command", "status", "words"),
    [
        (["fit", OWN_RIG, "--rig", "day.mcap"], 2, "day.mcap: is a log (.mcap) and no rig file"),
        (["fit", "empty.mcap", "--rig", OWN_RIG], 4, "empty.mcap: is empty"),
        (["fit", "zip.mcap", "--rig", OWN_RIG], 4, "zip.mcap: is a ZIP archive: unpack it"),
        (["import", "z.zip", "--rig", OWN_RIG, "--out", "a.mcap"], 4, "unpack it"),
        (["import", "folder", "--rig", OWN_RIG, "--out", "a.mcap"], 4, "folder: is a folder"),
        (["import", "good.csv", "--rig", OWN_RIG, "--out", "a.csv"], 2, "choose a name that ends in .mcap"),
        (["import", "good.csv", "--rig", OWN_RIG, "--out", "no/a.mcap"], 4, "folder no does not exist; create it"),
        (["run", OWN_RIG, "--link", "virtual:", "--out", "a.csv"], 2, "choose a name that ends in .mcap"),
        (["init", "--from", "folder", "--out", "new.toml"], 2, "folder: is a folder"),
        (["init", "--example", "one_bearing", "--out", "no/new.toml"], 2, "folder no does not exist; create it"),
        (["trend", "no"], 4, "no: there is no such folder"),
        (["add", "crack", "--rig", "chain.toml", "--out", "b.toml", "--at", "bearing9"], 2, "there is disc"),
    ],
)
def test_what_is_no_such_file(
    here: Path, command: list[str], status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(CONFIGS_FOLDER / "tiwari_vyas_1997.toml", "chain.toml")
    before = sorted(here.rglob("*"))
    assert main(command) == status
    assert words in said(capsys)
    assert sorted(here.rglob("*")) == before


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        (OWN_RIG, "low = 100.0", "low = 100,5", "100,5: a decimal comma; write 100.5"),
        (OWN_RIG, "schema = 1", "schema = 2", "schema: 2 is not 1"),
        (MAPPED_RIG, "gnss_imu.AccelerationX", "gnss_imu.AccelX", "did you mean 'AccelerationX'?"),
        (MAPPED_RIG, "gnss_imu.AccelerationX", "imu.AccelerationX", "did you mean 'gnss_imu'?"),
        (MAPPED_RIG, "gnss_imu.AccelerationX", "gnss_imu.AccelerationY", "is the signal of imu_x already"),
        (MAPPED_RIG, 'imu_y = "gnss_imu.AccelerationY"', "", "no signal for imu_y; add imu_y ="),
        (MAPPED_RIG, "canmod-gps.dbc", "no.dbc", "no.dbc: the DBC of [link] cannot be read: No such file"),
        (MAPPED_RIG, "canmod-gps.dbc", OWN_RIG, f"{OWN_RIG}: the DBC file cannot be read"),
    ],
)
def test_check_finds_what_a_run_would_refuse(
    here: Path, name: str, old: str, new: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = Path(name).read_text("utf-8")
    assert old in text
    Path("wrong.toml").write_text(text.replace(old, new, 1), "utf-8")
    assert main(["check", "wrong.toml"]) == 2
    assert words in said(capsys)


def test_a_text_of_another_encoding_is_said(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("latin.toml").write_bytes('name = "Lüfter"'.encode("latin-1"))
    assert main(["check", "latin.toml"]) == 2
    assert "save it as UTF-8" in said(capsys)


def test_a_port_in_use_is_said_plainly(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
        assert main(["simulate", OWN_RIG, "--serve", f"serial:socket://127.0.0.1:{port}"]) == 3
    assert "cannot listen there: Address already in use: choose another port" in said(capsys, notes=1)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["info", "closed.mcap"], "closed.mcap: cannot be read: Permission denied; ask its owner"),
        (["import", "closed.csv", "--rig", OWN_RIG, "--out", "a.mcap"], "closed.csv: no permission to read it"),
        (["check", "closed.toml"], "closed.toml: cannot be read: Permission denied; ask its owner"),
        (
            ["severity", "good.csv", "--rig", OWN_RIG, "--rerun", "shut/x.rrd"],
            "shut/x.rrd: no permission to write there",
        ),
        (
            ["severity", "good.csv", "--rig", OWN_RIG, "--html", "shut/x.html"],
            "shut/x.html: no permission to write there",
        ),
    ],
)
def test_without_permission_the_owner_is_to_be_asked(here: Path, command: list[str], words: str) -> None:
    for name in ("closed.mcap", "closed.csv", "closed.toml"):
        Path(name).touch(mode=0o000)
    Path("shut").mkdir(mode=0o555)
    rights = WITHOUT_RIGHTS if os.geteuid() == 0 else ()
    done = subprocess.run(
        [*rights, sys.executable, "-m", "daq", *command], env={**os.environ, "PYTHONPATH": str(PROJECT_FOLDER)},
        capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode in (2, 4)
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


def test_help_into_a_pipe_that_closes_is_no_failure() -> None:
    command = f'"{sys.executable}" -m daq --help | head -1; exit ${{PIPESTATUS[0]}}'
    done = subprocess.run(
        ["bash", "-c", command], cwd=PROJECT_FOLDER, capture_output=True, check=False, timeout=PATIENCE_S
    )
    assert (done.returncode, done.stderr) == (0, b"")
