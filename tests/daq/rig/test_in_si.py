"""Units of devices: a DBC's own, and a device that measures another quantity than the rig file says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stand_ins import MomentEstimator, Recorder, ScriptedDriver, info_of, paper_rig, vibration

from daq.commands.cli.app import main
from daq.log.reader import read_log
from daq.rig.units import STANDARD_GRAVITY
from daq.session.acquire import acquire_from
from drivers.contract.reading import Info, Notice

RIG = """schema = 1
[rig]
shaft = "none"
[band]
low = 10.0
high = 400.0
[acquisition]
rate_hz = 1000.0
[link]
dbc = "of.dbc"
[link.signals]
x = "JN2300.X"
[[channel]]
name = "x"
node = "bearing1"
direction = "x"
kind = "{kind}"
unit = "{unit}"
"""
DBC = """VERSION ""
BO_ 793 JN2300: 6 d
 SG_ X : 0|16@1- (0.001,0) [0|0] "{unit}" d
"""
COUNTS = np.random.default_rng(1).integers(-9000, 9000, 5000)


def imported(folder: Path, dbc_unit: str, kind: str, unit: str) -> Path:
    """A recording of a device of others (ifm JN2300: 1 mg a bit), as a log."""
    (folder / "of.dbc").write_text(DBC.format(unit=dbc_unit))
    (folder / "rig.toml").write_text(RIG.format(kind=kind, unit=unit))
    frames = [f"({k / 1000:.6f}) can0 319#{int(c).to_bytes(2, 'little', signed=True).hex()}00000000\n"
              for k, c in enumerate(COUNTS)]  # fmt: skip
    (folder / "of.log").write_text("".join(frames))
    assert (
        main(["import", str(folder / "of.log"), "--rig", str(folder / "rig.toml"), "--out", str(folder / "a.mcap")])
        == 0
    )
    return folder / "a.mcap"


@pytest.mark.parametrize(
    ("dbc", "unit", "factor"),
    [("g", "g", STANDARD_GRAVITY), ("g", "m/s^2", STANDARD_GRAVITY), ("m/s²", "g", 1.0),
     ("", "mg", 1e-3 * STANDARD_GRAVITY),
     ("mg", "m/s^2", 1e-3 * STANDARD_GRAVITY), ("furlong", "g", STANDARD_GRAVITY)],
)  # fmt: skip
def test_a_unit_of_a_dbc_becomes_si(
    dbc: str, unit: str, factor: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = imported(tmp_path, dbc, "acceleration", unit)
    log = read_log(path)
    assert [s.unit for s in log.info.signals] == ["m/s^2"]
    np.testing.assert_allclose(log.samples()[:, 0], COUNTS * 1e-3 * factor, rtol=1e-12)
    notices = 'x: the DBC says "furlong", which is no unit known here: taken as g' in capsys.readouterr().err
    assert notices is (dbc == "furlong")
    assert main(["export", str(path), "--to", str(tmp_path / "x.npz")]) == 0


def test_another_quantity_than_the_rig_files_gives_no_estimate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It gave one, of stiffness with the frequency's power wrong; the samples are as good as ever."""
    log = read_log(imported(tmp_path, "g", "velocity", "mm/s"))
    assert (
        "error: no rolling estimate: x comes in g, and is velocity in the rig file; correct" in capsys.readouterr().err
    )
    np.testing.assert_allclose(log.samples()[:, 0], COUNTS * 1e-3, rtol=1e-12)
    assert not any(e.estimate.parameters for e in log.estimates)


def test_a_device_that_says_another_quantity_gives_no_estimate() -> None:
    info, sink, notices = info_of(paper_rig()), Recorder(), list[Notice]()
    speeds = Info(tuple(type(s)(s.name, "m/s", s.scale) for s in info.signals), info.rate_hz)
    readings = [[speeds], *([vibration(512 * k, 512)] for k in range(60))]
    driver = ScriptedDriver(readings, "capture")
    summary = acquire_from(paper_rig(), driver, [sink], notify=notices.append, make=MomentEstimator)
    assert [n.code for n in notices] == ["no_estimate"]
    assert "b1x comes in m/s, and is acceleration in the rig file" in summary.problems[0]
    assert (summary.samples, summary.last_estimate) == (60 * 512, None)
