"""What an installation holds and needs: extras, the headless list, files in the wheel, names of packages."""

from __future__ import annotations

import os
import re
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from daq.commands.check import overwritten
from daq.commands.cli.app import main

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
LOCKED = ("formats", "report", "monitor", "batch", "dev", "docs")  # extras that CI installs
RIG = str(ROOT / "configs" / "one_bearing.toml")


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[<>=\[ ]", text)[0].lower() for text in requirements}


def test_the_headless_list_is_the_core_without_the_viewer() -> None:
    lines = (ROOT / "docs" / "headless.txt").read_text("utf-8").splitlines()
    core = PROJECT["project"]["dependencies"]
    assert {line for line in lines if line and not line.startswith("#")} == {d for d in core if "rerun" not in d}


def test_the_core_keeps_its_packages_and_all_has_every_extra() -> None:
    fixed = {"python-can", "pyserial", "numpy", "scipy", "mcap", "rerun-sdk"}
    extras = PROJECT["project"]["optional-dependencies"]
    assert fixed <= names(PROJECT["project"]["dependencies"])
    assert extras["all"] == ["rotorscope[formats,report,monitor,batch]"]
    assert "rotorscope[all]" in extras["dev"]


def test_ci_has_an_exact_version_of_every_package_and_no_place_where_to_get_it() -> None:
    lines = (ROOT / ".ci" / "constraints.txt").read_text("utf-8").splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.+!]+", pin) for pin in pins)
    pinned = {re.sub(r"[-_.]+", "-", pin.split("==")[0].lower()): pin.split("==")[1] for pin in pins}
    extras = PROJECT["project"]["optional-dependencies"]
    asked = [*PROJECT["project"]["dependencies"], *(t for name, own in extras.items() if name in LOCKED for t in own)]
    for text in asked:
        requirement = Requirement(text)
        name = re.sub(r"[-_.]+", "-", requirement.name.lower())
        assert name == "rotorscope" or requirement.specifier.contains(pinned[name]), text
    assert 'PIP_CONSTRAINT="$PWD/.ci/constraints.txt"' in (ROOT / ".ci" / "run").read_text("utf-8")


def test_the_wheel_names_files_that_are_there() -> None:
    for patterns in PROJECT["tool"]["setuptools"]["data-files"].values():
        for pattern in patterns:
            assert list(ROOT.glob(pattern)), pattern
    for name in PROJECT["project"]["license-files"]:
        assert (ROOT / name).is_file()


@pytest.mark.parametrize(
    ("modules", "command", "words"),
    [
        (
            ("matplotlib", "matplotlib.figure"),
            ["severity", "x.mcap", "--rig", RIG, "--html", "x.html"],
            "rotorscope[report]",
        ),
        (("jinja2",), ["compare", "x.mcap", "--rig", RIG, "--html", "x.html"], "rotorscope[report]"),
        (("matplotlib",), ["reproduce", "out"], "rotorscope[report]"),
        (("rerun",), ["diagnose", "x.mcap", "--rig", RIG, "--rerun", "x.rrd"], "rerun-sdk>=0.41,<0.42"),
        (("rerun",), ["run", RIG, "--link", "virtual:", "--rerun", "x.rrd"], "rerun-sdk>=0.41,<0.42"),
        (
            ("pyarrow",),
            ["run", RIG, "--link", "virtual:", "--out", "x", "--segment", "10min"],
            "rotorscope[formats]",
        ),
        (("distributed",), ["batch", "*.mcap", "--rig", RIG, "--out", "x"], "rotorscope[batch]"),
        (
            ("paho", "paho.mqtt.client"),
            ["run", "alarmed.toml", "--link", "virtual:", "--mqtt", "mqtt://a"],
            "rotorscope[monitor]",
        ),
        (("ross",), ["rotor", "alarmed.toml", "--out", "x.npz"], "rotorscope[ross]"),
        (("prometheus_client",), ["run", RIG, "--link", "virtual:", "--metrics", "0"], "rotorscope[monitor]"),
    ],
)
def test_a_missing_library_is_one_line_with_what_to_type(
    modules: tuple[str, ...], command: list[str], words: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)
    if "alarmed.toml" in command:
        alarm = '\n[[alarm]]\nwhat = "missing_force"\nlimit = 3.0\n'
        Path("alarmed.toml").write_text(Path(RIG).read_text("utf-8") + alarm, "utf-8")
    assert main(command) == 2
    err = capsys.readouterr().err
    assert f"pip install '{words}'" in err
    assert err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == [name for name in command if name == "alarmed.toml"]


@pytest.mark.parametrize(
    ("suffix", "module"), [("mf4", "asammdf"), ("tdms", "nptdms"), ("h5", "h5py"), ("parquet", "pyarrow")]
)
def test_a_format_without_its_library_is_one_line_with_what_to_type(
    suffix: str, module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Such files are read in a process of its own: the library is hidden from that by a file of its name."""
    (tmp_path / f"{module}.py").write_text(f"raise ModuleNotFoundError(name={module!r})\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{ROOT}")
    data = tmp_path / f"a.{suffix}"
    data.write_bytes(b"x")
    assert main(["import", str(data), "--rig", RIG, "--out", str(tmp_path / "a.mcap")]) == 4
    err = capsys.readouterr().err
    assert module in err
    assert "pip install 'rotorscope[formats]'" in err
    assert err.count("\n") == 1


def test_another_package_of_our_names_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert overwritten() == []
    about = tmp_path / "pydaq-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: pydaq\nVersion: 1.0\n")
    (about / "RECORD").write_text("daq/__init__.py,,\nnumpy/__init__.py,,\npydaq-1.0.dist-info/METADATA,,\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert overwritten() == [
        'the package "daq" is also installed by pydaq: uninstall that, and install rotorscope again'
    ]
