"""What an export holds: every channel under a name of its own, the units, the date; and nothing overwritten."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from asammdf import MDF
from sessions import make_session

from daq.base.contract.dates import Recorded
from daq.commands.cli.app import main
from daq.log.writer import LogWriter
from drivers.contract import Block, Info, Signal

START_NS = 1_700_000_000 * 10**9
STARTED_UTC = "2023-11-14T22:13:20.000000Z"
TEN_NAMES = ("a.b", "a_b", "same", "same", "rate_hz", "time", "file", "2x", "same_2", "a,b")
SAMPLE_COUNTS = np.arange(500 * len(TEN_NAMES), dtype=np.int32).reshape(500, len(TEN_NAMES))
RIG_TOML = """schema = 1
[band]
low = 10.0
high = 40.0
[[channel]]
name = "time"
node = "bearing1"
direction = "x"
unit = "g"
"""


def write(folder: Path, first_ns: int = START_NS, names: tuple[str, ...] = TEN_NAMES, rig: str = RIG_TOML) -> str:
    info = Info(tuple(Signal(n, "m/s^2", 1.0) for n in names), 100.0)
    attachments = {"rig.toml": rig.encode()} if rig else {}
    writer = LogWriter(folder / "a.mcap", live=False, recorded=Recorded())
    writer.start(replace(make_session(), info=info, attachments=attachments))
    writer.readings([Block(0, SAMPLE_COUNTS[:, : len(names)], first_ns + 4_990_000_000)])
    writer.close()
    return str(folder / "a.mcap")


def columns(path: Path) -> list[np.ndarray]:
    """Every column of the channels' length in a file, whatever it is called."""
    if path.suffix == ".npz":
        with np.load(path) as file:
            return [file[n] for n in file.files if file[n].shape == (500,)]
    if path.suffix == ".mat":
        return [v.ravel() for v in scipy.io.loadmat(path).values() if np.shape(v) == (500, 1)]
    if path.suffix == ".csv":
        return list(np.loadtxt(path, delimiter=",", skiprows=1).T[1:])
    with MDF(path) as file:
        names = [c.name for c in file.groups[0].channels if c.name != "time"]
        return [file.get(n).samples for n in names]


@pytest.mark.promise(
    "names that collide in an export", "equal, `rate_hz`, dots and underscores", "every channel there, said"
)
@pytest.mark.parametrize("ending", ["npz", "mat", "csv", "mf4"])
def test_channels_whose_names_are_taken_are_all_there(
    tmp_path: Path, ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / f"b.{ending}"
    assert main(["export", write(tmp_path), "--to", str(out)]) == 0
    assert 'channel 4, "same", is called "same_3" there' in capsys.readouterr().err
    there = columns(out)
    assert len(there) == len(TEN_NAMES)
    scales = np.where(np.array(TEN_NAMES) == "time", 1 / 9.80665, 1.0)
    for k, scale in enumerate(scales):
        np.testing.assert_allclose(there[k], SAMPLE_COUNTS[:, k] * scale)


def test_the_date_is_in_every_export(tmp_path: Path) -> None:
    log = write(tmp_path, names=("b1x",))
    for ending in ("npz", "mat", "csv", "wav", "mf4"):
        assert main(["export", log, "--to", str(tmp_path / f"b.{ending}")]) == 0
    assert str(np.load(tmp_path / "b.npz")["started"]) == STARTED_UTC
    assert scipy.io.loadmat(tmp_path / "b.mat")["started"].item() == STARTED_UTC
    assert (tmp_path / "b.csv").read_text().splitlines()[-1] == f"# started {STARTED_UTC}"
    assert STARTED_UTC.encode() in (tmp_path / "b.wav").read_bytes()
    with MDF(tmp_path / "b.mf4") as file:
        assert file.header.start_time.timestamp() == START_NS / 1e9


def test_an_unknown_date_is_in_none(tmp_path: Path) -> None:
    log = write(tmp_path, first_ns=0, names=("b1x",))
    for ending in ("npz", "csv", "mf4"):
        assert main(["export", log, "--to", str(tmp_path / f"b.{ending}")]) == 0
    assert "started" not in np.load(tmp_path / "b.npz").files
    assert "started" not in (tmp_path / "b.csv").read_text()
    with MDF(tmp_path / "b.mf4") as file:
        assert file.header.start_time.timestamp() == 0.0


def test_a_log_without_its_rig_file_says_its_units(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for rig in ("", "schema = ]"):
        assert main(["export", write(tmp_path, rig=rig, names=("time",)), "--to", str(tmp_path / "b.npz")]) == 0
        assert "no intact rig file (rig.toml), so values are in SI units: time in m/s^2" in capsys.readouterr().err
        assert list(np.load(tmp_path / "b.npz")["units"]) == ["m/s^2"]
    assert main(["export", write(tmp_path, names=("time",)), "--to", str(tmp_path / "b.npz")]) == 0
    assert list(np.load(tmp_path / "b.npz")["units"]) == ["g"]


@pytest.mark.promise("a link at a temporary name", "beside the export", "not followed")
@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_no_link_beside_it_leads_an_export_elsewhere(tmp_path: Path, ending: str) -> None:
    log, precious = write(tmp_path), tmp_path / "precious.txt"
    precious.write_text("precious")
    for name in (f".b.{ending}.part.{ending}", f".b.{ending}.part", f".b.{ending}"):
        (tmp_path / name).symlink_to(precious)
    (tmp_path / ".c.mcap.part").symlink_to(precious)
    assert main(["export", log, "--to", str(tmp_path / f"b.{ending}")]) == 0
    assert main(["recover", log, "--out", str(tmp_path / "c.mcap")]) == 0
    assert precious.read_text() == "precious"
    assert (tmp_path / "c.mcap").stat().st_mode & 0o777 == 0o644
