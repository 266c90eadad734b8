"""Modes in simulated records against the truth, and which of them can be the bearing's."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from estimator.arrays import Array
from estimator.identification.machine import survey_machine
from estimator.identification.record import RecordSurvey
from estimator.identification.structure import StructureSurvey, bearing_mode, survey_structure
from estimator.model.rig import Channel, Model

RATE_HZ = 6400.0
CAP_RIG = Model((Channel("b1x", "bearing1", "x"),), band=(100.0, 2600.0))
PLACE = "bearing1.x"


def response(modes: list[tuple[float, float, float]], seconds: float, seed: int, noise: float = 1e-3) -> Array:
    """(n, 1) acceleration: oscillators (Hz, damping, weight), each under its own white force, and sensor noise."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE_HZ)
    f = np.fft.rfftfreq(n + 4096, 1.0 / RATE_HZ)
    out = noise * rng.standard_normal(n)
    for f0, zeta, weight in modes:
        H = -(f**2) / (f0**2 - f**2 + 2j * zeta * f0 * f)
        out += weight * np.fft.irfft(np.fft.rfft(rng.standard_normal(n + 4096)) * H, n + 4096)[2048 : 2048 + n]
    return np.asarray(out[:, None])


def surveyed(y: Array, model: Model = CAP_RIG) -> StructureSurvey:
    """The survey of a record; its JSON is valid and numpy has nothing to warn of."""
    machine = survey_machine(model, y, RATE_HZ)
    with np.errstate(divide="raise", invalid="raise", over="raise"):
        survey = survey_structure(model, y, RATE_HZ, RecordSurvey(), machine)
    json.dumps(survey.to_json(), allow_nan=False)
    return survey


@pytest.mark.parametrize(
    ("modes", "seconds"),
    [
        ([(600.0, 0.02, 1.0)], 10.0),
        ([(600.0, 0.02, 1.0)], 1.0),
        ([(600.0, 0.004, 1.0)], 10.0),
        ([(600.0, 0.12, 1.0)], 10.0),
        ([(600.0, 0.45, 1.0)], 10.0),
        ([(400.0, 0.01, 1.0), (900.0, 0.03, 0.7)], 10.0),
    ],
)
def test_modes_lie_within_their_standard_deviations(modes: list[tuple[float, float, float]], seconds: float) -> None:
    """Over 100 records each, the 95 % intervals held 93 to 97 % of frequencies and 92 to 99 % of damping ratios."""
    off = []
    for seed in range(8):
        found = [m for m in surveyed(response(modes, seconds, seed)).modes if m.energy_share > 0.01]
        assert len(found) == len(modes)
        for mode, (f0, zeta, _) in zip(found, modes, strict=True):
            off.append((mode.frequency_hz - f0) / mode.frequency_sd)
            off.append((mode.damping - zeta) / mode.damping_sd)
    assert np.mean(np.abs(off) < 1.96) >= 0.8
    assert np.max(np.abs(off)) < 4.5


@pytest.mark.parametrize("seconds", [0.5, 5.0])
def test_white_noise_and_tones_have_no_mode(seconds: float) -> None:
    for seed in range(5):
        y = response([], seconds, seed, noise=1.0)
        assert not surveyed(y).modes
        t = np.arange(len(y))[:, None] / RATE_HZ
        y += sum(a * np.sin(2 * np.pi * f * t) for f, a in ((150.0, 5.0), (333.3, 1.0), (1000.0, 0.3)))
        assert not surveyed(y).modes
    assert "no clear resonance" in str(bearing_mode(surveyed(y), PLACE))


def test_one_resonance_is_the_bearings_beside_tones_and_level_changes() -> None:
    y = response([(600.0, 0.02, 1.0)], 10.0, 1)
    y *= np.linspace(0.5, 2.0, len(y))[:, None]
    y += np.sin(2 * np.pi * 50.0 * np.arange(len(y)) / RATE_HZ)[:, None] * 20.0
    y += np.sin(2 * np.pi * 590.0 * np.arange(len(y)) / RATE_HZ)[:, None] * 10.0
    mode = bearing_mode(surveyed(y), PLACE)
    assert not isinstance(mode, str)
    assert mode.frequency_hz == pytest.approx(600.0, abs=4 * mode.frequency_sd)
    assert mode.damping == pytest.approx(0.02, abs=4 * mode.damping_sd)


