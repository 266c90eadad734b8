"""The machine layer on made-up records: speed, tones and what they are, on long records and on many short ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimator.arrays import Array
from estimator.identification.machine import MachineSurvey, survey_machine
from estimator.model import Channel, Model

RATE_HZ = 5120.0


def rig(speed_rpm: float | None = 1500.0, channels: int = 1) -> Model:
    own = tuple(Channel(name, "bearing1", name) for name in ("x", "y")[:channels])
    return Model(channels=own, band=(500.0, 2000.0), speed_rpm=speed_rpm)


def coloured_noise(rows: int, seed: int = 1) -> Array:
    """Noise through a resonance of 1 % damping at 800 Hz, standard deviation 1."""
    w = 2 * np.pi * 800.0 / RATE_HZ
    noise = lfilter([1.0], [1.0, -2 * np.exp(-0.01 * w) * np.cos(w), np.exp(-0.02 * w)], white(rows, seed))
    return np.asarray(noise / noise.std() + 0.3 * white(rows, seed + 1000))


def white(rows: int, seed: int) -> Array:
    return np.random.default_rng(seed).standard_normal(rows)


def tone(hz: float, amplitude: float, rows: int) -> Array:
    return np.asarray(amplitude * np.cos(2 * np.pi * hz / RATE_HZ * np.arange(rows) + hz))


def survey_of(x: Array, speed_rpm: float | None = 1500.0) -> MachineSurvey:
    columns = x[:, None] if x.ndim == 1 else x
    return survey_machine(rig(speed_rpm, columns.shape[1]), columns, RATE_HZ)


def test_speed_and_orders_come_from_the_record() -> None:
    n = int(10 * RATE_HZ)
    x = coloured_noise(n) + tone(24.7, 0.2, n) + tone(49.4, 0.1, n) + tone(60.0, 0.1, n) + tone(1222.2, 0.1, n)
    s = survey_of(x)
    assert s.speed is not None
    assert s.speed.source == "record"
    assert s.speed.value_rpm == pytest.approx(60 * 24.7, abs=4 * s.speed.sd_rpm)
    named = {(t.kind, round(t.frequency_hz)): t for t in s.tones}
    assert set(named) == {("order", 25), ("order", 49), ("mains", 60), ("other", 1222)}
    first = named["order", 25]
    assert first.order == 1.0
    assert first.unit == "m/s^2"
    assert first.amplitude["x"] == pytest.approx(0.2, rel=0.1)
    assert all(t.p_value < 1e-3 for t in s.tones)


def test_a_wandering_line_is_one_tone() -> None:
    n = int(20 * RATE_HZ)
    hz = 150.0 * (1 + 0.003 * np.sin(2 * np.pi * 0.2 * np.arange(n) / RATE_HZ))
    s = survey_of(coloured_noise(n) + 0.3 * np.cos(2 * np.pi * np.cumsum(hz) / RATE_HZ), None)
    assert [round(t.frequency_hz) for t in s.tones] == [150]
    assert s.tones[0].amplitude["x"] == pytest.approx(0.3, rel=0.15)


def test_a_resonance_is_no_tone() -> None:
    s = survey_of(coloured_noise(int(10 * RATE_HZ)))
    assert s.tones == ()
    assert s.speed is not None
    assert s.speed.source == "rig file"


def test_false_tones_are_rare() -> None:
    surveys = [survey_of(coloured_noise(int(4 * RATE_HZ), seed), None) for seed in range(20)]
    assert sum(bool(s.tones) for s in surveys) <= 1


def test_short_pieces_with_gaps_between_are_averaged() -> None:
    n = int(0.2 * RATE_HZ)
    pieces = [coloured_noise(n, seed) + tone(200.0, 0.4, n) for seed in range(20)]
    gap = np.full(50, np.nan)
    s = survey_of(np.concatenate([np.concatenate([p, gap]) for p in pieces]), None)
    assert [round(t.frequency_hz) for t in s.tones] == [200]


def test_a_speed_that_the_record_contradicts_is_said() -> None:
    n = int(10 * RATE_HZ)
    x = coloured_noise(n) + sum(tone(k * 29.8, 0.2, n) for k in (1, 2, 3, 4))
    for given in (29.0, 22.0):  # beside the speed, and quite another speed
        codes = [m.code for m in survey_of(x, 60 * given).messages]
        assert "speed_contradicted" in codes
        assert ("rate_unconfirmed" in codes) is (given == 29.0), "a rate that is wrong by 3 % looks the same"
    beside_mains = survey_of(x + tone(50.0, 0.2, n), 60 * 29.0)
    assert [m.code for m in beside_mains.messages] == ["speed_contradicted"], "the mains stand where they belong"
    assert "speed_suggested" in [m.code for m in survey_of(x, None).messages]


def test_a_comb_at_the_end_of_what_a_nameplate_allows_is_no_speed() -> None:
    """What is likeliest at an end of the range that is searched may be the flank of something beyond."""
    n = int(10 * RATE_HZ)
    for ratio, source in ((0.96, "record"), (0.9502, "rig file")):
        x = coloured_noise(n) + tone(ratio * 30.0, 0.2, n) + tone(2.0 * ratio * 30.0, 0.2, n)
        speed = survey_of(x, 60 * 30.0).speed
        assert speed is not None
        assert speed.source == source


def test_a_wrong_rate_is_distinguished_from_a_wrong_speed_by_the_mains() -> None:
    n = int(10 * RATE_HZ)
    x = coloured_noise(n) + sum(tone(0.976 * hz, 0.2, n) for hz in (25.0, 50.0, 60.0, 120.0))
    (said,) = [m for m in survey_of(x).messages if m.code.endswith("contradicted")]
    assert said.code == "rate_contradicted"
    assert "1.0246 x" in said.text


def test_one_tone_of_two_channels_is_one_entry() -> None:
    n = int(10 * RATE_HZ)
    y = np.column_stack([coloured_noise(n, 1) + tone(25.0, 0.3, n), coloured_noise(n, 2) + tone(25.0, 0.1, n)])
    (only,) = survey_of(y).tones
    assert set(only.amplitude) == {"x", "y"}
    assert set(only.to_json()) == {"kind", "order", "frequency_hz", "amplitude", "unit", "p_value"}


def test_a_dead_or_empty_channel_is_no_error() -> None:
    n = int(2 * RATE_HZ)
    assert survey_of(np.zeros(n)).tones == ()
    assert [m.code for m in survey_of(np.full(n, np.nan)).messages][0] == "no_gap_free_piece"
