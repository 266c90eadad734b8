"""The band limit: exact in the band, no delay, the same for any chunking, honest about gaps."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.errors import DataError
from estimator.signals.band_limit import BandLimit, Terms, half_length
from estimator.signals.band_limited_record import band_limit

RATE, BAND = 2000.0, (20.0, 600.0)


@pytest.mark.parametrize("kind", ["acceleration", "velocity", "displacement"])
def test_a_tone_in_the_band_comes_out_as_its_own_derivatives_and_integrals(kind: str) -> None:
    t = np.arange(6000) / RATE
    for f in (20.0, 57.3, 599.0):
        w = 2 * np.pi * f
        x, v, a = np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t)
        out = band_limit({"acceleration": a, "velocity": v, "displacement": x}[kind][:, None], [kind], RATE, BAND)
        k = out.valid
        for got, wanted in ((out.a, a), (out.v, v), (out.x, x)):
            assert np.abs(got[0, k] - wanted[k]).max() < 1e-4 * np.abs(wanted).max()


def test_offset_and_drift_do_not_pass() -> None:
    t = np.arange(6000) / RATE
    out = band_limit((3.0 + 0.5 * t)[:, None], ["acceleration"], RATE, BAND)
    # 1e-6 of what the same acceleration would be in displacement at the lower edge
    assert np.abs(out.x[0, out.valid]).max() < 1e-5 * 4.5 / (2 * np.pi * BAND[0]) ** 2


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 3000), min_size=1, max_size=12), st.integers(0, 2**31))
def test_any_chunking_gives_the_same_bits(sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(sum(sizes), 2))
    y[rng.integers(len(y))] = np.nan
    kinds = ["acceleration", "displacement"]
    whole = band_limit(y, kinds, RATE, BAND)
    stream = BandLimit(kinds, RATE, BAND)
    parts = [stream.push(c) for c in np.split(y, np.cumsum(sizes)[:-1])]
    rows = sum(p.rows for p in parts)
    assert whole.rows == len(y)
    assert len(y) - 8 * stream.half < rows <= max(len(y) - stream.half, 0)
    assert [p.start for p in parts] == list(np.cumsum([0] + [p.rows for p in parts])[:-1])
    for name in "avx":
        own = np.concatenate([getattr(p, name) for p in parts], axis=1)
        assert np.array_equal(getattr(whole, name)[:, :rows], own)
    assert np.array_equal(whole.valid[:rows], np.concatenate([p.valid for p in parts]))


def test_a_gap_invalidates_exactly_the_rows_that_it_touches() -> None:
    y = np.random.default_rng(1).normal(size=(9000, 1))
    holed = y.copy()
    holed[4000:4010] = np.nan
    whole, gapped = (band_limit(z, ["acceleration"], RATE, BAND) for z in (y, holed))
    half = half_length(RATE, BAND)
    invalid = np.flatnonzero(~gapped.valid)
    expected = np.r_[0:half, 4000 - half : 4010 + half, 9000 - half : 9000]
    assert np.array_equal(invalid, expected)
    k = gapped.valid
    assert np.allclose(whole.x[:, k], gapped.x[:, k], rtol=0, atol=1e-9 * np.abs(whole.x).max())


def test_extra_output_is_a_response_from_displacement() -> None:
    t = np.arange(6000) / RATE
    w = 2 * np.pi * 100.0
    velocity = through(lambda f: 2j * np.pi * f)
    out = band_limit(-w * w * np.sin(w * t)[:, None], ["acceleration"], RATE, BAND, extra=velocity)
    assert np.allclose(out.u[0, out.valid], w * np.cos(w * t)[out.valid], atol=1e-3 * w)


def test_impossible_bands_are_refused() -> None:
    for band in ((20.0, 1000.0), (600.0, 20.0), (0.0, 100.0)):
        with pytest.raises(DataError):
            BandLimit(["acceleration"], RATE, band)


def through(response: Callable[[np.ndarray], np.ndarray]) -> Terms:
    """The extra output that one channel has by a response."""
    return [(np.eye(1), response)]


@pytest.mark.parametrize("low", [150.0, 60.0])
def test_a_sharp_resonance_beside_or_in_the_band_does_not_spread_over_it(low: float) -> None:
    """A disc of 123 Hz that rings for a second: at 1100 Hz it is 980 N/m, and used to come out as 200,000."""
    k, m, c = 155e3, 0.515, 1.0

    def reaction(f: np.ndarray) -> np.ndarray:
        w = 2 * np.pi * f
        return -(k**2) / (2 * k + 1j * w * c - m * w**2)

    rate, hz = 25600.0, 1100.0
    t = np.arange(40000) / rate
    y = np.sin(2 * np.pi * hz * t)[:, None]
    out = band_limit(y, ["displacement"], rate, (low, 8000.0), extra=through(reaction))
    expected = np.real(reaction(np.array([hz]))[0]) * np.sin(2 * np.pi * hz * t)
    assert np.abs(out.u[0] - expected)[out.valid].max() < 0.05 * np.abs(expected).max()


@pytest.mark.parametrize("over", [0.86, 0.93, 0.98, 0.9998, 1.0, 1.001, 1.02, 1.05, 1.12])
def test_a_sharp_resonance_at_the_edge_of_the_band_is_left_out_and_nothing_else(over: float) -> None:
    """A disc at 125.58 Hz, where the band began at 125.6: straight lines from there made 60 N of a hundredth."""
    m, c, low = 0.58, 0.34, 125.6
    k = 0.5 * m * (2 * np.pi * over * low) ** 2

    def reaction(f: np.ndarray) -> np.ndarray:
        w = 2 * np.pi * f
        return -(k**2) / (2 * k + 2j * w * c - m * w**2)

    rate = 25600.0
    noise = np.random.default_rng(0).standard_normal((200_000, 1))
    out = band_limit(noise, ["displacement"], rate, (low, 8000.0), extra=through(reaction))
    f, x, u = (np.fft.rfftfreq(8192, 1 / rate), *(z[0][out.valid] for z in (out.x, out.u)))
    pieces = len(x) // 8192
    X, U = (np.fft.rfft(z[: pieces * 8192].reshape(pieces, -1) * np.hanning(8192)) for z in (x, u))
    found = (U * X.conj()).mean(0) / (abs(X) ** 2).mean(0)
    seen = (f > max(low, (over + 1 / 6) * low)) & (f < 1000.0)
    assert np.abs(found[seen] / reaction(f[seen]) - 1).max() < 0.04
    assert np.abs(found[(f > 0.55 * low) & (f < 1000.0)]).max() < 10 * k


@pytest.mark.parametrize(("apart_hz", "most"), [(26.0, 0.001), (40.0, 0.0004)])
def test_beside_a_sharp_resonance_that_is_left_out_the_response_is_right(apart_hz: float, most: float) -> None:
    """A disc of 992 Hz that rings for two seconds: 25 Hz on either side are left out, what comes after is to hold. A
    reaction 15 % off there was a pedestal of a complete model, and 5 % at 40 Hz made unknown masses 1 % too heavy."""
    k, m, c = 10e6, 0.515, 0.5

    def reaction(f: np.ndarray) -> np.ndarray:
        w = 2 * np.pi * f
        return -(k**2) / (2 * k + 2j * w * c - m * w**2)

    rate, hz = 25600.0, np.sqrt(2 * k / m) / (2 * np.pi) + apart_hz
    t = np.arange(40000) / rate
    y = np.sin(2 * np.pi * hz * t)[:, None]
    out = band_limit(y, ["displacement"], rate, (150.0, 8000.0), extra=through(reaction))
    expected = np.imag(reaction(np.array([hz]))[0] * np.exp(2j * np.pi * hz * t))
    assert np.abs(out.u[0] - expected)[out.valid].max() < most * np.abs(expected).max()
