"""A record filtered where it is asked for has the bits of a stream."""

import numpy as np
import pytest
from reference_rig import RATE

from estimator.signals.band_limit import BandLimit, Terms
from estimator.signals.band_limited_record import BandLimitedRecord

KINDS, BAND = ["acceleration", "displacement"], (150.0, 8000.0)


def shaft(f: np.ndarray) -> np.ndarray:
    return np.asarray(1e5 / (1e5 - f**2 + 1j * f))


@pytest.mark.parametrize("extra", [(), [(np.array([[1.0, -0.5], [-0.5, 2.0]]), shaft)]])
def test_the_whole_has_the_bits_of_the_stream(extra: Terms) -> None:
    rng = np.random.default_rng(0)
    y = rng.normal(size=(60001, 2))
    y[20000:20007, 1] = np.nan
    stream = BandLimit(KINDS, RATE, BAND, extra).push(y)
    held = BandLimitedRecord(y, KINDS, RATE, BAND, extra).whole()
    assert 0 < len(y) - stream.rows < 20000
    assert np.array_equal(held.valid[: stream.rows], stream.valid)
    for name in "avxu" if extra else "avx":
        assert np.array_equal(getattr(held, name)[:, : stream.rows], getattr(stream, name))


def test_stretches_are_the_rows_of_the_whole() -> None:
    y = np.random.default_rng(2).normal(size=(40000, 3))
    own = BandLimitedRecord(y, ["acceleration", "velocity"], 4096.0, (100.0, 1500.0), columns=[2, 0])
    whole, stretches = own.whole(), [slice(3000, 9000), slice(20000, 20100), slice(25000, 33000)]
    part = own.of_stretches(stretches)
    for name in ("a", "v", "x"):
        wanted = np.concatenate([getattr(whole, name)[:, rows] for rows in stretches], axis=1)
        np.testing.assert_array_equal(getattr(part, name), wanted)
    assert part.valid.all()
