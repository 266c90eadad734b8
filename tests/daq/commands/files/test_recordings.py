"""Exports for viewers: each sample in SI with its time and unit, read back by the libraries of those formats."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from daq.base.console.extras import missing_library, required
from daq.base.contract.errors import ConfigError
from daq.commands.cli.app import main
from daq.log.reader import read_log

RATE_HZ = 2000.0
STARTED_UTC = "2024-05-31T11:05:00Z"
RIG_TOML = """schema = 1
[band]
low = 10.0
high = 800.0
[[channel]]
name = "b1x"
node = "bearing1"
direction = "x"
unit = "g"
[[channel]]
name = "b1y"
node = "bearing1"
direction = "y"
unit = "m/s^2"
"""


@pytest.fixture
def log(tmp_path: Path) -> Path:
    y = np.random.default_rng(0).standard_normal((3000, 2))
    y[1000:1100] = np.nan
    (tmp_path / "rig.toml").write_text(RIG_TOML)
    np.savez(tmp_path / "a.npz", b1x=y[:, 0], b1y=y[:, 1], rate_hz=RATE_HZ, started=STARTED_UTC)
    out = tmp_path / "log.mcap"
    assert (
        main(["import", str(tmp_path / "a.npz"), "--rig", str(tmp_path / "rig.toml"), "--out", str(out), "--gaps"]) == 0
    )
    return out


def test_mcap_has_a_topic_for_each_channel_and_a_message_for_each_sample(log: Path) -> None:
    from mcap_protobuf.decoder import DecoderFactory

    out = log.with_name("samples.mcap")
    assert main(["export", str(log), "--to", str(out)]) == 0
    y = read_log(log).samples()
    with out.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found: dict[str, list[tuple[int, float]]] = {}
        for _, channel, message, value in reader.iter_decoded_messages():
            assert channel.metadata["unit"] == "m/s^2"
            found.setdefault(channel.topic, []).append((message.log_time, value.value))
    there = np.flatnonzero(np.isfinite(y[:, 0]))
    for k, topic in enumerate(("/b1x", "/b1y")):
        times, values = (np.array(v) for v in zip(*found[topic], strict=True))
        np.testing.assert_array_equal(values, y[there, k])
        np.testing.assert_allclose((times - 1717153500_000000000) * 1e-9, there / RATE_HZ, atol=1e-8)


def test_a_log_is_never_exported_over_a_log(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = log.read_bytes()
    assert main(["export", str(log), "--to", str(log)]) == 2
    assert "choose another name" in capsys.readouterr().err
    assert log.read_bytes() == before


def test_rrd_shows_a_named_panel_for_each_channel_at_the_date(log: Path) -> None:
    import rerun_cli

    out = log.with_name("samples.rrd")
    assert main(["export", str(log), "--to", str(out), "--from", "0.1", "--until", "1.0"]) == 0
    rerun = str(Path(rerun_cli.__file__).parent / "rerun")
    said = subprocess.run([rerun, "rrd", "print", "-vv", str(out)], check=True, capture_output=True, text=True).stdout
    for words in ("/b1x", "/b1y", "Timestamp(ns)"):
        assert words in said, said[:2000]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_universal_file_has_no_holes(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(log), "--to", str(log.with_suffix(".uff"))]) == 4
    assert "export a part without a gap" in capsys.readouterr().err
    assert main(["export", str(log), "--to", str(log.with_suffix(".uff")), "--until", "0.5"]) == 0


@pytest.mark.parametrize("ending", ["uff", "h5", "parquet"])
def test_a_missing_library_is_one_line_with_what_to_type(
    ending: str, log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("pyuff", "h5py", "pyarrow", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["export", str(log), "--to", str(log.with_suffix(f".{ending}")), "--until", "0.5"]) == 2
    err = capsys.readouterr().err
    assert "pip install 'rotorscope[formats]'" in err


def test_a_library_that_is_there_but_broken_is_not_called_missing() -> None:
    with pytest.raises(ConfigError, match=r"rotorscope\[formats\]"):
        required("no_such_library", "formats", ".abc")
    assert (
        missing_library("a.b", "report", "--html")
        == "--html: needs a, which is not installed: pip install 'rotorscope[report]'"
    )
