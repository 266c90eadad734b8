"""`rotorscope import` of recorded CAN traffic: which bus, and what to type."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest

from daq.commands.cli.app import main
from daq.log.reader import read_log

RIG_TEXT = """schema = 1
[band]
low = 1.0
high = 40.0
[acquisition]
rate_hz = 100.0
[[channel]]
name = "b1x"
node = "bearing1"
direction = "x"
unit = "m/s^2"
[link]
dbc = "a.dbc"
[link.signals]
b1x = "M.X"
"""
DBC_TEXT = """VERSION ""
BS_:
BU_: d
BO_ 256 M: 2 d
 SG_ X : 0|16@1- (1,0) [0|0] "m/s^2" d
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(RIG_TEXT)
    Path("a.dbc").write_text(DBC_TEXT)
    return tmp_path


@pytest.mark.promise("two buses in an import", "the offered command is typed", "it reads the right bus")
def test_of_two_buses_the_command_that_is_offered_works(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = []
    for k in range(400):
        s = f"{1700000000 + k // 100}.{k % 100 * 10000:06d}"
        lines += [f"({s}) can0 100#{k:04X}", f"({s[:-4]}{int(s[-4:]) + 3000:04d}) can1 100#{9 * k % 7777:04X}"]
    Path("my log.log").write_text("\n".join(lines) + "\n")
    assert main(["import", "my log.log", "--rig", "rig.toml", "--out", "a.mcap"]) == 3
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "several buses (400 on bus can0, 400 on bus can1)" in error
    offered = error.partition("choose one: ")[2].strip()
    words = shlex.split(offered.split(" or ")[0])[1:]
    assert words == ["import", "my log.log?bus=can0", "--rig", "rig.toml", "--out", "a.mcap"]
    assert main(words) == 0
    raw = np.arange(400)
    expected = (((raw & 0xFF) << 8) | (raw >> 8)).astype(np.uint16).view(np.int16)
    np.testing.assert_array_equal(read_log("a.mcap").samples()[:, 0], expected)
    assert main(["import", "my log.log?bus=7", "--rig", "rig.toml", "--out", "b.mcap"]) == 3
    assert "there is no bus 7 in it: it has can0, can1; choose one: rotorscope import" in capsys.readouterr().err


def test_a_folder_is_called_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("a.log").mkdir()
    assert main(["import", "a.log", "--rig", "rig.toml", "--out", "a.mcap"]) == 4
    assert "a.log: is a folder; give a file in it" in capsys.readouterr().err
