"""The public names of the two packages that a notebook imports: one set, bound at first use."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from daq import ConfigError, LogError, Rig, acquire, load_rig, read_log, replay
from drivers.contract import LinkError

ROOT = Path(__file__).parents[2]
PACKAGES = ("daq", "estimator")
HEAVY = {"numba", "scipy", "rerun", "typer", "pydantic", "mcap"}
RIG = "configs/one_bearing.toml"


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """The examples name files as a reader of the repository does."""
    monkeypatch.chdir(ROOT)


def type_checking_names(package: str) -> Iterator[str]:
    tree = ast.parse((ROOT / package / "__init__.py").read_text("utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        yield from (alias.name for alias in node.names)


@pytest.mark.parametrize("package", PACKAGES)
def test_dict_type_checking_block_and_all_are_one_set(package: str) -> None:
    module = importlib.import_module(package)
    names = sorted(module._ROOM_OF)
    assert names == sorted(module.__all__) == sorted(type_checking_names(package))
    for name in names:
        assert getattr(module, name) is not None
        assert name in dir(module)
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = module.no_such_name


@pytest.mark.parametrize("package", PACKAGES)
def test_the_import_of_a_package_loads_nothing_heavy(package: str) -> None:
    code = f"import sys, {package}; print(*sorted({HEAVY!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == []


def test_a_record_of_the_virtual_link_comes_as_an_array_and_is_replayed(tmp_path: Path) -> None:
    rig = load_rig(RIG)
    log = tmp_path / "a.mcap"
    summary = acquire(rig, "virtual:", seconds=0.25, out=log)
    recording = read_log(log)
    y = recording.samples(rig)
    assert y.dtype == np.float64
    assert y.shape == (summary.samples, len(rig.model.channels)) == (3200, 2)
    assert np.isfinite(y).all()
    assert recording.rate_hz == 12800.0
    again = replay(recording, out=tmp_path / "b.mcap", check=True)
    assert again.identical
    np.testing.assert_array_equal(read_log(tmp_path / "b.mcap").samples(rig), y)


def test_the_channels_come_in_the_order_of_the_rig_and_without_clipped_values(tmp_path: Path) -> None:
    rig = load_rig(RIG)
    text = rig.text
    first, second = text.index('name = "drive_x"'), text.index('name = "drive_y"')
    assert first < second
    swapped = text.replace("drive_x", "?").replace("drive_y", "drive_x").replace("?", "drive_y")
    swapped = swapped.replace('direction = "x"', "?").replace('direction = "y"', 'direction = "x"')
    other = Rig.parse(swapped.replace("?", 'direction = "y"'))
    acquire(rig, "virtual:", seconds=0.25, out=tmp_path / "a.mcap")
    recording = read_log(tmp_path / "a.mcap")
    np.testing.assert_array_equal(recording.samples(other), recording.samples(rig)[:, ::-1])
    np.testing.assert_array_equal(recording.samples(), recording.samples(rig))


def test_errors_are_one_line(tmp_path: Path) -> None:
    rig = load_rig(RIG)
    acquire(rig, "virtual:", seconds=0.25, out=tmp_path / "a.mcap")
    bearing2 = Rig.parse(rig.text.replace("drive_y", "other_y"))
    too_high = Rig.parse(rig.text.replace("high = 4000.0", "high = 6400.0").replace("12800.0", "25600.0"))
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    cases = [
        (ConfigError, lambda: load_rig(tmp_path / "none.toml")),
        (ConfigError, lambda: acquire(rig)),
        (ConfigError, lambda: replay(tmp_path / "a.mcap", out=tmp_path / "a.mcap")),
        (LinkError, lambda: acquire(rig, "serial")),
        (LinkError, lambda: acquire(rig, f"serial:{tmp_path}/no_port", seconds=0.1)),
        (LogError, lambda: read_log(tmp_path / "none.mcap")),
        (LogError, lambda: read_log(empty)),
        (LogError, lambda: read_log(tmp_path / "a.mcap").samples(bearing2)),
        (LogError, lambda: read_log(tmp_path / "a.mcap").samples(too_high, note=[].append)),
        (LogError, lambda: replay(tmp_path / "none.mcap")),
    ]
    for kind, call in cases:
        with pytest.raises(kind) as caught:
            call()
        text = str(caught.value)
        assert text, kind
        assert "\n" not in text
