"""A log as the estimator's array: the rig's channels in its order, and nothing doubtful without a word."""

from pathlib import Path

import numpy as np
import pytest

from daq.base.contract.errors import LogError
from daq.base.contract.sink import Session
from daq.exchange.measurement import measure
from daq.log.writer import LogWriter
from daq.rig.rig import Rig
from drivers.contract.reading import Block, Gap, Info, Signal

RATE = 5120.0
RIG = """schema = 1
[band]
low = 100.0
high = 2000.0
[acquisition]
rate_hz = {rate}
[[channel]]
name = "b"
node = "bearing1"
direction = "y"
unit = "g"
[[channel]]
name = "a"
node = "bearing1"
direction = "x"
unit = "m/s^2"
"""
SCALE = 0.01


def write(path: Path, counts: np.ndarray, names: tuple[str, ...] = ("a", "b", "c"), gap: int = 0) -> Path:
    info = Info(tuple(Signal(n, "m/s^2", SCALE) for n in names), RATE)
    writer = LogWriter(path, live=False)
    writer.start(Session(model=rig().model, info=info, device="", attachments={}, metadata={}))
    half = len(counts) // 2
    writer.readings([Block(0, counts[:half], 0), Gap(half, gap, "crc")] if gap else [Block(0, counts[:half], 0)])
    writer.readings([Block(half + gap, counts[half:], 1_000_000)])
    writer.close()
    return path


def rig(rate: float = RATE) -> Rig:
    return Rig.parse(RIG.format(rate=rate))


def counts(n: int = 1000, columns: int = 3) -> np.ndarray:
    return np.random.default_rng(0).integers(-3000, 3000, (n, columns)).astype(np.int32)


def test_the_rigs_channels_in_its_order_in_si(tmp_path: Path) -> None:
    said: list[str] = []
    data = measure(write(tmp_path / "a.mcap", counts()), rig(), said.append)
    np.testing.assert_allclose(data.y, counts()[:, [1, 0]] * SCALE)
    assert data.rate_hz == RATE
    assert data.started is not None, "a log that was no import knows when it began"
    assert said == []


def test_gaps_and_clipped_samples_are_nan_and_said(tmp_path: Path) -> None:
    c = counts()
    c[100, 0], c[200, 1], c[300, 2] = 32767, -32767, 32767  # the third channel is not the rig's
    said: list[str] = []
    data = measure(write(tmp_path / "a.mcap", c, gap=50), rig(), said.append)
    assert np.isnan(data.y[500:550]).all()
    assert np.isnan(data.y[100, 1])
    assert np.isnan(data.y[200, 0])
    assert int(np.isnan(data.y).sum()) == 102
    assert "50 samples are missing in 1 gaps" in said[0]
    assert "2 samples of b, a are at full scale" in said[1]


def test_another_rate_is_said_and_a_missing_channel_refused(tmp_path: Path) -> None:
    log = write(tmp_path / "a.mcap", counts())
    said: list[str] = []
    measure(log, rig(6000.0), said.append)
    assert "the log's rate is used" in said[0]
    with pytest.raises(LogError, match='no channel "b" of the rig; it has A'):
        measure(write(tmp_path / "b.mcap", counts(columns=2), ("a", "A")), rig(), said.append)


def test_a_band_beyond_half_the_rate_is_refused(tmp_path: Path) -> None:
    high = Rig.parse(RIG.format(rate=RATE).replace("2000.0", "2559.0").replace(f"rate_hz = {RATE}", "rate_hz = 9000.0"))
    measure(write(tmp_path / "a.mcap", counts()), high, lambda text: None)
    higher = Rig.parse(high.text.replace("2559.0", "2560.0"))
    with pytest.raises(LogError, match="not below 2560 Hz, half"):
        measure(tmp_path / "a.mcap", higher, lambda text: None)


def test_a_file_that_can_be_imported_serves_as_well(tmp_path: Path) -> None:
    y = np.random.default_rng(0).standard_normal((500, 2))
    np.savez(tmp_path / "a.npz", a=y[:, 0], b=y[:, 1], rate_hz=RATE)
    data = measure(tmp_path / "a.npz", rig(), lambda text: None)
    np.testing.assert_allclose(data.y, y[:, ::-1] * [9.80665, 1.0])
