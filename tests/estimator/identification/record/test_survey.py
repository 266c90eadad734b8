"""What the record layer says of faulty and of good channels."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest

from estimator.arrays import Array
from estimator.identification.record import RecordSurvey, survey_record
from estimator.model.rig import Channel, Model

RATE_HZ = 6400.0
TWO_CAP_RIG = Model((Channel("b1x", "bearing1", "x"), Channel("b2x", "bearing2", "x")), band=(100.0, 2500.0))


def resonance(seed: int, seconds: float = 5.0, f_hz: float = 600.0) -> Array:
    """Acceleration of an oscillator under white force, rms 5 m/s^2, with sensor noise."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE_HZ)
    f = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    H = (1j * f) ** 2 / (f_hz**2 - f**2 + 0.08j * f * f_hz)
    y = np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) * H, n)
    return np.asarray(5.0 * y / y.std() + 1e-2 * rng.standard_normal(n))


def good(seconds: float = 5.0) -> Array:
    """Two good channels."""
    return np.column_stack([resonance(1, seconds), resonance(2, seconds)])


def codes(y: Array, model: Model = TWO_CAP_RIG, rate_hz: float = RATE_HZ) -> dict[str, set[str]]:
    """Channels that each code is said of; no warning of numpy on the way."""
    with np.errstate(all="raise"):
        survey = survey_record(model, y, rate_hz)
    out: dict[str, set[str]] = {}
    for finding in survey.findings:
        out.setdefault(finding.code, set()).update(finding.channels)
    return out


def test_good_record_has_no_finding() -> None:
    for seconds in (0.1, 0.5, 5.0):
        assert codes(good(seconds)) == {}


def _set(y: Array, rows: slice, value: float) -> Array:
    y[rows, 0] = value
    return y


def _spiked(y: Array) -> Array:
    y[[7000, 20000], 0] = 1e6, -300.0
    return y


FAULTS = {
    "empty_channel": lambda y: _set(y, slice(None), np.nan),
    "dead_channel": lambda y: _set(y, slice(None), 0.25),
    "frozen_channel": lambda y: _set(y, slice(16000, None), y[16000, 0]),
    "clipped": lambda y: np.column_stack([np.clip(y[:, 0], -8.0, 8.0), y[:, 1]]),
    "few_levels": lambda y: np.column_stack([np.round(y[:, 0] / 40.0 + 0.01) * 40.0, y[:, 1]]),
    "spikes": _spiked,
    "offset": lambda y: y + np.array([250.0, 0.0]),
    "wrong_unit": lambda y: y * np.array([1e6, 1.0]),
    "missing_samples": lambda y: _set(y, slice(3000, 5000), np.nan),
    "level_step": lambda y: np.concatenate([y[:16000], y[16000:] * np.array([0.01, 1.0])]),
    "repeated_samples": lambda y: np.column_stack([np.repeat(y[::4, 0], 4), y[:, 1]]),
}


@pytest.mark.parametrize("code", FAULTS)
def test_fault_of_one_channel_is_named_alone(code: str) -> None:
    assert codes(FAULTS[code](good())) == {code: {"b1x"}}


def test_one_bit_channel() -> None:
    y = good()
    y[:, 0] = np.where(y[:, 0] > 0.0, 1.0, -1.0)
    survey = survey_record(TWO_CAP_RIG, y, RATE_HZ)
    assert [f.code for f in survey.findings] == ["few_levels"]
    assert "one bit" in survey.findings[0].text
    assert survey.unusable == {"b1x"}


@pytest.mark.parametrize("gain", [1.0, -1.0, 3.7])
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_copy_of_another_channel(gain: float, noise: float) -> None:
    y = good()
    y[:, 1] = gain * y[:, 0] + 0.3 + noise * np.random.default_rng(0).standard_normal(len(y))
    survey = survey_record(TWO_CAP_RIG, y, RATE_HZ)
    assert [f.code for f in survey.findings] == ["copied_channel"]
    assert survey.unusable == {"b2x"}
    assert ("inverted" in survey.findings[0].text) == (gain < 0.0)


def test_two_sensors_of_pure_tones_are_no_copies() -> None:
    t = np.arange(32000) / RATE_HZ
    rng = np.random.default_rng(3)
    tone = 10.0 * np.sin(2 * np.pi * 50.0 * t)
    y = np.column_stack([tone, 0.7 * tone]) + 3e-2 * rng.standard_normal((t.size, 2))
    assert codes(y) == {}


SAME = Model((Channel("a", "bearing1", "x"), Channel("b", "bearing1", "x")), band=(100.0, 2500.0))


