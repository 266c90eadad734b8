"""What displacement sensors measure below the band, as the laws see it."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.likelihood.motion import prepare as cut_record
from estimator.likelihood.response.below_band import with_below_band_motion
from estimator.model.rig import Channel, EffectUse, Model
from estimator.signals.band_limit import BandLimit
from estimator.signals.band_limited_record import BandLimitedRecord

RATE, SECONDS, BAND = 1000.0, 40.0, (10.0, 450.0)


def rig(kind: str) -> Model:
    channel = (Channel("d", "bearing1", "x", kind),)
    return Model(channel, BAND, "none", {"bearing1": 1.0}, effects=(EffectUse("cubic", {"bearing1.x": {}}),))


def response(rng: np.random.Generator) -> np.ndarray:
    """(n,) displacement of an oscillator of 50 Hz and 3 % under white noise, periodic in the record: down to 0 Hz."""
    n = int(RATE * SECONDS)
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / RATE)
    return np.fft.irfft(np.fft.rfft(rng.normal(size=n)) / ((100 * np.pi) ** 2 + 6j * np.pi * w - w**2), n)


def probed() -> tuple[np.ndarray, np.ndarray]:
    """(n,) displacement, and (n, 1) what a proximity probe makes of it: an offset, a gap."""
    x = response(np.random.default_rng(1))
    y = (x + 1000 * x.std())[:, None]
    y[3000:3005] = np.nan
    return x, y


def test_laws_see_what_a_displacement_sensor_measures_below_the_band() -> None:
    x, y = probed()
    model = rig("displacement")
    data = cut_record.prepare(model, y, RATE)
    rows = np.round(data.t * RATE).astype(int)
    assert data.slow is not None
    now, left = x[rows] - data.displacement(0), x[rows] - data.x[0]
    assert now.std() < 0.4 * left.std()
    assert with_below_band_motion(data, np.ones(1), np.ones(1), ()).slow is data.slow


def test_a_stream_and_a_record_have_the_same_bits() -> None:
    y = probed()[1]
    whole = BandLimitedRecord(y, ["displacement"], RATE, BAND).whole()
    assert whole.slow is None, "nobody asked"
    stream = BandLimit(["displacement"], RATE, BAND, slow=True)
    parts = [stream.push(part) for part in np.array_split(y, 37)]
    rows = sum(p.rows for p in parts)
    assert rows > 0.8 * len(y)
    held = BandLimitedRecord(y, ["displacement"], RATE, BAND, slow=True).whole()
    assert held.slow is not None
    assert np.array_equal(np.concatenate([p.slow for p in parts if p.slow is not None], axis=1), held.slow[:, :rows])
    assert np.array_equal(held.x, whole.x)


@pytest.mark.parametrize("kind", ["acceleration", "velocity"])
def test_another_sensor_sees_nothing_there(kind: str) -> None:
    y = response(np.random.default_rng(2))[:, None]
    assert cut_record.prepare(rig(kind), y, RATE).slow is None
