"""Strike trains in made-up records of a 6205 bearing: names, slip, sidebands, and what is no strike train."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import fftconvolve

from estimator.arrays import Array
from estimator.identification.machine import MachineSurvey, survey_machine
from estimator.model import BearingGeometry, Channel, Model

RATE_HZ, SECONDS, SHAFT_HZ = 10240.0, 4.0, 29.3
BEARING = BearingGeometry(balls=9, ball_diameter=7.94e-3, pitch_diameter=39.04e-3, groove_radius=4.13e-3)
BPFO, BPFI, BSF, FTF = 3.5848, 5.4152, 2.3567, 0.3983
MODEL = Model(channels=(Channel("y", "bearing1", "y"),), band=(500.0, 4000.0), speed_rpm=60 * SHAFT_HZ, bearing=BEARING)


def noise(seed: int) -> Array:
    """Noise of a housing with two modes, standard deviation 1, beside a weak 1X that shows the speed."""
    rows = int(RATE_HZ * SECONDS)
    white = np.random.default_rng(seed).standard_normal((3, rows))
    modes = sum(fftconvolve(w, ring(hz))[:rows] for w, hz in zip(white, (900.0, 3100.0), strict=False))
    t = np.arange(rows) / RATE_HZ
    return np.asarray(modes / np.std(modes) + 0.3 * white[2] + 0.2 * np.cos(2 * np.pi * SHAFT_HZ * t))


def ring(hz: float, damping: float = 0.03, after: Array | None = None) -> Array:
    """Response of a mode to a strike. after : s since the strike."""
    t = np.arange(int(0.03 * RATE_HZ)) / RATE_HZ if after is None else after
    return np.asarray(np.exp(-damping * 2 * np.pi * hz * t) * np.sin(2 * np.pi * hz * t))


def strikes(order: float, size: float, seed: int, jitter: float = 0.01, load_order: float = 0.0) -> Array:
    """Strikes that ring a mode; jitter : of a period, accumulating; load_order : of the load that a defect passes."""
    rows = int(RATE_HZ * SECONDS)
    random = np.random.default_rng(seed)
    period = RATE_HZ / (order * SHAFT_HZ)
    at = np.cumsum(period * (1 + jitter * random.standard_normal(int(rows / period) + 20)))
    at = at[at < rows - 1]
    load = 0.5 * (1 + np.cos(2 * np.pi * load_order * SHAFT_HZ * at / RATE_HZ)) if load_order else np.ones(at.size)
    height = size * load * (1 + 0.2 * random.standard_normal(at.size))
    row = np.ceil(at).astype(int)[:, None] + np.arange(int(0.03 * RATE_HZ))
    out = np.zeros(rows + row.shape[1])
    np.add.at(out, row, height[:, None] * ring(3100.0, after=(row - at[:, None]) / RATE_HZ))
    return out[:rows]


def white(seed: int) -> Array:
    return np.random.default_rng(seed).standard_normal(int(4 * SECONDS) + 2)


def survey_of(x: Array) -> MachineSurvey:
    return survey_machine(MODEL, x[:, None], RATE_HZ)


@pytest.mark.parametrize("jitter", [0.0, 0.02])
@pytest.mark.parametrize(
    ("name", "order", "load_order"), [("BPFO", BPFO, 0.0), ("BPFI", BPFI, 1.0), ("BSF", 2 * BSF, FTF)]
)
def test_a_defect_is_named(name: str, order: float, load_order: float, jitter: float) -> None:
    slipped = order * (1 - 0.008)
    (train,) = survey_of(noise(3) + strikes(slipped, 4.0, 4, jitter, load_order)).strikes
    assert train.name == name
    assert train.order is not None
    assert train.order / slipped == pytest.approx(1.0, abs=0.006)
    assert train.slip_percent == pytest.approx(-0.8, abs=0.6)
    assert train.p_value < 1e-3
    assert train.severity > 0.1
    assert train.channel == "y"


def test_a_train_whose_first_harmonic_a_shaft_order_hides_has_no_other_name() -> None:
    """BPFO is three turns of the shaft, and twice BPFO is BPFI."""
    bearing = BearingGeometry(balls=9, ball_diameter=10e-3, pitch_diameter=30e-3, groove_radius=5.2e-3)
    x = noise(3) + strikes(2.97, 4.0, 4, 0.02)
    (train,) = survey_machine(replace(MODEL, bearing=bearing), x[:, None], RATE_HZ).strikes
    assert train.name == "BPFO"
    assert train.order == pytest.approx(2.95, abs=0.03)


def test_a_train_at_no_order_of_the_bearing_is_other() -> None:
    (train,) = survey_of(noise(3) + strikes(6.37, 5.0, 4, 0.003)).strikes
    assert (train.name, train.slip_percent) == ("other", None)
    assert train.order == pytest.approx(6.37, abs=0.02)


def test_strikes_once_a_turn_are_no_defect() -> None:
    assert survey_of(noise(3) + strikes(1.0, 5.0, 4, 0.002)).strikes == ()
    assert survey_of(noise(3) + strikes(3.0, 5.0, 4, 0.002)).strikes == ()


def test_a_smooth_modulation_is_no_strike_train() -> None:
    t = np.arange(int(RATE_HZ * SECONDS)) / RATE_HZ
    s = survey_of(noise(3) * (1 + 0.5 * np.cos(2 * np.pi * BPFO * SHAFT_HZ * t)))
    assert s.strikes == ()


def test_noise_has_no_strikes() -> None:
    assert not any(survey_of(noise(seed)).strikes for seed in range(20, 26))


def test_a_level_that_changes_is_no_strike_train() -> None:
    t = np.arange(int(RATE_HZ * SECONDS)) / RATE_HZ
    lines = sum(np.cos(2 * np.pi * k * BPFO * SHAFT_HZ * t + k) * noise(k + 40) for k in range(9, 14))
    for seed in range(3):
        level = np.exp(0.5 * np.interp(t, np.arange(0.0, SECONDS + 0.5, 0.25), white(seed)))
        assert survey_of(level * (noise(seed) + 0.1 * lines)).strikes == ()


def test_short_pieces_are_enough() -> None:
    x = noise(3) + strikes(BPFO, 6.0, 4)
    rows = int(0.5 * RATE_HZ)
    x[::rows] = np.nan
    for gap in range(1, 12):
        x[gap::rows] = np.nan
    (train,) = survey_of(x).strikes
    assert train.name == "BPFO"


def test_a_defect_is_found_in_a_live_block() -> None:
    (train,) = survey_machine(MODEL, (noise(3) + strikes(BPFO, 4.0, 4))[:, None], RATE_HZ, live=True).strikes
    assert train.name == "BPFO"
    assert survey_machine(MODEL, noise(3)[:, None], RATE_HZ, live=True).strikes == ()


def test_a_tacho_follows_a_speed_that_wanders() -> None:
    rows = int(RATE_HZ * SECONDS)
    t = np.arange(rows) / RATE_HZ
    turns = SHAFT_HZ * (t + 0.03 * np.sin(2 * np.pi * 0.25 * t))
    even = noise(3) + strikes(BPFO, 2.0, 4, 0.0)
    x = np.interp(turns / SHAFT_HZ, t, even)
    tacho = (turns % 1.0 < 0.1).astype(float)
    model = Model(
        channels=(*MODEL.channels, Channel("n", "shaft", "", "tacho")), band=MODEL.band, bearing=BEARING
    )  # fmt: skip
    s = survey_machine(model, np.column_stack([x, tacho]), RATE_HZ)
    assert s.speed is not None
    assert s.speed.source == "tacho"
    assert s.speed.value_rpm == pytest.approx(60 * SHAFT_HZ, rel=1e-2)
    (train,) = s.strikes
    assert train.name == "BPFO"
    assert train.order == pytest.approx(BPFO, rel=3e-3)


def test_without_a_speed_a_train_has_a_frequency_and_no_name() -> None:
    rig = Model(channels=MODEL.channels, band=MODEL.band, bearing=BEARING)
    quiet = survey_machine(rig, noise(1)[:, None], RATE_HZ)
    assert quiet.strikes == ()
    assert [m.code for m in quiet.messages] == ["no_speed_no_strikes"]
    s = survey_machine(rig, (noise(3) + strikes(BPFO, 4.0, 4))[:, None], RATE_HZ)
    (train,) = s.strikes
    assert (train.name, train.order) == ("other", None)
    assert train.frequency_hz == pytest.approx(BPFO * SHAFT_HZ, rel=3e-3)
    assert [m.code for m in s.messages if m.code.startswith(("speed", "strikes"))] == ["strikes_without_speed"]
