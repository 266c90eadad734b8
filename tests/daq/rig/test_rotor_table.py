"""shaft = "matrices": the file, its names, and what is wrong with them, each in one line."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from daq.base.contract.errors import ConfigError
from daq.commands.cli.app import main
from daq.rig.rig import Rig, load_rig

CONFIGS_FOLDER = Path(__file__).parents[3] / "configs"
EXAMPLE_RIG = (CONFIGS_FOLDER / "two_discs.toml").read_text("utf-8")
Arrays = dict[str, np.ndarray]


def given() -> Arrays:
    with np.load(CONFIGS_FOLDER / "two_discs.npz") as arrays:
        return {name: arrays[name] for name in arrays.files}


def said(folder: Path, text: str, arrays: Arrays | None = None) -> str:
    """All lines that a rig file is refused with."""
    if arrays is not None:
        np.savez(folder / "two_discs.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(ConfigError) as raised:
        Rig.parse(text, folder, folder / "rig.toml")
    return str(raised.value)


def changed(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Arrays:
    arrays = given()
    arrays[name] = change(arrays[name].copy())
    return arrays


def with_entry(i: int, j: int, factor: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(A: np.ndarray) -> np.ndarray:
        A[i, j] *= factor
        return A

    return change


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        (changed("K", with_entry(0, 4, 1.5)), r"K is not symmetric \(K\[0, 4\] = .*bearings and seals left out"),
        (changed("K", lambda K: K[:-1]), "K is 77 x 78, and M has 78 rows"),
        (changed("K", lambda K: K * np.nan), "K holds a number that is not finite"),
        (changed("K", lambda K: -K), r"K\[0, 0\] = .* is not above 0: check its signs"),
        (changed("M", with_entry(24, 24, 0.0)), r"M\[24, 24\] = 0 is not above 0: condense what has no mass"),
        (changed("G", np.abs), "G is not skew-symmetric"),
        (changed("dofs_per_node", lambda n: n - 1), "dofs_per_node: is missing: say 1 "),
        (changed("dofs_per_node", lambda n: n - 2), "78 rows, which is no multiple of it"),
        ({"K": np.eye(78)}, "there is no M, but K; M and K are needed"),
    ],
)
def test_matrices_that_are_none_of_a_shaft(arrays: Arrays, expected: str, tmp_path: Path) -> None:
    lines = said(tmp_path, EXAMPLE_RIG, arrays)
    assert len(lines.splitlines()) == 1
    assert re.search(expected, lines), lines


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("two_discs.npz", "none.npz", "there is no file"),
        ("two_discs.npz", "rotor.toml", "rotorscope rotor rotor.toml --out rotor.npz writes its matrices"),
        ("two_discs.npz", "rotor.mat", "matrices come from .npz or .json"),
        ("free = 10 }", "free = 40 }", "free = 40: the model has the nodes 0 to 12"),
        ("free = 10 }", "free = 1 }", "drive and free are both at node 1"),
        ("{ drive = 1, free = 10 }", "{}", "names no bearing"),
        ("drive = 1", "Drive = 1", "small letters, digits and _"),
        ("fan = 5", "free = 5", '"free" is a bearing too'),
        ('node = "free"', 'node = "fre"', '"fre" is not one of drive, free; did you mean "free"?'),
        ("free = 0.3", "bearing2 = 0.3", "rig.mass.bearing2: unknown key; the keys here are drive, free"),
        ("[model.linear.free]", "[model.linear.bearing2]", "model.linear.bearing2: unknown key"),
        ("free = 0.3", "free = 0.3\ndisc = 2.0", "discs are in the matrices"),
        ("[band]", "[rig.shaft_spring]\nstiffness = 1e6\n[band]", "has its stiffness in \\[rig.rotor\\]"),
        ('shaft = "matrices"', 'shaft = "matrices"\nbearings = ["a"]', "the names are those of \\[rig.rotor\\]"),
        ('effects = ["cubic"]', 'effects = ["cubic", "bow"]', '"bow" acts on a massless shaft'),
        ("discs = {", "# discs = {", ""),
    ],
)
def test_what_does_not_fit_together(old: str, new: str, expected: str, tmp_path: Path) -> None:
    text = EXAMPLE_RIG.replace(old, new)
    if not expected:
        text = text.replace('effects = ["cubic"]', 'effects = ["cubic", "imbalance"]')
        expected = "acts on a disc: name one in \\[rig.rotor\\] discs"
    lines = said(tmp_path, text, given())
    assert re.search(expected, lines), lines


def test_gyroscopic_moments_need_both_directions(tmp_path: Path) -> None:
    head, *channels = EXAMPLE_RIG.split("[[channel]]")
    only_x = head + "".join(f"[[channel]]{c}" for c in channels if 'direction = "x"' in c)
    assert "drive is measured in x alone: measure both directions, or leave G out" in said(tmp_path, only_x, given())


def test_a_log_holds_the_matrices() -> None:
    rig = load_rig(CONFIGS_FOLDER / "two_discs.toml")
    attached = rig.attachments()
    assert set(attached) == {"rig.toml", "rotor.npz"}
    again = Rig.parse(attached["rig.toml"].decode(), attached=attached)
    assert rig.model.rotor is not None
    assert again.model.rotor is not None
    assert np.array_equal(again.model.rotor.K, rig.model.rotor.K)
    with pytest.raises(ConfigError, match="is not in the log; give the rig file itself: --rig"):
        Rig.parse(rig.text)


def test_a_rig_file_that_comes_out_of_a_log_brings_its_matrices(tmp_path: Path) -> None:
    moved = tmp_path / "models"
    moved.mkdir()
    (moved / "shaft.npz").write_bytes((CONFIGS_FOLDER / "two_discs.npz").read_bytes())
    (tmp_path / "rig.toml").write_text(EXAMPLE_RIG.replace("two_discs.npz", "models/shaft.npz"))
    log = tmp_path / "log.mcap"
    simulate = ["simulate", str(tmp_path / "rig.toml"), "--out", str(log), "--seconds", "0.2", "--speed", "max"]
    assert main(simulate) == 0
    out = tmp_path / "elsewhere" / "rig.toml"
    out.parent.mkdir()
    assert main(["init", "--from", str(log), "--out", str(out), "--quiet"]) == 0
    assert 'file = "shaft.npz"' in out.read_text()
    assert load_rig(out).model.rotor is not None


INLINE_RIG = """schema = 1
[rig]
shaft = "matrices"
[rig.rotor]
bearings = { drive = 0, free = 2 }
dofs_per_node = 1
M = [[1, 0, 0], [0, 2.0, 0], [0, 0, 1]]
K = [[1e6, -1e6, 0], [-1e6, 2e6, -1e6], [0, -1e6, 1e6]]
[band]
low = 10.0
high = 1000.0
[[channel]]
name = "a"
node = "drive"
direction = "x"
unit = "g"
"""


def test_small_matrices_may_stand_in_the_rig_file_and_both_planes_are_alike() -> None:
    rotor = Rig.parse(INLINE_RIG).model.rotor
    assert rotor is not None
    assert rotor.dofs == ("drive.x", "free.x", "shaft1.x", "drive.y", "free.y", "shaft1.y")
    assert rotor.discs == ()


def test_bearings_of_a_rig_without_shaft_have_names_too() -> None:
    head = INLINE_RIG[: INLINE_RIG.index("[rig.rotor]")]
    text = head.replace('"matrices"', '"none"\nbearings = ["drive", "mid", "free"]')
    text += INLINE_RIG[INLINE_RIG.index("[band]") :]
    assert Rig.parse(text).model.bearings == ("drive", "mid", "free")
    with pytest.raises(ConfigError, match="joins two bearings, not 3"):
        Rig.parse(text.replace('"none"', '"chain"'))
    with pytest.raises(ConfigError, match='"shaft" is no name for a bearing'):
        Rig.parse(text.replace('"mid"', '"shaft"'))
