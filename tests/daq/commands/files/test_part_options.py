"""--from, --to, --seconds and --channels of every command that reads a log or a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from daq.commands.cli.app import main
from daq.log.reader import read_log
from daq.rig.edit import of_channels
from daq.rig.rig import load_rig

RATE_HZ = 5120.0
RIG_TEXT = """schema = 1
[band]
low = 100.0
high = 2000.0
[acquisition]
rate_hz = 5120.0
[rig.mass]
bearing1 = 2.0
bearing2 = 2.0
[model]
effects = ["cubic"]
[model.cubic]
at = ["bearing1.x", "bearing2.x"]
# both ends
[[channel]]
name = "b1x"
node = "bearing1"
direction = "x"
unit = "m/s^2"
# the far end
[[channel]]
name = "b2x"
node = "bearing2"
direction = "x"
unit = "m/s^2"
"""
CAN_LINK_TEXT = """[link]
dbc = "a.dbc"
[link.signals]
b1x = "M.X"
b2x = "M.Y"
"""
DBC_TEXT = """VERSION ""
BS_:
BU_: d
BO_ 256 M: 4 d
 SG_ X : 0|16@1- (1,0) [0|0] "m/s^2" d
 SG_ Y : 16|16@1- (1,0) [0|0] "m/s^2" d
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(RIG_TEXT)
    return tmp_path


def record(seconds: float) -> np.ndarray:
    """Two resonances at 500 Hz, driven by noise."""
    pole = 0.97 * np.exp(2j * np.pi * 500.0 / RATE_HZ)
    noise = np.random.default_rng(1).standard_normal((round(seconds * RATE_HZ), 2))
    return np.asarray(lfilter([1.0, -1.0], [1.0, -2 * pole.real, abs(pole) ** 2], noise, axis=0))


def log(seconds: float = 4.0, **more: object) -> np.ndarray:
    y = record(seconds)
    np.savez("a.npz", b1x=y[:, 0], b2x=y[:, 1], rate_hz=RATE_HZ, started="2024-05-01T12:00:00Z", **more)  # type: ignore[arg-type]
    assert run("import a.npz --rig rig.toml --out a.mcap") == 0
    return y


def run(command: str) -> int:
    return main(command.split())


def result_of(capsys: pytest.CaptureFixture[str], command: str) -> dict[str, Any]:
    capsys.readouterr()
    assert run(f"{command} --json -") == 0
    value: dict[str, Any] = json.loads(capsys.readouterr().out)
    return value


