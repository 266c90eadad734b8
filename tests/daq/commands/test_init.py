"""The command init: from data, a log, a DBC, an example, answers; what it writes is valid and works at once."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from promises import PATIENCE_S

from daq.commands.cli.app import main
from daq.commands.start.examples import example_files
from daq.commands.start.guess import guesses
from daq.commands.start.init import rate_of
from daq.commands.start.questions import ask
from daq.commands.start.text import rig_text
from daq.rig.rig import Rig, load_rig

REPOSITORY_FOLDER = Path(__file__).parents[3]
RATE_HZ = 6400.0


def made(tmp_path: Path, *arguments: str) -> Rig:
    out = tmp_path / "new.toml"
    assert main(["init", *arguments, "--out", str(out)]) == 0
    assert main(["check", str(out), "--quiet"]) == 0
    return load_rig(out)


def places(rig: Rig) -> dict[str, str]:
    return {c.name: f"{c.node}.{c.direction} {c.kind} [{c.unit}]" for c in rig.file.channel}


@pytest.mark.parametrize(("rate_hz", "digits"), [(25600.0, 9), (25600.0, 6), (44100.0, 7), (99.39, 4), (1651.6, 6)])
def test_the_rate_is_that_of_the_whole_time_column(rate_hz: float, digits: int) -> None:
    t = np.round(np.arange(40000) / rate_hz, digits)
    assert rate_of(t) == rate_hz
    assert rate_of(np.delete(t, slice(100, 150))) == rate_hz
    assert rate_of(t[::-1]) is None


def test_from_a_table_with_units_and_times(tmp_path: Path) -> None:
    t = np.arange(9000) / RATE_HZ
    y = np.random.default_rng(0).standard_normal((2, t.size))
    lines = ["time [s],Acc X [g],NDE vel V [mm/s],Temperature [degC]"]
    lines += [f"{a:.9f},{b:.6f},{c:.6f},20" for a, b, c in zip(t, *y, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    rig = made(tmp_path, "--from", str(tmp_path / "a.csv"))
    assert places(rig) == {"Acc_X": "bearing1.x acceleration [g]", "NDE_vel_V": "bearing2.y velocity [mm/s]"}
    assert rig.acquisition is not None
    assert rig.acquisition.rate_hz == RATE_HZ
    assert rig.model.band == (10.0, 2500.0)
    log = str(tmp_path / "a.mcap")
    assert main(["import", str(tmp_path / "a.csv"), "--rig", str(tmp_path / "new.toml"), "--out", log]) == 0
    assert main(["severity", log, "--rig", str(tmp_path / "new.toml"), "--quiet"]) == 0


def test_from_an_archive_that_says_no_unit(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", b1x=np.zeros(9), b2y=np.zeros(9), rate_hz=RATE_HZ)
    rig = made(tmp_path, "--from", str(tmp_path / "a.npz"))
    assert places(rig) == {"b1x": "bearing1.x acceleration [m/s^2]", "b2y": "bearing2.y acceleration [m/s^2]"}
    assert "# check: not said there" in rig.text


def test_from_a_log_the_rig_file_in_it(tmp_path: Path) -> None:
    shutil.copy(REPOSITORY_FOLDER / "configs" / "one_bearing.toml", tmp_path / "rig.toml")
    log = str(tmp_path / "a.mcap")
    main(["simulate", str(tmp_path / "rig.toml"), "--out", log, "--seconds", "1", "--speed", "max", "--quiet"])
    assert made(tmp_path, "--from", log).text.strip() == (tmp_path / "rig.toml").read_text().strip()


def test_from_a_dbc_the_signals_in_units_of_vibration(tmp_path: Path) -> None:
    shutil.copy(REPOSITORY_FOLDER / "configs" / "canmod-gps.dbc", tmp_path / "device.dbc")
    rig = made(tmp_path, "--from", str(tmp_path / "device.dbc"))
    assert rig.link.signals["AccelerationX"] == "gnss_imu.AccelerationX"
    assert places(rig)["AccelerationZ"] == "bearing1.z acceleration [m/s^2]"
    assert rig.dbc == tmp_path / "device.dbc"


@pytest.mark.parametrize("name", sorted(example_files()))
def test_every_example_works_where_it_is_copied_to(name: str, tmp_path: Path) -> None:
    made(tmp_path, "--example", name)


def test_an_answer_that_can_be_read_in_two_ways_is_asked_again() -> None:
    answers = iter(["2.5", "2", "g", "12,800", "12800", "1480 rpm", "1480", "0,35", "unknown"])
    asked: list[str] = []

    def answer(question: str) -> str:
        asked.append(question)
        return next(answers)

    new = ask("pump", answer)
    assert (len(new.channels), new.rate_hz, new.speed_rpm, new.mass_kg, new.designation) == (2, 12800, 1480, 0.35, "")
    assert "2.5: is no whole number from 1 to 4" in asked[1]
    assert "12,800: can be read in two ways: type 12800 or 12.800" in asked[4]
    assert "1480 rpm: is no number above 0\nSpeed of the shaft" in asked[6]


def test_an_end_of_the_answers_is_one_line(tmp_path: Path) -> None:
    there, here = os.openpty()
    end = subprocess.Popen(
        [sys.executable, "-m", "daq", "init", "--out", str(tmp_path / "a.toml")],
        stdin=here, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    os.close(here)
    os.write(there, b"\n\x04")
    said = end.communicate(timeout=PATIENCE_S)[1]
    os.close(there)
    assert end.returncode == 2
    assert said.strip().count("\n") == 0
    assert "the answers ended before the last question" in said
    assert not (tmp_path / "a.toml").exists()


def test_answers_make_a_rig_and_wrong_ones_are_asked_again() -> None:
    answers = iter(["9", "4", "furlong", "g", "12800", "1480", "", "9999", "6205"])
    asked: list[str] = []

    def answer(question: str) -> str:
        asked.append(question)
        return next(answers)

    rig = Rig.parse(rig_text(ask("pump", answer)))
    assert [c.place for c in rig.model.channels] == ["bearing1.x", "bearing1.y", "bearing2.x", "bearing2.y"]
    assert (rig.model.speed_rpm, rig.model.band[1]) == (1480.0, 5000.0)
    assert rig.model.bearing is not None
    assert rig.model.bearing.balls == 9
    assert len(asked) == 9


def test_no_place_is_taken_twice() -> None:
    found = list(guesses([(f"ch{k}", "g") for k in range(6)] + [("counter", ""), ("rpm", "1/min")]))
    assert [(g.node, g.direction) for g in found] == [
        ("bearing1", "x"), ("bearing1", "y"), ("bearing2", "x"), ("bearing2", "y"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        ([], 2, "give --from FILE (data, log or DBC) or --example NAME (can_accelerometers"),
        (["--example", "one_baering"], 2, 'did you mean "one_bearing"'),
        (["--example", "?"], 2, "there are can_accelerometers"),
        (["--example", "a", "--from", "b"], 2, "give one of the two"),
        (["--from", "none.csv"], 2, "there is no such file"),
        (["--from", "empty.dbc"], 2, "no signal in a unit of vibration"),
        (["--from", "bare.dbc"], 2, "no signal in a unit of vibration (m/s^2, g, mm/s ...); it has none"),
        (["--from", "words.csv"], 4, "words.csv"),
        (["--from", "broken.dbc"], 2, "broken.dbc"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], status: int, words: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("bare.dbc").write_text('VERSION ""\nBU_: X\n')
    Path("empty.dbc").write_text(
        'VERSION ""\nBO_ 100 Message: 8 Vector__XXX\n SG_ Speed : 0|16@1+ (1,0) [0|1] "rpm" X\n'
    )
    Path("broken.dbc").write_text("BO_ what")
    Path("words.csv").write_text("")
    assert main(["init", *arguments, "--out", "new.toml"]) == status
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1
    assert not Path("new.toml").exists()


def test_without_out_the_file_is_rig_toml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init", "--example", "one_bearing", "--quiet"]) == 0
    assert main(["check", "rig.toml", "--quiet"]) == 0


def test_nothing_is_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.toml").write_text("mine")
    assert main(["init", "--example", "one_bearing", "--out", str(tmp_path / "rig.toml")]) == 2
    assert "is not written over" in capsys.readouterr().err
    assert (tmp_path / "rig.toml").read_text() == "mine"