@pytest.mark.parametrize(
    ("gain", "expected"), [(1.0, {}), (-1.0, {"inverted_channel": {"a", "b"}}), (9.81, {"wrong_unit": {"a", "b"}})]
)
def test_two_sensors_of_one_dof(gain: float, expected: dict[str, set[str]]) -> None:
    one = resonance(1)
    noise = 0.2 * np.random.default_rng(5).standard_normal((one.size, 2))
    assert codes(np.column_stack([one, one])[:, :] * [1.0, gain] + noise * [1.0, gain], SAME) == expected


def test_acceleration_and_displacement_that_are_swapped() -> None:
    a = resonance(1)
    n = a.size
    f = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    x = np.fft.irfft(np.where(f > 20.0, np.fft.rfft(a) / (2j * np.pi * np.maximum(f, 1.0)) ** 2, 0.0), n)
    x += 1e-3 * x.std() * np.random.default_rng(1).standard_normal(n)
    kinds = Model((Channel("a", "bearing1", "x"), Channel("d", "bearing1", "x", "displacement")), band=(100.0, 2500.0))
    assert codes(np.column_stack([a, x]), kinds) == {}
    assert codes(np.column_stack([a, -x]), kinds) == {"inverted_channel": {"a", "d"}}
    assert codes(np.column_stack([1e-4 * x / x.std(), 1e-7 * a]), kinds)["swapped_channels"] == {"a", "d"}


def test_clipping_says_share_and_range() -> None:
    y = good()
    y[:, 0] = np.clip(y[:, 0], -10.0, 10.0)
    (finding,) = survey_record(TWO_CAP_RIG, y, RATE_HZ).findings
    assert "clipped at +-10 m/s^2 in 4" in finding.text
    assert "range of at least 25 m/s^2" in finding.text
    assert finding.places == ("bearing1.x",)


def test_few_clipped_peaks_do_not_spoil_the_channel() -> None:
    y = good(60.0)
    top = np.quantile(np.abs(y[:, 0]), 1.0 - 1.8e-4)
    y[:, 0] = np.clip(y[:, 0], -top, top)
    survey = survey_record(TWO_CAP_RIG, y, RATE_HZ)
    assert [f.code for f in survey.findings] == ["peaks_clipped"]
    assert not survey.unjudged


def test_frozen_stretch_has_its_times() -> None:
    y = good()
    y[6400:9600, 0] = y[6400, 0]
    (finding,) = survey_record(TWO_CAP_RIG, y, RATE_HZ).findings
    assert finding.rows == ((6400, 9600),)
    assert "from 1 s to 1.5 s" in finding.text


def test_short_records_between_missing_rows_are_no_fault() -> None:
    y = np.concatenate([np.vstack([good(0.1) * (1 + k % 3), np.full((60, 2), np.nan)]) for k in range(20)])
    y += 1e-3 * np.random.default_rng(0).standard_normal(y.shape)
    assert codes(y) == {}


@pytest.mark.parametrize("n", [0, 1, 2, 3, 15, 70, 640])
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, 1e300, 5e-324])
def test_any_samples_are_answered(n: int, value: float) -> None:
    y = good(0.1)[:n]
    y[:, 0] = value
    survey = survey_record(TWO_CAP_RIG, y, RATE_HZ)
    json.dumps(survey.to_json(), allow_nan=False)
    assert "b1x" in survey.unusable
    y = good(0.1)[:n]
    y[: n // 2, 0] = value
    json.dumps(survey_record(TWO_CAP_RIG, y, RATE_HZ).to_json(), allow_nan=False)


def test_summary_of_a_sine() -> None:
    t = np.arange(int(4 * RATE_HZ)) / RATE_HZ
    sine = 3.0 + np.sqrt(2.0) * 2.0 * np.sin(2 * np.pi * 160.0 * t)
    survey: RecordSurvey = survey_record(SAME, np.column_stack([sine, resonance(3, 4.0)]), RATE_HZ)
    one = survey.channels["a"]
    assert one.rms == pytest.approx(2.0, rel=1e-3)
    assert one.crest == pytest.approx(np.sqrt(2.0), rel=1e-3)
    assert one.kurtosis == pytest.approx(1.5, rel=1e-3)
    assert one.velocity_rms_mm_s == pytest.approx(2e3 / (2 * np.pi * 160.0), rel=1e-2)
    assert survey_record(SAME, good(0.5), RATE_HZ).channels["a"].velocity_rms_mm_s is None


def test_a_minute_of_four_channels_takes_little_time() -> None:
    model = Model(tuple(Channel(f"c{k}", f"bearing{1 + k // 2}", "xy"[k % 2]) for k in range(4)), band=(100.0, 8000.0))
    y = np.random.default_rng(0).standard_normal((60 * 25600, 4))
    start = time.process_time()
    survey = survey_record(model, y, 25600.0)
    assert not survey.findings
    assert time.process_time() - start < 4.0
