"""What a session says of its channels while it runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.sink import Session
from daq.rig.rig import Rig
from daq.session.record_watch import RecordWatch
from drivers.contract.reading import Block, Info, Signal

RATE_HZ = 1000.0
DEMO_RIG = Rig.parse(Path(__file__).parents[3].joinpath("daq", "commands", "demo_rig.toml").read_text("utf-8"))
INFO = Info(tuple(Signal(c.name, "m/s^2", 1e-2, 0.0) for c in DEMO_RIG.model.channels), RATE_HZ)


def said(counts: NDArray[np.int16], live: bool = False) -> list[str]:
    sink = RecordWatch(DEMO_RIG.model, live)
    sink.start(Session(model=DEMO_RIG.model, info=INFO, device="", attachments={}, metadata={}))
    out = []
    for first in range(0, len(counts), 100):
        sink.readings([Block(first, counts[first : first + 100], 0)])
        out += [n.text for n in sink.health().notices]
    pending = True
    while pending:
        health = sink.health()
        out += [n.text for n in health.notices]
        pending = health.pending
    return out


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
