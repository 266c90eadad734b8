"""`rotorscope rotor`: a model saved by ROSS as matrices; ROSS itself where it is installed, else one that stands in."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from daq.commands.cli.app import main
from daq.rig.rig import Rig

REPOSITORY_ROOT = Path(__file__).parents[3]
CONFIGS_FOLDER = REPOSITORY_ROOT / "configs"
STAND_IN = """
import numpy as np

class Element:
    def __init__(self, n, tag, n_link=None):
        self.n, self.tag, self.n_link = n, tag, n_link

class SealElement(Element):
    pass

class Rotor:
    number_dof = 4

    def __init__(self, shaft, disks, bearings=None, points=None):
        self.shaft_elements, self.disk_elements, self.point_mass_elements = shaft, disks, points
        self.bearing_elements = bearings or []

    @classmethod
    def load(cls, file):
        if "broken" in str(file):
            raise KeyError("ShaftElement")
        print("Good news: a library prints this")
        bearings = [Element(0, "Brg #1"), Element(2, "Brg #1", 3), SealElement(1, "seal")]
        return cls([], [Element(1, None)], bearings)

    def M(self, frequency=None):
        return np.eye(12)

    K = C = M

    def G(self):
        return np.zeros((12, 12))
"""


def test_the_matrices_and_the_table_for_the_rig_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ross.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "model.toml").write_text("")
    assert main(["rotor", str(tmp_path / "model.toml"), "--out", str(tmp_path / "rotor.npz")]) == 0
    said = capsys.readouterr().out
    assert 'file = "rotor.npz"\nbearings = { brg_1 = 0, brg_1_2 = 2 }\ndiscs = { disc = 1 }' in said
    assert "note: 1 seals are left out" in said
    assert "note: 1 bearings stand on supports" in said
    with np.load(tmp_path / "rotor.npz") as arrays:
        assert int(arrays["dofs_per_node"]) == 4
        assert arrays["K"].shape == (12, 12)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (
            'ross_version = "2.3"\n[parameters]\n[ShaftElement_1]\n',
            "saved by ROSS 2.3, and ROSS here cannot load it: it asks",
        ),
        ("[parameters]\n", "holds no shaft element"),
        ('[rig]\nname = "a"\n', "is a rig file (rotorscope check"),
        ("[a]\n", "no model saved by ROSS: its first table, [parameters], is missing"),
        ("[parameters", "is no whole TOML or JSON file"),
    ],
)
def test_a_file_that_ross_cannot_load_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], text: str, why: str
) -> None:
    (tmp_path / "ross.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "broken.toml").write_text(text)
    assert main(["rotor", str(tmp_path / "broken.toml"), "--out", str(tmp_path / "other.npz")]) == 2
    said = capsys.readouterr().err
    assert why in said
    assert "save the model in ROSS: rotor.save('broken.toml')" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "other.npz").exists()


def test_what_is_missing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = tmp_path / "model.toml"
    assert main(["rotor", str(model), "--out", str(tmp_path / "rotor.npz")]) == 2
    assert "no such file" in capsys.readouterr().err
    model.write_text("")
    assert main(["rotor", str(model), "--out", str(tmp_path / "rotor.mat")]) == 2
    assert "written as .npz" in capsys.readouterr().err
    if importlib.util.find_spec("ross") is None:
        assert main(["rotor", str(model), "--out", str(tmp_path / "rotor.npz")]) == 2
        assert "pip install 'rotorscope[ross]'" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ross") is None, reason="ROSS is not installed")
def test_the_example_of_the_manual_is_what_ross_makes(tmp_path: Path) -> None:
    page = (REPOSITORY_ROOT / "docs" / "rotor-models.md").read_text("utf-8")
    script = re.search(r"^    import ross.*?(?=^\S)", page, re.S | re.M)
    assert script is not None
    subprocess.run([sys.executable, "-c", textwrap.dedent(script[0])], cwd=tmp_path, check=True, capture_output=True)
    assert main(["rotor", str(tmp_path / "two_discs_ross.toml"), "--out", str(tmp_path / "two_discs.npz")]) == 0
    example = Rig.parse((CONFIGS_FOLDER / "two_discs.toml").read_text("utf-8"), tmp_path, tmp_path / "rig.toml")
    stored = Rig.parse(example.text, CONFIGS_FOLDER, CONFIGS_FOLDER / "two_discs.toml")
    assert example.model.rotor is not None
    assert stored.model.rotor is not None
    for name in "MCK":
        found, kept = (getattr(rig.model.rotor, name) for rig in (example, stored))
        assert np.abs(found - kept).max() <= 1e-6 * np.abs(kept).max()
