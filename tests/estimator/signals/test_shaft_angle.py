"""Shaft angle from pulses, against the closed form of the simulator's speed."""

import numpy as np
import pytest

from estimator.errors import DataError
from estimator.model.rig import Channel, Model
from estimator.signals.shaft_angle import measured_phase, rising_edges, shaft_angle
from estimator.simulation.shaft_speed import ShaftSpeed

RATE = 25600.0
T = np.arange(int(10 * RATE)) / RATE


@pytest.mark.parametrize(
    "speed",
    [
        ShaftSpeed(2100.0),
        ShaftSpeed(600.0, ramp_rpm_per_s=150.0),
        ShaftSpeed(2950.0, fluctuation=0.03, fluctuation_hz=2.0),
    ],
    ids=repr,
)
def test_the_angle_is_that_of_the_shaft(speed: ShaftSpeed) -> None:
    found = shaft_angle(5.0 * speed.pulses(T, 1 / RATE) - 1.0, RATE)
    error = found - speed.phase(T)  # of no turn either: the phase of an order such as 5.09 hangs on it
    inside = slice(int(0.2 * RATE), int(9.8 * RATE))
    assert np.abs(error[inside]).max() < 0.002  # rad; the speed changes within a turn


def test_pulses_that_come_unevenly_turn_nothing_back() -> None:
    pulses = np.zeros(4000)
    for row in (100, 400, 700, 980, 1000, 1600, 1900, 2200, 2500, 3700):  # 980: interference
        pulses[row : row + 5] = 1.0
    assert np.all(np.diff(shaft_angle(pulses, RATE)) > 0.0)


def test_missing_samples_cost_no_turn() -> None:
    speed = ShaftSpeed(1800.0)
    pulses = speed.pulses(T, 1 / RATE)
    pulses[int(3 * RATE) : int(3.4 * RATE)] = np.nan  # 12 turns
    error = shaft_angle(pulses, RATE) - speed.phase(T)
    error -= 2 * np.pi * np.round(np.median(error) / (2 * np.pi))
    assert np.abs(error[int(0.2 * RATE) : int(9.8 * RATE)]).max() < 0.02


def test_noise_and_ringing_make_no_pulses() -> None:
    rng = np.random.default_rng(0)
    pulses = ShaftSpeed(1800.0).pulses(T, 1 / RATE)
    noisy = pulses + 0.02 * rng.standard_normal(T.size)
    assert abs(len(rising_edges(noisy)) - 300) <= 1


@pytest.mark.parametrize("pulses", [np.zeros(1000), np.full(1000, np.nan), np.arange(1000.0)])
def test_without_pulses_it_says_so(pulses: np.ndarray) -> None:
    with pytest.raises(DataError, match="tacho pulses"):
        shaft_angle(pulses, RATE)


def test_a_rig_without_tacho_has_no_measured_phase() -> None:
    model = Model((Channel("a", "bearing1", "x"),), (1.0, 2.0))
    assert measured_phase(model, np.zeros((10, 1)), RATE) is None
