"""Reduces a fast signal for the viewer: envelopes, spectra, orbits. Plain arrays in, plain arrays out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
INTEGRATIONS_TO_DISPLACEMENT = {"acceleration": 2, "velocity": 1, "displacement": 0}


def envelope(index: int, counts: NDArray[np.int32], width: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Minimum and maximum of every bin of `width` samples, as two rows a bin: (2 bins,) indices, (2 bins, channels).

    Bins lie on multiples of `width` in absolute index; a partial bin at either end is a separate bin. With
    width 1 the samples come back as they are.
    """
    n = len(counts)
    if width <= 1:
        return np.arange(index, index + n), counts
    starts = np.unique(np.r_[0, np.arange(-index % width, n, width)])
    rows = np.empty((2 * len(starts), counts.shape[1]), counts.dtype)
    rows[0::2] = np.minimum.reduceat(counts, starts, axis=0)
    rows[1::2] = np.maximum.reduceat(counts, starts, axis=0)
    lengths = np.diff(np.r_[starts, n])
    at = np.empty(2 * len(starts), np.int64)
    at[0::2] = index + starts
    at[1::2] = index + starts + np.maximum(lengths // 2, np.minimum(lengths - 1, 1))
    return at, rows


def spectrum(y: Array, rate_hz: float, points: int = 400) -> tuple[Array, Array] | None:
    """One-sided PSD by Welch's method: (m,) Hz, (m, channels) unit^2/Hz; None if no whole segment is there.

    Hann windows of an eighth of `y`, half overlapped; segments with a NaN are left out. The mean is weighted by the
    window: the plain mean of a cut oscillation would return as power at the first line. Above the first lines,
    neighbours are averaged on a logarithmic grid to about `points`.
    """
    length = 1 << max(4, int(np.log2(max(len(y), 16) / 6)))
    starts = np.arange(0, len(y) - length + 1, length // 2)
    if not starts.size:
        return None
    window = np.hanning(length + 1)[:length]
    segments = np.lib.stride_tricks.sliding_window_view(y, length, axis=0)[starts]  # (segments, channels, length)
    segments = segments[np.isfinite(segments).all(axis=(1, 2))]
    if not len(segments):
        return None
    segments = segments - np.average(segments, axis=2, weights=window, keepdims=True)
    power = (np.abs(np.fft.rfft(segments * window, axis=2)) ** 2).mean(axis=0).T
    power *= 2.0 / (rate_hz * (window**2).sum())
    frequency = np.fft.rfftfreq(length, 1 / rate_hz)[1:-1]
    power = power[1:-1]
    edges = np.unique(np.geomspace(1, len(frequency), points).astype(int)) - 1
    sizes = np.diff(np.r_[edges, len(frequency)])[:, None]
    return np.add.reduceat(frequency, edges) / sizes[:, 0], np.add.reduceat(power, edges, axis=0) / sizes


def displacement(y: Array, kind: str, rate_hz: float, band: tuple[float, float]) -> Array:
    """Displacement in the analysis band, (n, channels) in m, of measured acceleration, velocity or displacement.

    By Fourier transform of the tapered record: for the eye, not for the estimator (its filter is causal). The
    first and last eighth suffer from the taper: leave them out.
    """
    n = len(y)
    ramp = np.arange(n) / max(n / 8, 1)
    taper = np.sin(np.pi / 2 * np.clip(np.minimum(ramp, ramp[::-1]), 0, 1)) ** 2
    frequency = np.fft.rfftfreq(n, 1 / rate_hz)
    inside = (frequency >= band[0]) & (frequency <= band[1]) & (frequency > 0)
    gain = np.zeros(len(frequency), complex)
    gain[inside] = (2j * np.pi * frequency[inside]) ** -INTEGRATIONS_TO_DISPLACEMENT[kind]
    centred = (y - y.mean(axis=0)) * taper[:, None]
    out: Array = np.fft.irfft(np.fft.rfft(centred, axis=0) * gain[:, None], n, axis=0)
    return out
