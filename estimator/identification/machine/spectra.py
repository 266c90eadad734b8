"""Averaged power spectra of one channel at several resolutions, with the noise about each bin.

A speed that wanders spreads a line: at a coarse resolution the line is narrow again. A resonance is narrow at a coarse
resolution too; the pieces tell it from a line, as the power of a line is steady from piece to piece and the power of
noise is exponentially distributed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.special import fdtrc, fdtri, gammaincinv

from estimator.arrays import Array
from estimator.parallel import map_threads

from .pieces import Pieces
from .thresholds import LIMITS

EXPONENTIAL_MEAN_LOG = float(np.euler_gamma)  # log of the mean less mean of the log, of exponential variables
EXPONENTIAL_SD_LOG = float(np.sqrt(np.pi**2 / 6 - 1))  # of that difference, times the root of the number of variables


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelSpectrum:
    """Spectrum of one channel at one resolution, averaged over pieces.

    Parameters
    ----------
    seconds : float
        Length of a piece; bin k is at k / seconds Hz.
    count : float
        Pieces; of a spectrum averaged over bins too, independent values in a bin.
    power : (bins,) float64
        Squared peak amplitude of a tone at the bin, averaged over the pieces.
    noise : (bins,) float64
        Power of the noise about the bin.
    mean_log : (bins,) float64 or None
        Mean over the pieces of the logarithm of a piece's power; None of one piece.
    """

    seconds: float
    count: float
    power: Array
    noise: Array
    mean_log: Array | None = None

    def log_p(self, bins: NDArray[np.intp]) -> Array:
        """(k,) natural logarithm of the chance that noise gives the power of some bins; 0 where the power is low."""
        ratio = self.power[bins] / self.noise[bins]
        out = np.zeros(ratio.shape)
        high = ratio > LIMITS.least_ratio
        p = fdtrc(2 * self.count, 2 * self.count * LIMITS.noise_bins, ratio[high])
        out[high] = np.log(np.maximum(p, 1e-300))
        return out

    def is_steady(self, k: int) -> bool:
        """Whether the power of bin k varies less from piece to piece than that of noise, at 3 standard deviations."""
        if self.mean_log is None:
            return False
        spread = np.log(self.power[k]) - self.mean_log[k]
        return bool(spread < EXPONENTIAL_MEAN_LOG - 3.0 * EXPONENTIAL_SD_LOG / np.sqrt(self.count))


@cache
def ratio_at_nats(count: float, nats: float) -> float:
    """Power over noise, a little less than that at which a bin has some nats. count : as of a `LevelSpectrum`."""
    return 0.999 * float(fdtri(2 * count, 2 * count * LIMITS.noise_bins, -np.expm1(-nats)))


def level_spectra(pieces: Pieces) -> list[LevelSpectrum]:
    """Spectra of a channel, the finest resolution first."""
    sizes: list[int] = []
    size = pieces.size
    least = max(LIMITS.min_level_rows, int(LIMITS.min_level_s * pieces.rate_hz))
    while size >= least or (size and not sizes):
        sizes.append(size)
        size //= LIMITS.coarser_by
    return [_level(pieces, size) for size in sizes if len(pieces)]


def channel_spectra(y: Array, rate_hz: float, columns: Mapping[str, int]) -> dict[str, list[LevelSpectrum]]:
    """Channel -> its spectra; a channel without a run of samples that is long enough is absent.

    y : (n, channels), SI. columns : channel -> its column.
    """
    found = map_threads(lambda i: level_spectra(Pieces(y[:, i], rate_hz)), columns.values())
    return {name: levels for name, levels in zip(columns, found, strict=True) if levels}


def _level(pieces: Pieces, size: int) -> LevelSpectrum:
    """The spectrum at one resolution. size : rows of a piece."""
    window = np.hanning(size + 1)[:-1]
    bins = size // 2 + 1
    several = len(pieces) * pieces.size >= 2 * size  # one piece says nothing of scatter
    total, logs, count = np.zeros(bins), np.zeros(bins if several else 0), 0
    for group in pieces.groups():
        cut = group[:, : group.shape[1] // size * size].reshape(-1, size)
        cut -= cut.mean(axis=1, keepdims=True)
        cut *= window
        X = rfft(cut, axis=1)
        P = X.real**2 + X.imag**2
        total += P.sum(axis=0)
        if several:
            logs += np.log(np.maximum(P, 1e-300)).sum(axis=0)
        count += len(P)
    scale = (2.0 / window.sum()) ** 2
    power = np.maximum(total / count * scale, 1e-300)
    return LevelSpectrum(
        seconds=size / pieces.rate_hz,
        count=count,
        power=power,
        noise=local_noise(power, count),
        mean_log=logs / count + np.log(scale) if several else None,
    )


def local_noise(power: Array, count: float) -> Array:
    """(bins,) noise about each bin: the larger of the mean of its near neighbours and the median further about it.

    count : of spectra whose average the power is.
    """
    median = median_filter(power, 2 * LIMITS.far_reach_bins + 1, mode="nearest")
    median *= count / gammaincinv(count, 0.5)
    wide, inner = 2 * LIMITS.near_reach_bins + 1, 2 * LIMITS.near_bins - 1
    about, own = (uniform_filter1d(power, width, mode="nearest") * width for width in (wide, inner))
    return np.maximum(np.maximum((about - own) / (wide - inner), median), 1e-300)
