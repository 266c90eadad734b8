"""The anti-alias filter of a rig file: its response is that of scipy, less the delay at low frequencies."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from estimator.model.recorder import AntiAlias

RATE_HZ = 4096.0
F = np.linspace(1.0, 1700.0, 200)
ANALOGUE = {
    "butterworth": signal.butter(5, 2 * np.pi * 1200.0, analog=True),
    "bessel": signal.bessel(5, 2 * np.pi * 1200.0, analog=True, norm="mag"),
    "chebyshev1": signal.cheby1(5, 0.5, 2 * np.pi * 1200.0, analog=True),
    "chebyshev2": signal.cheby2(5, 60.0, 2 * np.pi * 1200.0, analog=True),
}


@pytest.mark.parametrize("kind", ANALOGUE)
def test_the_response_is_that_of_the_design_without_its_delay(kind: str) -> None:
    own = AntiAlias(kind=kind, order=5, cutoff_hz=1200.0).response(F, RATE_HZ)  # type: ignore[arg-type]
    _, wanted = signal.freqs(*ANALOGUE[kind], 2 * np.pi * F)
    _, at_zero = signal.freqs(*ANALOGUE[kind], [1e-3])
    assert abs(own) == pytest.approx(abs(wanted / at_zero[0]), rel=1e-9)
    left = np.unwrap(np.angle(own / wanted)) / F  # a delay: proportional to frequency
    assert np.ptp(left) < 1e-6 * abs(left).max()
    assert abs(np.angle(own[0])) < 1e-6


def test_taps_have_no_phase() -> None:
    own = AntiAlias(kind="fir", order=24, cutoff_hz=1200.0).response(F, RATE_HZ)
    _, wanted = signal.freqz(signal.firwin(25, 1200.0, fs=RATE_HZ), worN=F, fs=RATE_HZ)
    assert own.real == pytest.approx(abs(wanted) * np.sign(own.real), rel=1e-9, abs=1e-12)
    assert not own.imag.any()


def test_a_slow_filter_is_trusted_less_far_than_a_steep_one() -> None:
    slow = AntiAlias(kind="bessel", order=3, cutoff_hz=1200.0).trusted_to_hz(RATE_HZ)
    steep = AntiAlias(kind="butterworth", order=8, cutoff_hz=1500.0).trusted_to_hz(RATE_HZ)
    assert 100.0 < slow < 1200.0 < steep < RATE_HZ / 2
