"""Several files as one log: in the order of their dates, and a gap wherever samples are missing between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.commands.cli.app import main
from daq.log.reader import read_log

JOINED_RIG_TOML = """schema = 1
[band]
low = 10.0
high = 400.0
[[channel]]
name = "x"
node = "bearing1"
direction = "x"
unit = "m/s^2"
"""
Y = np.random.default_rng(0).standard_normal(900)


def write(folder: Path, name: str, rows: slice, started: str | None, rate: float = 1000.0, unit: str = "m/s^2") -> str:
    about = {} if started is None else {"started": started}
    values = Y[rows] / (9.80665 if unit == "g" else 1.0)
    np.savez(folder / name, x=values, rate_hz=rate, channels=["x"], units=[unit], **about)
    return str(folder / name)


def load(folder: Path, *files: str) -> int:
    (folder / "rig.toml").write_text(JOINED_RIG_TOML)
    return main(["import", *files, "--rig", str(folder / "rig.toml"), "--out", str(folder / "a.mcap")])


def test_by_their_dates_with_gaps_and_in_any_unit(tmp_path: Path) -> None:
    late = write(tmp_path, "late.npz", slice(500, 900), "2024-05-31T11:05:00.700Z", unit="g")
    early = write(tmp_path, "early.npz", slice(0, 300), "2024-05-31T11:05:00.000Z")
    next_ = write(tmp_path, "next.npz", slice(300, 500), "2024-05-31T11:05:00.300Z")
    assert load(tmp_path, late, early, next_) == 0
    log = read_log(tmp_path / "a.mcap")
    assert [(g.index, g.count) for g in log.gaps] == [(500, 200)]
    np.testing.assert_allclose(log.samples()[:, 0], np.r_[Y[:500], np.full(200, np.nan), Y[500:]], atol=1e-7)
    assert log.started is not None
    assert log.started.isoformat() == "2024-05-31T11:05:00+00:00"


def test_without_dates_the_gap_is_said_to_be_of_unknown_length(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [write(tmp_path, f"{k}.npz", slice(300 * k, 300 * k + 300), None) for k in (1, 0)]
    assert load(tmp_path, *files) == 0
    assert "how long the gaps are is not known" in capsys.readouterr().err
    np.testing.assert_allclose(
        read_log(tmp_path / "a.mcap").samples()[:, 0], np.r_[Y[300:600], np.nan, Y[:300]], atol=1e-7
    )


def test_what_cannot_be_one_record_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = write(tmp_path, "a.npz", slice(0, 300), "2024-05-31T11:05:00.000Z")
    assert load(tmp_path, first, write(tmp_path, "b.npz", slice(0, 300), None, rate=2000.0)) == 4
    assert "b.npz: 2000 Hz, and" in capsys.readouterr().err
    assert load(tmp_path, first, write(tmp_path, "c.npz", slice(0, 300), "2024-05-31T11:05:00.200Z")) == 4
    assert "begins 100 samples before" in capsys.readouterr().err
    (tmp_path / "d.log").write_text("")
    assert load(tmp_path, first, str(tmp_path / "d.log")) == 4
    assert "one file at a time" in capsys.readouterr().err
