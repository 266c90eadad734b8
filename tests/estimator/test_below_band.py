"""What displacement sensors measure below the band, as the laws see it."""

from __future__ import annotations

import numpy as np

from estimator.below_band import seen_below
from estimator.lines import begin
from estimator.model import Channel, EffectUse, Model
from estimator.record import Record, prepare
from estimator.start import Start

RATE, SECONDS, BAND = 1000.0, 40.0, (10.0, 450.0)


def rig(kind: str) -> Model:
    channel = (Channel("d", "bearing1", "x", kind),)
    return Model(channel, BAND, "none", {"bearing1": 1.0}, effects=(EffectUse("cubic", {"bearing1.x": {}}),))


def response(rng: np.random.Generator) -> np.ndarray:
    """(n,) displacement of an oscillator of 50 Hz and 3 % under white noise, periodic in the record: down to 0 Hz."""
    n = int(RATE * SECONDS)
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / RATE)
    return np.fft.irfft(np.fft.rfft(rng.normal(size=n)) / ((100 * np.pi) ** 2 + 6j * np.pi * w - w**2), n)


def prepared(y: np.ndarray, kind: str = "displacement") -> tuple[Record, Start, Record, Start]:
    record, start = begin(prepare(rig(kind), y, RATE))
    return record, start, *seen_below(record, start, y)


def test_laws_see_what_a_displacement_sensor_measures_below_the_band() -> None:
    x = response(np.random.default_rng(1))
    y = (x + 40 * x.std())[:, None]  # a proximity probe has an offset
    y[3000:3005] = np.nan
    record, start, other, wider = prepared(y)
    valid = record.motion.valid
    left = (x - record.motion.x[0])[valid]
    now = (x - record.motion.x[0] - other.slow[0])[valid]
    # above 450 Hz nothing of note; the linear start's own idea of what is left out holds for both
    assert now.std() < 0.4 * left.std()
    np.testing.assert_allclose(left.std(), start.widths[0, 0], rtol=0.25)
    np.testing.assert_allclose(now.std(), wider.widths[0, 0], rtol=0.4)


def test_an_accelerometer_sees_nothing_there() -> None:
    y = response(np.random.default_rng(2))[:, None]
    record, start, other, same = prepared(y, "acceleration")
    assert other is record
    assert same is start
