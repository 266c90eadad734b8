"""A low-pass filter by a Kaiser window. scipy.signal has one too, but takes 0.5 s to import."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array


def kaiser_low_pass(taps: int, cutoff: float, beta: float) -> Array:
    """(taps,) low-pass filter under a Kaiser window, gain 1 at 0 Hz. cutoff : over the Nyquist frequency."""
    k = np.arange(taps) - 0.5 * (taps - 1)
    h = np.sinc(cutoff * k) * np.kaiser(taps, beta)
    return np.asarray(h / h.sum())


def kaiser_order(attenuation_db: float, width: float) -> tuple[int, float]:
    """Number of taps and beta for an attenuation above 50 dB and a width of the transition over the Nyquist frequency.

    Kaiser's formula, as scipy.signal.kaiserord.
    """
    return int(np.ceil((attenuation_db - 7.95) / (2.285 * np.pi * width) + 1)), 0.1102 * (attenuation_db - 8.7)
