"""A record filtered where it is asked for: the same bits, the same fit, without holding the motion."""

import numpy as np
import pytest
from reference_rig import PLACES, RATE, rig_model, rig_record

from estimator.identification.batch import fit_spectral
from estimator.signals import band_limited_record
from estimator.signals.band_limit import band_limit
from estimator.signals.band_limited_record import BandLimitedRecord

KINDS, BAND = ["acceleration", "displacement"], (150.0, 8000.0)


def shaft(f: np.ndarray) -> np.ndarray:
    return np.asarray(1e5 / (1e5 - f**2 + 1j * f))


@pytest.mark.parametrize("extra", [None, shaft])
def test_every_piece_has_the_bits_of_the_stream(extra: object) -> None:
    rng = np.random.default_rng(0)
    y = rng.normal(size=(60001, 2))
    y[20000:20007, 1] = np.nan
    whole = band_limit(y, KINDS, RATE, BAND, extra)  # type: ignore[arg-type]
    pieces = BandLimitedRecord(y, KINDS, RATE, BAND, extra)  # type: ignore[arg-type]
    assert np.array_equal(pieces.valid, whole.valid)
    held = pieces.whole()
    for lo, hi in ((0, 60001), (0, 1), (59990, 60001), (19000, 21000), (8191, 40000)):
        z = pieces.cut(lo, hi)
        for k, name in enumerate("avxu" if extra else "avx"):
            assert np.array_equal(z[k], getattr(whole, name)[:, lo:hi])
            assert np.array_equal(getattr(held, name), getattr(whole, name))
    rms = np.sqrt(np.mean(whole.x[:, whole.valid] ** 2, axis=1))
    assert np.allclose(pieces.rms[2], rms, rtol=1e-12)


@pytest.mark.slow
def test_a_large_record_is_fitted_without_its_motion_held(monkeypatch: pytest.MonkeyPatch) -> None:
    y = rig_record(8.0, seed=1)
    small = fit_spectral(rig_model("cubic"), y, RATE).parameters
    monkeypatch.setattr(band_limited_record, "MAX_HELD_BYTES", 1e6)
    large = fit_spectral(rig_model("cubic"), y, RATE).parameters
    for place in PLACES:
        for name in (f"{place}.kL", f"{place}.c", f"{place}.cubic.kNL"):
            assert large[name].value == pytest.approx(small[name].value, rel=1e-9)


def test_stretches_are_the_rows_of_the_whole() -> None:
    y = np.random.default_rng(2).normal(size=(40000, 3))
    own = BandLimitedRecord(y, ["acceleration", "velocity"], 4096.0, (100.0, 1500.0), columns=[2, 0])
    whole, stretches = own.whole(), [slice(3000, 9000), slice(20000, 20100), slice(25000, 33000)]
    part = own.of_stretches(stretches)
    for name in ("a", "v", "x"):
        wanted = np.concatenate([getattr(whole, name)[:, rows] for rows in stretches], axis=1)
        np.testing.assert_array_equal(getattr(part, name), wanted)
    assert part.valid.all()
