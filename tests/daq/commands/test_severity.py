"""The command severity: tones of known velocity through a file, a log, part of one; what is void; mistakes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from daq.commands.cli.app import main

REPOSITORY_FOLDER = Path(__file__).parents[3]
RATE_HZ = 6400.0
RIG_TOML = """
schema = 1
[rig]
speed_rpm = 1500.0
[rig.bearing]
designation = "6205"
[machine]
iso20816 = { part = 3, group = 2, support = "rigid" }
[band]
low = 20.0
high = 2000.0
[[channel]]
name = "a"
node = "bearing1"
direction = "x"
unit = "g"
[[channel]]
name = "b"
node = "bearing1"
direction = "y"
kind = "velocity"
unit = "mm/s"
"""


@pytest.fixture
def record(tmp_path: Path) -> Path:
    """25 Hz: 3 mm/s rms on the accelerometer, 5 mm/s rms on the velocity sensor."""
    (tmp_path / "rig.toml").write_text(RIG_TOML)
    t = np.arange(int(8 * RATE_HZ)) / RATE_HZ
    noise = np.random.default_rng(0).standard_normal((2, t.size))
    tone = np.sqrt(2.0) * np.sin(2 * np.pi * 25.0 * t)
    a = tone * 3e-3 * 2 * np.pi * 25.0 / 9.80665 + 1e-3 * noise[0]
    np.savez(tmp_path / "record.npz", rate_hz=RATE_HZ, a=a, b=5.0 * tone + 1e-2 * noise[1])
    return tmp_path / "record.npz"


def asked(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main(["severity", *arguments, "--json", "-"]) == 0
    value: dict[str, Any] = json.loads(capsys.readouterr().out)
    jsonschema.validate(value, json.loads((REPOSITORY_FOLDER / "docs" / "schemas" / "severity.json").read_text()))
    return value


def test_velocity_and_zone_of_a_file_and_of_its_log(record: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig, log = str(record.with_name("rig.toml")), str(record.with_suffix(".mcap"))
    assert main(["import", str(record), "--rig", rig, "--out", log, "--quiet"]) == 0
    for source in (str(record), log):
        value = asked(capsys, source, "--rig", rig)
        assert value["channels"]["a"]["velocity_rms_mm_s"] == pytest.approx(3.0, rel=0.01)
        assert value["channels"]["b"]["velocity_rms_mm_s"] == pytest.approx(5.0, rel=0.01)
        assert [value["channels"][name]["zone"] for name in "ab"] == ["C", "D"]
        assert value["zone"] == "D"
        assert (value["log"], value["rig"], value["rate_hz"]) == (source, rig, RATE_HZ)
        assert {"version", "started", "band"} <= value.keys()


def test_words_and_pages(record: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = record.with_name("page.html")
    assert main(["severity", str(record), "--rig", str(record.with_name("rig.toml")), "--html", str(page)]) == 0
    out = capsys.readouterr().out
    assert "zone D of ISO 20816-3 (group 2, rigid support) at b: severe enough to cause damage" in out
    assert "zone D" in page.read_text()


def test_what_a_part_is_too_short_for_is_void(record: Path, capsys: pytest.CaptureFixture[str]) -> None:
    value = asked(capsys, str(record), "--rig", str(record.with_name("rig.toml")), "--seconds", "0.5")
    own = value["channels"]["a"]
    assert own["velocity_rms_mm_s"] is own["zone"] is value["zone"] is None
    assert "10 Hz needs 1 s" in own["void"]["velocity_rms_mm_s"]
    assert value["seconds"] == 0.5


def test_samples_at_full_scale_void_what_they_spoil(record: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A simulated device whose range is the rms of its signal."""
    text = RIG_TOML.replace('unit = "g"', 'unit = "m/s^2"').replace(
        "[machine]", "[acquisition]\nrate_hz = 6400.0\nfull_scale = 1.0\n[machine]"
    )
    text = text[: text.rindex("[[channel]]")] + "[model.linear.bearing1.x]\nkL = 1e6\nc = 50.0\nS = 1e-4\n"
    text = text.replace("[machine]", "[rig.mass]\nbearing1 = 0.5\n[machine]")
    rig, log = record.with_name("small.toml"), str(record.with_name("small.mcap"))
    rig.write_text(text)
    assert main(["simulate", str(rig), "--out", log, "--seconds", "3", "--speed", "max", "--quiet"]) == 0
    own = asked(capsys, log, "--rig", str(rig))["channels"]["a"]
    assert own["velocity_rms_mm_s"] is own["rms"] is None
    assert "use a" in own["void"]["rms"]


@pytest.mark.parametrize(
    ("machine", "words"),
    [
        ("part = 7, category = 2, power_kw = 22.0", "ISO 10816-7 (pump of category 2, 22 kW)"),
        ('part = 1, size = "II"', "ISO 10816-1 (class II)"),
    ],
)
def test_pumps_and_the_old_classes_have_zones(
    machine: str, words: str, record: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = record.with_name("rig.toml")
    rig.write_text(RIG_TOML.replace('part = 3, group = 2, support = "rigid"', machine))
    assert main(["severity", str(record), "--rig", str(rig)]) == 0
    assert words in capsys.readouterr().out


@pytest.mark.parametrize(
    ("was", "now", "words"),
    [
        ("part = 3", "part = 2", "zones are known for parts 1, 3 and 7"),
        ("part = 3", "part = 7", "part 7 needs category and power_kw"),
        ("group = 2", 'size = "I", group = 2', "size is not of part 3, which has group and support"),
        ("group = 2", "group = 4", "machine.iso20816.group"),
        ('"rigid"', '"soft"', '"soft" is not one of rigid, flexible'),
        ("iso20816", "iso10816", "iso20816"),
    ],
)
def test_mistakes_in_the_machine_table(
    was: str, now: str, words: str, record: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = record.with_name("rig.toml")
    rig.write_text(RIG_TOML.replace(was, now))
    assert main(["severity", str(record), "--rig", str(rig)]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1