def test_several_modes_of_similar_strength_are_not_attributed() -> None:
    y = response([(400.0, 0.01, 1.0), (900.0, 0.02, 3.0), (1700.0, 0.01, 4.0)], 10.0, 2)
    survey = surveyed(y)
    reason = bearing_mode(survey, PLACE)
    assert isinstance(reason, str)
    assert "3 modes of similar strength" in reason
    assert not any(m.bearing for m in survey.modes)
    shaft = Model(CAP_RIG.channels, band=CAP_RIG.band, shaft="chain", mass={"disc": 0.5})
    assert not isinstance(bearing_mode(surveyed(y, shaft), PLACE), str)  # two caps and a disc


def test_two_directions_of_one_cap_count_once() -> None:
    y = response([(600.0, 0.02, 1.0), (700.0, 0.02, 1.0)], 10.0, 3)
    assert not isinstance(bearing_mode(surveyed(y), PLACE), str)


def test_many_short_records_are_one() -> None:
    pieces = [np.vstack([response([(600.0, 0.02, 1.0)], 0.2, seed), np.full((99, 1), np.nan)]) for seed in range(40)]
    (mode,) = surveyed(np.concatenate(pieces)).modes
    assert mode.frequency_hz == pytest.approx(600.0, abs=4 * mode.frequency_sd)


@pytest.mark.parametrize("kind", ["velocity", "displacement"])
def test_other_kinds_of_sensor(kind: str) -> None:
    a = response([(600.0, 0.02, 1.0)], 10.0, 4, noise=0.0)[:, 0]
    f = np.fft.rfftfreq(a.size, 1.0 / RATE_HZ)
    order = 1 if kind == "velocity" else 2
    y = np.fft.irfft(np.where(f > 20.0, np.fft.rfft(a) / (2j * np.pi * np.maximum(f, 1.0)) ** order, 0.0), a.size)
    y += 1e-3 * y.std() * np.random.default_rng(0).standard_normal(y.size)
    mode = bearing_mode(surveyed(y[:, None], Model((Channel("b1x", "bearing1", "x", kind),), band=CAP_RIG.band)), PLACE)
    assert not isinstance(mode, str)
    assert mode.frequency_hz == pytest.approx(600.0, abs=4 * mode.frequency_sd)


def test_excitation_is_that_of_the_force_and_poles_are_stable() -> None:
    survey = surveyed(response([(600.0, 0.02, 1.0)], 20.0, 5))
    own = survey.places[PLACE]
    white = 2.0 / RATE_HZ
    inner = (own.excitation.frequency_hz > 200.0) & (own.excitation.frequency_hz < 2000.0)
    assert own.excitation.psd[inner] == pytest.approx(white, rel=0.15)
    assert [p.order for p in own.poles] == [1]


@pytest.mark.parametrize(
    ("band", "seconds", "reason"),
    [
        ((2.0, 2600.0), 4.0, "record 8 s, or begin the band at 4 Hz"),
        ((1.0, 2600.0), 8.0, "record 32 s, or begin the band at 2 Hz"),
        ((0.1, 2600.0), 8.0, "too short for a band from 0.1 Hz: begin the band at 2 Hz"),
        ((2500.0, 2600.0), 4.0, "the band is too narrow"),
        ((100.0, 2600.0), 0.01, "no two pieces"),
    ],
)
def test_a_band_that_the_record_does_not_resolve_has_its_reason(
    band: tuple[float, float], seconds: float, reason: str
) -> None:
    survey = surveyed(response([(600.0, 0.02, 1.0)], seconds, 1), replace(CAP_RIG, band=band))
    assert reason in survey.missing[PLACE]


def test_a_band_that_begins_where_the_reason_says_is_answered() -> None:
    assert not surveyed(response([(600.0, 0.02, 1.0)], 8.0, 1), replace(CAP_RIG, band=(2.0, 2600.0))).missing


@pytest.mark.parametrize("n", [0, 1, 100, 700])
@pytest.mark.parametrize("value", [0.0, np.nan, 1e15])
def test_any_record_is_answered(n: int, value: float) -> None:
    y = np.full((n, 1), value)
    survey = surveyed(y)
    assert not survey.modes
    assert ("nothing moves" if n == 700 and value == value else "too short") in str(bearing_mode(survey, PLACE))
    record, machine = RecordSurvey(unusable=frozenset({"b1x"})), survey_machine(CAP_RIG, y, RATE_HZ)
    unusable = survey_structure(CAP_RIG, y, RATE_HZ, record, machine)
    assert "unusable" in str(bearing_mode(unusable, PLACE))
