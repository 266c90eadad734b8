"""Rms, peak, crest factor, kurtosis and velocity of one channel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy.fft import rfft

from estimator.arrays import Array, true_runs
from estimator.model.recorder import AntiAlias

from .findings import ChannelSummary
from .thresholds import PIECE_ROWS, RECORD_LIMITS


def longest_run(there: NDArray[np.bool_]) -> int:
    """Rows of the longest stretch of samples that are present. there : (n,)."""
    return int(np.diff(true_runs(there)).max(initial=0))


def longest_stretch(y: Array) -> int:
    """Samples of the longest finite stretch of a channel (n,)."""
    return longest_run(np.isfinite(y))


def finite_pieces(y: Array) -> Iterator[Array]:
    """The finite samples of a channel (n,) in double precision, some at a time."""
    for first in range(0, len(y), PIECE_ROWS):
        part = np.asarray(y[first : first + PIECE_ROWS], np.float64)
        there = np.isfinite(part)
        yield part if there.all() else part[there]


def segment_starts(there: NDArray[np.bool_], samples: int, most: int) -> Iterator[NDArray[np.intp]]:
    """First rows of segments that overlap by half, some at a time; of more than `most` every second, third ... one.

    there : (n,) whether a sample is there; no segment has one that is not.
    """
    step = max(samples // 2, 1)
    starts = [np.arange(first, stop - samples + 1, step) for first, stop in true_runs(there)]
    every = np.concatenate(starts) if starts else np.zeros(0, np.intp)
    every = every[:: max(1, -(-every.size // most))]
    group = max(1, PIECE_ROWS // samples)
    for at in range(0, every.size, group):
        yield every[at : at + group]


def segments(y: Array, starts: NDArray[np.intp], samples: int) -> Array:
    """(starts, samples) segments of a channel (n,) in double precision, each less its mean."""
    z: Array = np.stack([y[k : k + samples] for k in starts]).astype(np.float64, copy=False)
    return np.asarray(z - z.mean(axis=1, keepdims=True))


def power_spectrum(
    y: Array, rate_hz: float, samples: int, scale: float = 1.0, dtype: DTypeLike = np.float64
) -> tuple[Array, Array, int]:
    """Averaged one-sided PSD of a channel over its finite stretches of at least so many samples.

    Parameters
    ----------
    y : (n,) float64 or float32
        Samples; NaN where one is missing.
    rate_hz : float
        Sampling rate, Hz.
    samples : int
        Length of a segment; segments have a Hann window, and overlap by half. A long record gives every second of
        them, or fewer.
    scale : float
        By which the samples are divided.
    dtype : dtype
        Precision of the transforms. Single precision has an error of -130 dB of the level of the channel.

    Returns
    -------
    tuple of (f,) float64, (f,) float64, int
        Frequencies in Hz, PSD in the squared unit of `y` over `scale` per Hz (zero without a segment), and
        number of segments.
    """
    window = np.hanning(samples + 1)[:-1] / scale
    total, count = np.zeros(samples // 2 + 1), 0
    for starts in segment_starts(np.isfinite(y), samples, RECORD_LIMITS.max_summary_segments):
        transform = rfft((segments(y, starts, samples) * window).astype(dtype, copy=False), axis=1)
        total += np.sum(transform.real**2 + transform.imag**2, axis=0)
        count += starts.size
    total *= 2.0 / (rate_hz * max(np.sum((scale * window) ** 2), 1.0) * max(count, 1))
    return np.asarray(np.fft.rfftfreq(samples, 1.0 / rate_hz)), total, count


def usable_hz(recorder: AntiAlias | None, rate_hz: float) -> float:
    """Frequency in Hz up to which a level is known: the filter passes 80 % of it, and nothing is aliased.

    recorder : the filter of the rig file. None: not known, and the rate over 2.56 is taken.
    """
    if recorder is None:
        return rate_hz / RECORD_LIMITS.rate_per_passed_hz
    f: Array = np.linspace(0.0, 0.5 * rate_hz, 2000)
    beyond = np.flatnonzero(np.abs(recorder.response(f, rate_hz)) < RECORD_LIMITS.min_passed_amplitude)
    return min(float(f[beyond[0]]) if beyond.size else 0.5 * rate_hz, recorder.trusted_to_hz(rate_hz))


def velocity_rms(y: Array, kind: str, rate_hz: float, reach_hz: float, scale: float = 1.0) -> float | None:
    """Velocity from 10 to 1000 Hz in m/s rms; None for other kinds, and for too short or too narrow records.

    y : (n,) m/s^2 or m/s. reach_hz : up to which a level is known. scale : size of the samples: powers of numbers about
    1 neither overflow nor vanish.
    """
    if kind not in ("acceleration", "velocity") or reach_hz < RECORD_LIMITS.iso_band_hz[1]:
        return None
    longest = longest_stretch(y)
    if longest < RECORD_LIMITS.min_stretch_s * rate_hz:
        return None
    f, psd, _ = power_spectrum(y, rate_hz, int(min(longest, RECORD_LIMITS.segment_s * rate_hz)), scale, np.float32)
    inside = (f >= RECORD_LIMITS.iso_band_hz[0]) & (f <= RECORD_LIMITS.iso_band_hz[1])
    order = 2.0 if kind == "acceleration" else 0.0
    power = psd[inside] / (2.0 * np.pi * f[inside]) ** order
    return float(np.sqrt(np.sum(power) * (f[1] - f[0]))) * scale


@dataclass(frozen=True, slots=True, kw_only=True)
class Moments:
    """Number, extremes, mean, standard deviation, kurtosis and crest factor of the finite samples of a channel.

    The crest factor is 0 where only rounding moves.
    """

    count: int
    low: float
    high: float
    mean: float
    sd: float
    kurtosis: float = 0.0
    crest: float = 0.0

    @property
    def span(self) -> float:
        """Largest less smallest sample."""
        return self.high - self.low


def moments(y: Array) -> Moments:
    """Moments of the finite samples of a channel (n,); zero where there are none."""
    count, low, high = 0, np.inf, -np.inf
    for z in finite_pieces(y):
        count += z.size
        if z.size:
            low, high = min(low, float(z.min())), max(high, float(z.max()))
    if not count:
        return Moments(count=0, low=0.0, high=0.0, mean=0.0, sd=0.0)
    scale = max(high, -low) or 1.0  # powers neither overflow nor vanish
    mean = sum(float((z / scale).sum()) for z in finite_pieces(y)) / count
    second = fourth = 0.0
    for z in finite_pieces(y):
        square = (z / scale - mean) ** 2
        second += float(square.sum())
        fourth += float(square @ square)
    power = second / count
    sd = float(np.sqrt(power))
    own = Moments(count=count, low=low, high=high, mean=mean * scale, sd=sd * scale)
    if sd < 1e-12:  # rounding of the mean of a constant
        return own
    peak = max(high / scale - mean, mean - low / scale)
    return replace(own, kurtosis=fourth / count / power**2, crest=peak / sd)


def summarise(y: Array, kind: str, rate_hz: float, reach_hz: float, m: Moments) -> ChannelSummary:
    """Summary of a channel.

    Parameters
    ----------
    y : (n,) float64 or float32
        Samples in SI units; NaN where a sample is missing.
    kind : str
        Kind of the channel, such as "acceleration".
    rate_hz : float
        Sampling rate, Hz.
    reach_hz : float
        Frequency up to which a level is known, Hz.
    m : Moments
        Of these samples.
    """
    if not m.count:
        return ChannelSummary()
    if not m.crest:
        return ChannelSummary(rms=0.0, peak=0.0)
    velocity = velocity_rms(y, kind, rate_hz, reach_hz, max(m.high, -m.low))
    return ChannelSummary(
        rms=m.sd,
        peak=max(m.high - m.mean, m.mean - m.low),
        crest=m.crest,
        kurtosis=m.kurtosis,
        velocity_rms_mm_s=None if velocity is None else 1e3 * velocity,
    )