def test_each_command_takes_the_part(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    y = log()
    asked = "--from 1 --to 3.5 --channels b1x"
    value = result_of(capsys, f"info a.mcap {asked}")
    assert (value["from_s"], value["seconds"], value["channels"]) == (1.0, 2.5, ["b1x"])
    assert value["started"] == "2024-05-01T12:00:01.000000Z"
    assert run(f"export a.mcap --to b.npz {asked.replace('--to', '--until')}") == 0
    assert "its time 0 is 1 s of a.mcap" in capsys.readouterr().err
    assert result_of(capsys, f"export a.mcap --to b.npz {asked.replace('--to', '--until')}")["from_s"] == 1.0
    with np.load("b.npz") as out:
        assert str(out["started"]) == "2024-05-01T12:00:01.000000Z"
        np.testing.assert_allclose(out["b1x"], y[5120:17920, 0], atol=1e-8)
        assert "b2x" not in out
    assert result_of(capsys, f"replay a.mcap {asked} --out c.mcap")["samples"] == 12800
    np.testing.assert_array_equal(read_log("c.mcap").samples()[:, 0], read_log("a.mcap").samples()[5120:17920, 0])
    assert read_log("c.mcap").channels == ("b1x",)
    value = result_of(capsys, f"fit a.mcap --rig rig.toml {asked.replace('3.5', '3.9')} --out fitted.toml")
    assert value["samples"] <= 14848
    assert (value["from_s"], value["seconds"]) == (1.0, 2.9)
    assert {name.partition(".")[0] for name in value["parameters"]} == {"bearing1"}
    assert [c.name for c in load_rig("fitted.toml").model.channels] == ["b1x", "b2x"]
    assert result_of(capsys, "fit a.npz --rig rig.toml --from 2024-05-01T12:00:01Z --seconds 2.9")["from_s"] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("command", ["compare", "diagnose", "improve --out better.toml"])
def test_an_analysis_takes_the_part(folder: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    log()
    assert result_of(capsys, f"{command} a.mcap --rig rig.toml --seconds 3 --channels b1x")["seconds"] == 3.0
    if "--out" in command:
        assert [c.name for c in load_rig("better.toml").model.channels] == ["b1x", "b2x"]


def test_what_lies_outside_of_an_imported_part_is_not_checked(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    y, time = record(4.0), np.arange(20480) / RATE_HZ
    y[100, 0], y[20000, 1], time[18000:] = np.nan, 9.9e37, time[18000:] + 3.0
    rows = [f"{t:.9f},{a:.9g},{b:.9g}" for t, (a, b) in zip(time, y, strict=True)]
    Path("a.csv").write_text("\n".join(["time,b1x,b2x", *rows]))
    assert run("import a.csv --rig rig.toml --out a.mcap") == 4
    assert run("import a.csv --rig rig.toml --out a.mcap --from 1 --to 3") == 0
    np.testing.assert_allclose(read_log("a.mcap").samples(), y[5120:15360], atol=1e-6)
    assert run("import a.csv --rig rig.toml --out a.mcap --from 6.9 --channels b1x") == 0
    np.testing.assert_allclose(read_log("a.mcap").samples()[:, 0], y[round(3.9 * RATE_HZ) :, 0], atol=1e-6)
    capsys.readouterr()
    assert run("import a.csv --rig rig.toml --out b.mcap --from 4 --to 6") == 2
    assert "no sample lies from 4 s to 6 s" in capsys.readouterr().err
    assert not Path("b.mcap").exists()


def test_a_part_of_recorded_can_traffic(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("rig.toml").write_text(
        RIG_TEXT.replace("5120.0", "100.0").replace("= 2000.0", "= 40.0").replace("100.0\nh", "1.0\nh") + CAN_LINK_TEXT
    )
    Path("a.dbc").write_text(DBC_TEXT)
    lines = [f"({1700000000 + k // 100}.{k % 100 * 10000:06d}) can0 100#{k:04X}{k + 1:04X}" for k in range(1000)]
    Path("a.log").write_text("\n".join(lines) + "\n")
    assert run("import a.log --rig rig.toml --out whole.mcap") == 0
    whole = read_log("whole.mcap").samples()
    for asked in ("--from 2 --to 5", "--from 2023-11-14T22:13:22Z --to 2023-11-14T22:13:25Z"):
        assert run(f"import a.log --rig rig.toml --out a.mcap {asked} --channels b2x") == 0
        part = read_log("a.mcap")
        assert part.channels == ("b2x",)
        np.testing.assert_array_equal(part.samples()[:, 0], whole[200:500, 1])
        assert part.started_ns == 1_700_000_002 * 10**9
    capsys.readouterr()
    assert run("import a.log --rig rig.toml --out b.mcap --from 20") == 2
    assert "is 10 s long" in capsys.readouterr().err


def test_an_export_from_the_start_has_the_time_of_the_log(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log()
    capsys.readouterr()
    assert run("export a.mcap --to b.npz --seconds 1") == 0
    assert not capsys.readouterr().err


@pytest.mark.promise(
    "a part that is none", "empty, behind the end, unknown channel", "one line, with the length or the names"
)
@pytest.mark.parametrize(
    ("command", "status", "why"),
    [
        ("info a.mcap --from 9", 2, "a.mcap: is 4 s long"),
        ("info a.mcap --channels b1y", 2, 'no channel "b1y"; it has b1x, b2x'),
        ("export a.mcap --to b.csv --from 3 --until 2", 2, "the part is empty"),
        ("export a.mcap --to b.csv --from 3.00001 --seconds 0.0001", 2, "no sample lies"),
        ("fit a.mcap --rig rig.toml --channels b1x,b9x", 2, 'rig.toml: --channels: there is no channel "b9x"'),
        ("fit a.npz --rig rig.toml --from 7", 2, "a.npz: is 4 s long"),
        ("diagnose a.mcap --rig rig.toml --to 2023-05-01T12:00:00Z", 2, "begins at 2024-05-01T12:00:00.000000Z"),
        ("export a.mcap --to b.csv --from 2 --until 1", 2, "--from 2 is not before the end, 1"),
        ("export a.npz --to b.csv", 4, "is no log (.mcap); make one of it: rotorscope import a.npz"),
        ("severity a.mcap --rig rig.toml --html a.pdf", 2, "choose a name that ends in .html"),
        ("import a.mcap --rig rig.toml --out b.mcap", 4, "a.mcap: is a log by its ending: it is read as it is"),
        ("replay a.mcap --check --to 3", 2, "--check compares the whole log"),
        ("import a.npz a.npz --rig rig.toml --out b.mcap --to 3", 2, "are for one file"),
    ],
)
def test_a_part_that_is_none_is_refused_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], command: str, status: int, why: str
) -> None:
    log()
    capsys.readouterr()
    assert run(command) == status
    error = capsys.readouterr().err
    assert why in error
    assert error.count("\n") == 1


def test_a_date_where_the_record_has_none(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    y = record(1.0)
    np.savez("a.npz", b1x=y[:, 0], b2x=y[:, 1], rate_hz=RATE_HZ)
    assert run("import a.npz --rig rig.toml --out a.mcap") == 0
    for command in ("info a.mcap", "fit a.npz --rig rig.toml"):
        capsys.readouterr()
        assert run(f"{command} --from 2024-05-01T12:00:00Z") == 2
        assert "says no date" in capsys.readouterr().err


def test_a_rig_without_some_channels_keeps_its_words(folder: Path) -> None:
    rig = of_channels(load_rig("rig.toml"), ["b1x"])
    assert [c.name for c in rig.model.channels] == ["b1x"]
    assert rig.model.effects[0].at == ("bearing1.x",)
    assert "# both ends" in rig.text
    assert of_channels(load_rig("rig.toml"), []).text == RIG_TEXT
