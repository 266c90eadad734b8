"""What a session says of its channels and of the machine while it runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.sink import Session
from daq.rig.rig import Rig
from daq.session.layer_watch import LAYERS_SEEN, RECORD_FINDING, STRIKES_FOUND, TONES_FOUND, LayerWatch
from drivers.contract.reading import Block, Info, Notice, Signal

RATE_HZ = 1000.0
DEMO_RIG = Rig.parse(Path(__file__).parents[3].joinpath("daq", "commands", "demo_rig.toml").read_text("utf-8"))
INFO = Info(tuple(Signal(c.name, "m/s^2", 1e-2, 0.0) for c in DEMO_RIG.model.channels), RATE_HZ)


def notices(counts: NDArray[np.int16], live: bool = False, rig: Rig = DEMO_RIG, info: Info = INFO) -> list[Notice]:
    sink = LayerWatch(rig.model, live, rig.si_units)
    sink.start(Session(model=rig.model, info=info, device="", attachments={}, metadata={}))
    out = []
    for first in range(0, len(counts), 100):
        sink.readings([Block(first, counts[first : first + 100], 0)])
        out += sink.health().notices
    pending = True
    while pending:
        health = sink.health()
        out += health.notices
        pending = health.pending
    return out


def said(counts: NDArray[np.int16], live: bool = False) -> list[str]:
    return [n.text for n in notices(counts, live) if n.code == RECORD_FINDING]


def record(seconds: float = 40.0) -> NDArray[np.int16]:
    rng = np.random.default_rng(0)
    return (100 * rng.standard_normal((int(seconds * RATE_HZ), len(DEMO_RIG.model.channels)))).astype(np.int16)


def test_good_channels_are_not_spoken_of() -> None:
    assert said(record()) == []


def test_a_spike_and_a_frozen_sensor_are_said_once_with_their_time() -> None:
    counts = record()
    counts[12_345, 0] = 30_000
    counts[20_000:, 1] = 7
    spike, frozen = said(counts)
    assert "b1x has a spike of 300 m/s^2 at 2.3450 s" in spike
    assert "times from 10 s on" in spike
    assert "b1y is constant at 0.07 m/s^2" in frozen


def test_live_it_speaks_from_a_thread() -> None:
    counts = record(20.0)
    counts[:, 2] = counts[:, 3]
    (copied,) = said(counts, live=True)
    assert "carry the same signal" in copied


BEARING_RIG = Rig.parse("""schema = 1
[rig]
name = "one cap"
shaft = "none"
speed_rpm = 1758.0
[rig.bearing]
balls = 9
ball_diameter_mm = 7.94
pitch_diameter_mm = 39.04
[band]
low = 300.0
high = 2300.0
[[channel]]
name = "a"
node = "bearing1"
direction = "x"
kind = "acceleration"
unit = "m/s^2"
""")


def strikes_from(second: float, seconds: float, rate_hz: float) -> NDArray[np.int16]:
    """Noise with a weak 1X, and from some second on strikes of the outer ring (3.585 a turn) that ring at 1.6 kHz."""
    rng, t = np.random.default_rng(1), np.arange(int(seconds * rate_hz)) / rate_hz
    y = rng.standard_normal(t.size) + 0.3 * np.cos(2 * np.pi * 29.3 * t)
    after = np.arange(int(0.02 * rate_hz)) / rate_hz
    ring = 6.0 * np.exp(-300.0 * after) * np.sin(2 * np.pi * 1600.0 * after)
    for at in np.arange(second, seconds - 0.05, 1.0 / (3.585 * 29.3)):
        row = int(at * rate_hz)
        y[row : row + ring.size] += ring
    return (100 * y).astype(np.int16)[:, None]


def test_a_strike_train_is_flagged_within_20_s_of_its_beginning_and_once() -> None:
    rate_hz, begins = 5120.0, 13.0
    info = Info((Signal("a", "m/s^2", 1e-2, 0.0),), rate_hz)
    found = notices(strikes_from(begins, 30.0, rate_hz), rig=BEARING_RIG, info=info)
    (flagged,) = (n for n in found if n.code == STRIKES_FOUND)
    assert flagged.level == "warning"
    assert flagged.text.startswith("BPFO strikes: order 3.58")
    assert flagged.text.endswith("seen from 10 to 20 s"), "at 20 s, 7 s after its beginning"
    tones, *_ = (n for n in found if n.code == TONES_FOUND)
    assert "1X" in tones.text
    first, *_, last = (n.text.splitlines() for n in found if n.code == LAYERS_SEEN)
    assert first[0] == "layers from 0 to 10 s"
    assert any(line.startswith("structure: ") for line in first)
    assert any("no strike train" in line for line in first)
    assert any("BPFO" in line for line in last)
