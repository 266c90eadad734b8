"""Rms, peak, crest factor, kurtosis and velocity of one channel."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from estimator.arrays import Array

from .findings import ChannelSummary

ISO_BAND_HZ = (10.0, 1000.0)  # of the velocity, ISO 20816-1
MIN_STRETCH_S = 1.0  # ten periods of the lower edge
SEGMENT_S = 2.0  # of the spectrum that is integrated to velocity


def stretches(y: Array) -> list[tuple[int, int]]:
    """First row and row behind the last one of every stretch of finite samples. y : (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.isfinite(y), [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def segments(y: Array, samples: int) -> Iterator[Array]:
    """Segments of a channel (n,) that overlap by half, of its finite stretches, as arrays (up to 64, samples)."""
    for first, stop in stretches(y):
        if stop - first >= samples:
            views = np.lib.stride_tricks.sliding_window_view(y[first:stop], samples)[:: max(samples // 2, 1)]
            for at in range(0, len(views), 64):
                yield views[at : at + 64]


def power_spectrum(y: Array, rate_hz: float, samples: int) -> tuple[Array, Array, int]:
    """Averaged one-sided PSD of a channel over its finite stretches of at least so many samples.

    Parameters
    ----------
    y : (n,) float64
        Samples; NaN where one is missing.
    rate_hz : float
        Sampling rate, Hz.
    samples : int
        Length of a segment; segments overlap by half and have a Hann window.

    Returns
    -------
    tuple of (f,) float64, (f,) float64, int
        Frequencies in Hz, PSD in the squared unit of `y` per Hz (zero without a segment), and number of segments.
    """
    window = np.hanning(samples + 1)[:-1]
    total, count = np.zeros(samples // 2 + 1), 0
    for part in segments(y, samples):
        transform = np.fft.rfft((part - part.mean(axis=1, keepdims=True)) * window)
        total += np.sum(transform.real**2 + transform.imag**2, axis=0)
        count += len(part)
    scale = 2.0 / (rate_hz * max(np.sum(window**2), 1.0) * max(count, 1))
    return np.asarray(np.fft.rfftfreq(samples, 1.0 / rate_hz)), total * scale, count


def velocity_rms(y: Array, kind: str, rate_hz: float) -> float | None:
    """Velocity from 10 to 1000 Hz in m/s rms; None where `ChannelSummary` says so. y : (n,) m/s^2 or m/s."""
    if kind not in ("acceleration", "velocity") or rate_hz < 2.0 * ISO_BAND_HZ[1]:
        return None
    longest = max((stop - first for first, stop in stretches(y)), default=0)
    if longest < MIN_STRETCH_S * rate_hz:
        return None
    f, psd, _ = power_spectrum(y, rate_hz, int(min(longest, SEGMENT_S * rate_hz)))
    inside = (f >= ISO_BAND_HZ[0]) & (f <= ISO_BAND_HZ[1])
    order = 2.0 if kind == "acceleration" else 0.0
    power = psd[inside] / (2.0 * np.pi * f[inside]) ** order
    return float(np.sqrt(np.sum(power) * (f[1] - f[0])))


def summarise(y: Array, kind: str, rate_hz: float) -> ChannelSummary:
    """Summary of a channel.

    Parameters
    ----------
    y : (n,) float64
        Samples in SI units; NaN where a sample is missing.
    kind : str
        Kind of the channel, such as "acceleration".
    rate_hz : float
        Sampling rate, Hz.
    """
    z = y[np.isfinite(y)]
    if not z.size:
        return ChannelSummary()
    largest = float(np.max(np.abs(z)))
    scale = largest if largest > 0.0 else 1.0
    z = z / scale  # powers neither overflow nor vanish
    z = z - z.mean()
    square = z * z
    power = float(np.mean(square))
    peak = float(np.max(np.abs(z)))
    if power < 1e-24:  # rounding of the mean of a constant
        return ChannelSummary(rms=0.0, peak=0.0)
    velocity = velocity_rms(y / scale, kind, rate_hz)
    return ChannelSummary(
        rms=float(np.sqrt(power) * scale),
        peak=peak * scale,
        crest=float(peak / np.sqrt(power)),
        kurtosis=float(np.mean(square * square) / power**2),
        velocity_rms_mm_s=None if velocity is None else 1e3 * velocity * scale,
    )
