"""The view with devices of every kind: it draws what it can and never fails."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from recordings import entities

from daq.base.contract.sink import Status
from daq.report.rerun.view import RerunView, ViewSession
from drivers.contract.reading import Block, Gap, Info, LinkStats, Notice, Signal
from estimator.results import Estimate, Parameter

UNITS = ("m/s^2", "m/s", "rad/s", "A")


def draw(path: Path, info: Info, items: list[object]) -> dict[str, int]:
    places = {s.name: (f"bearing1.{'xy'[k % 2]}", "acceleration") for k, s in enumerate(info.signals)}
    recording = rr.RecordingStream("test")
    recording.save(path)
    view = RerunView(
        recording, ViewSession(name="test", recording_id="id", info=info, places=places, band=(1.0, 1e4), wall_ns=0)
    )
    for item in items:
        view.take(item)  # type: ignore[arg-type]
    view.close()
    recording.disconnect()
    return entities(path)


def blocks(channels: int, rate: float, seconds: float, start: int = 0) -> list[object]:
    rng = np.random.default_rng(1)
    n = int(rate * seconds)
    counts = rng.integers(-3000, 3000, (n, channels)).astype(np.int32)
    return [Block(start + i, counts[i : i + 100], i) for i in range(0, n, 100)]


@pytest.mark.parametrize(("channels", "rate"), [(0, 100.0), (1, 5.0), (1, 200.0), (3, 1000.0), (9, 51200.0)])
def test_devices_of_every_kind(tmp_path: Path, channels: int, rate: float) -> None:
    info = Info(tuple(Signal(f"c {k}", UNITS[k % 4], 0.01) for k in range(channels)), rate)
    items = [
        *blocks(channels, rate, 3.0),
        Status(t_host_ns=0, index=int(3 * rate), rate_hz=rate, link=LinkStats(), clock=None),
    ]
    rows = draw(tmp_path / "a.rrd", info, items)
    for k in range(channels):
        expected = 3 * rate if rate <= 500 else 1400
        assert rows[rf"waveform/{k % 4 if channels > 4 else k}/c\ {k}"] >= expected


def test_a_device_that_changes(tmp_path: Path) -> None:
    """Another rate, other channels, a block that does not fit, a gap of years, the same sample again."""
    first = Info((Signal("a", "m/s^2", 0.01),), 1000.0)
    second = Info((Signal("a", "m/s^2", 0.01), Signal("b", "m/s", 0.01)), 8000.0)
    items: list[object] = [*blocks(1, 1000.0, 2.0), second, *blocks(2, 8000.0, 2.0, 2000)]
    items += [*blocks(3, 8000.0, 0.1, 18000), Gap(18000, 10**14, "silent"), *blocks(2, 8000.0, 2.0, 18000 + 10**14)]
    items += [Gap(5, 0, "duplicate"), *blocks(2, 8000.0, 0.5, 100), Notice(1, "odd", "code", "text"), first]
    items += [Notice(2, "info", "layers", "layers from 0 to 10 s\nrecord: b1x rms 1\n  b1y rms 2")]
    rows = draw(tmp_path / "a.rrd", first, items)
    assert rows["waveform/1/b"] > 900
    assert rows["log"] >= 5
    assert rows["layers"] == 1


def test_what_the_data_cannot_tell_is_a_hole(tmp_path: Path) -> None:
    info = Info((Signal("a", "m/s^2", 0.01),), 1000.0)
    items: list[object] = []
    for k, value in enumerate((None, 1e7, None, 1.1e7)):
        p = Parameter(value, None if value is None else 1e5, "N/m", value is not None)
        items.append(Estimate(100 * k, {"bearing1.x.kL": p, "odd": p}, 1.0, status="ok" if value else "no data"))
    rows = draw(tmp_path / "a.rrd", info, items)
    assert rows["estimate/kL/bearing1.x"] == 3, "drawn from the first value on"
    assert rows["estimate/odd/odd"] == 3
    assert rows["state/estimator"] == 5, "its style, and each change"
