"""Averaged power spectra of one channel at several resolutions, with the noise about each bin.

A speed that wanders spreads a line: at a coarse resolution the line is narrow again. A resonance is narrow at a coarse
resolution too; the pieces tell it from a line, as the power of a line is steady from piece to piece and the power of
noise is exponentially distributed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import fdtrc, gammaincinv

from estimator.arrays import Array
from estimator.parallel import map_threads
from estimator.signals.line_spectrum import hann_spectrum

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
        Power of the noise about the bin; a lower bound where the power is less than `LIMITS.least_ratio` times that.
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


def level_spectra(pieces: Pieces) -> list[LevelSpectrum]:
    """Spectra of a channel, the finest resolution first."""
    sizes: list[int] = []
    size = pieces.size
    least = max(LIMITS.min_level_rows, int(LIMITS.min_level_s * pieces.rate_hz))
    while size >= least or (size and not sizes):
        sizes.append(size)
        size //= LIMITS.coarser_by
    if not len(pieces):
        return []
    sums = [_LevelSum(size, several=len(pieces) * pieces.size >= 2 * size) for size in sizes]
    for group in pieces.groups():
        largest = max(float(group.max()), -float(group.min())) or 1.0
        rows = (group / largest).astype(np.float32)  # a sample of 24 bits is exact
        for own in sums:
            own.add(rows, largest)
    return [own.spectrum(pieces.rate_hz) for own in sums]


def channel_spectra(y: Array, rate_hz: float, columns: Mapping[str, int]) -> dict[str, list[LevelSpectrum]]:
    """Channel -> its spectra; a channel without a run of samples that is long enough is absent.

    y : (n, channels), SI. columns : channel -> its column.
    """
    found = map_threads(lambda i: level_spectra(Pieces(y[:, i], rate_hz)), columns.values())
    return {name: levels for name, levels in zip(columns, found, strict=True) if levels}


def order_spectra(y: Array, rate_hz: float, columns: Mapping[str, int], angle: Array) -> dict[str, list[LevelSpectrum]]:
    """Channel -> its spectra over equal steps of the shaft angle, in Hz at the mean speed.

    angle : (n,) rad along the record. The steps are straight between samples: right for orders far below half the rate.
    """
    rows = np.arange(angle.size)
    at = np.interp(np.linspace(angle[0], angle[-1], angle.size), angle, rows)

    def turned(i: int) -> list[LevelSpectrum]:
        return level_spectra(Pieces(np.interp(at, rows, y[:, i]).astype(np.float32), rate_hz))

    return {name: levels for name, i in columns.items() if (levels := turned(i))}


class _LevelSum:
    """Sums over the pieces of a channel at one resolution.

    Parameters
    ----------
    size : int
        Rows of a piece.
    several : bool
        Whether there is more than one piece: one says nothing of scatter.
    """

    def __init__(self, size: int, several: bool) -> None:
        self._size = size
        self._count = 0
        self._power = np.zeros(size // 2 + 1)
        self._logs = np.zeros(size // 2 + 1) if several else None

    def add(self, rows: NDArray[np.float32], largest: float) -> None:
        """Add some longer pieces (pieces, rows), which are over their largest value."""
        W = hann_spectrum(rows[:, : rows.shape[1] // self._size * self._size].reshape(-1, self._size))
        P = W.real**2 + W.imag**2
        self._power += P.sum(axis=0, dtype=np.float64) * largest**2
        if self._logs is not None:
            logs = np.log(np.maximum(P, LIMITS.least_power))
            self._logs += logs.sum(axis=0, dtype=np.float64) + 2.0 * len(P) * np.log(largest)
        self._count += len(P)

    def spectrum(self, rate_hz: float) -> LevelSpectrum:
        """The average. rate_hz : rows per second."""
        power = np.maximum(self._power / self._count, 1e-300)
        return LevelSpectrum(
            seconds=self._size / rate_hz,
            count=self._count,
            power=power,
            noise=local_noise(power, self._count),
            mean_log=None if self._logs is None else self._logs / self._count,
        )


def local_noise(power: Array, count: float, compared: Array | None = None) -> Array:
    """(bins,) noise about each bin: the larger of the mean of its near neighbours and the median further about it.

    The median is asked where what is compared stands out of that mean. Elsewhere it decides nothing.

    count : of spectra whose average the power is. compared : (bins,) largest power that is compared with the noise
    about a bin; None: the power itself.
    """
    wide, inner, reach = 2 * LIMITS.near_reach_bins + 1, 2 * LIMITS.near_bins - 1, LIMITS.far_reach_bins
    about, own = (uniform_filter1d(power, width, mode="nearest") * width for width in (wide, inner))
    noise = np.maximum((about - own) / (wide - inner), 1e-300)
    high = np.flatnonzero((power if compared is None else compared) > LIMITS.least_ratio * noise)
    near = sliding_window_view(np.pad(power, reach, mode="edge"), 2 * reach + 1)[high]
    near.partition(reach, axis=1)
    noise[high] = np.maximum(noise[high], near[:, reach] * (count / gammaincinv(count, 0.5)))
    return noise
