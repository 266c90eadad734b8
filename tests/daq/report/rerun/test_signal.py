"""What the viewer is shown, against brute force, scipy and exact motions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import get_window, welch

from daq.report.rerun.plane import Axis, Plane, decades, nice_step, round_up
from daq.report.rerun.signal import displacement, envelope, spectrum


@given(st.integers(0, 1000), st.integers(1, 300), st.integers(2, 40))
def test_envelope_is_the_extremes_of_every_bin(index: int, n: int, width: int) -> None:
    counts = np.random.default_rng(n).integers(-(2**31), 2**31 - 1, (n, 2), dtype=np.int32)
    at, rows = envelope(index, counts, width)
    bins = (np.arange(index, index + n)) // width
    for row, name in enumerate(np.unique(bins)):
        inside = counts[bins == name]
        np.testing.assert_array_equal(rows[2 * row], inside.min(axis=0))
        np.testing.assert_array_equal(rows[2 * row + 1], inside.max(axis=0))
        assert index <= at[2 * row] <= at[2 * row + 1] < index + n
        assert set(at[2 * row : 2 * row + 2] // width) == {name}
    assert len(rows) == 2 * len(np.unique(bins))


def test_envelope_of_a_slow_signal_is_the_signal() -> None:
    counts = np.arange(10, dtype=np.int32).reshape(5, 2)
    at, rows = envelope(7, counts, 1)
    np.testing.assert_array_equal(at, np.arange(7, 12))
    np.testing.assert_array_equal(rows, counts)


def test_spectrum_is_that_of_welch() -> None:
    y = np.random.default_rng(1).normal(size=(25600, 2)) * [1.0, 3.0]
    found = spectrum(y, 25600.0, points=10**6)
    assert found is not None
    f, power = found
    window = get_window("hann", 4096)

    def without_mean(segments: np.ndarray) -> np.ndarray:
        return segments - np.average(segments, axis=-1, weights=window, keepdims=True)

    expected_f, expected = welch(y, 25600.0, nperseg=4096, axis=0, detrend=without_mean)
    np.testing.assert_allclose(f, expected_f[1:-1])
    np.testing.assert_allclose(power, expected[1:-1], rtol=1e-6)


def test_an_oscillation_beside_a_mean_leaves_no_power_at_the_first_line() -> None:
    """The plain mean of a cut oscillation would leave 8e-7 of the peak there."""
    y = 9.81 + np.sin(2 * np.pi * 137.3 * np.arange(25600) / 25600.0)[:, None]
    found = spectrum(y, 25600.0, points=10**6)
    assert found is not None
    assert found[1][0, 0] < 1e-9 * found[1].max()


def test_spectrum_keeps_the_power_on_the_logarithmic_grid() -> None:
    y = np.random.default_rng(2).normal(size=(25600, 1)) * 5.0
    found = spectrum(y, 25600.0)
    assert found is not None
    f, power = found
    assert len(f) <= 400
    assert np.trapezoid(power[:, 0], f) == pytest.approx(25.0, rel=0.05)


def test_spectrum_leaves_out_what_is_missing() -> None:
    y = np.random.default_rng(3).normal(size=(25600, 1))
    y[9000:9500] = np.nan
    found = spectrum(y, 25600.0)
    assert found is not None
    assert np.isfinite(found[1]).all()
    assert spectrum(np.full((25600, 1), np.nan), 25600.0) is None
    assert spectrum(np.zeros((4, 1)), 25600.0) is None


@pytest.mark.parametrize(("kind", "order"), [("acceleration", 2), ("velocity", 1), ("displacement", 0)])
def test_displacement_of_a_sine(kind: str, order: int) -> None:
    rate, f = 25600.0, 1100.0
    t = np.arange(25600) / rate
    omega = 2 * np.pi * f
    x = 3e-8 * np.sin(omega * t)
    measured = (3e-8 * omega**order * np.sin(omega * t + order * np.pi / 2))[:, None]
    measured += (3e-6 * (2 * np.pi * 35) ** order * np.sin(2 * np.pi * 35 * t))[:, None]  # larger, below the band
    found = displacement(measured, kind, rate, (150.0, 8000.0))[:, 0]
    inner = slice(4000, -4000)
    np.testing.assert_allclose(found[inner], x[inner], atol=3e-10)


@given(st.floats(1e-12, 1e12))
def test_axes_end_at_round_numbers(value: float) -> None:
    for step in (nice_step(value), round_up(value)):
        assert value <= step * (1 + 1e-9)
        assert step <= 10.01 * value
    assert 1 <= len(Axis(-round_up(value), round_up(value), "").ticks()) <= 12
    low, high = decades(np.array([value, value * 50, np.nan, 0.0]))
    assert low <= value * (1 + 1e-9)
    assert value * 50 <= high * (1 + 1e-9)
    assert len(Axis(low, high, "", log=True).ticks()) >= 2


def test_points_stay_in_the_frame() -> None:
    plane = Plane(Axis(1.0, 100.0, "x", log=True), Axis(-1.0, 1.0, "y"))
    points = plane.points(np.array([1.0, 10.0, 1e9, np.nan, -5.0]), np.array([-1.0, 0.0, 7.0, 0.0, 0.5]))
    np.testing.assert_allclose(points, [[0, 560], [650, 280], [1300, 0], [0, 140]])
