"""Spectra of the squared envelope of one channel in a bank of bands.

The channel is whitened first, so that each frequency counts by its signal-to-noise ratio and not by the resonances
that it passes, and tones are bounded, so that two of them make no line at their difference. A line of the squared
envelope at a is a sum of X(f + a) X*(f) over the band; of noise, whose phases are independent, it has the mean power
sum |X(f + a)|^2 |X(f)|^2 and an exponential distribution, whatever the spectrum of the channel: a comb of narrow-band
noises is no strike train. This is the mean over all surrogates with random phases.

References
----------
Antoni, The spectral kurtosis, Mech. Syst. Signal Process. 20(2), 2006, 282-307 (bank of bands). Randall and Antoni,
Rolling element bearing diagnostics - a tutorial, Mech. Syst. Signal Process. 25(2), 2011, 485-520.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import ifft, irfft, next_fast_len, rfft
from scipy.ndimage import uniform_filter1d

from estimator.arrays import Array, Series

from .pieces import Pieces
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvelopeSpectrum:
    """Spectrum of the squared envelope in one band.

    Parameters
    ----------
    band_hz : (float, float)
        Lower and upper edge, Hz.
    seconds : float
        Length of a piece; bin k is at k / seconds Hz.
    count : int
        Pieces.
    power : (bins,) float64
        Squared peak amplitude of a line of the squared envelope over the mean of the squared envelope, averaged over
        the pieces: the square of a depth of modulation.
    random : (bins,) float64
        Mean of `power` under independent phases.
    """

    band_hz: tuple[float, float]
    seconds: float
    count: int
    power: Array
    random: Array


def envelope_spectra(
    pieces: Pieces,
    highest_hz: float,
    level_s: float,
    bank: tuple[int, ...] = LIMITS.bands_per_rate,
    angle: Array | None = None,
) -> list[EnvelopeSpectrum]:
    """Spectra of the squared envelope up to a frequency in every band of a bank.

    pieces : of one channel. level_s : time over which the level is made equal, longer than any period of interest.
    bank : numbers of equal bands that share the range up to half the rate. angle : (n,) rad of the shaft along the
    record, with which the envelope is taken at equal steps of the angle, in Hz at the mean speed; None: against time.
    """
    if not len(pieces):
        return []
    gain = _whitening(pieces)
    tiers = _tiers(pieces, highest_hz, bank)
    sums = [
        (np.zeros((parts, min(int(highest_hz * pieces.seconds), width) + 1)), np.zeros((parts, width), np.float32))
        for parts, width in tiers
    ]
    first = 0
    for group in _spectra(pieces):
        steps = _steps(pieces, range(first, first + len(group)), angle)
        first += len(group)
        white = irfft(group * gain, pieces.size, axis=1)
        X: NDArray[Any] = rfft(_at_one_level(white, int(level_s * pieces.rate_hz)), axis=1)
        for lines, band in sums:
            own = X[:, 1 : band.size + 1].reshape(len(X), *band.shape)
            own_lines, own_band = _squared_envelope_power(own, lines.shape[1], steps)
            lines += own_lines
            band += own_band
    return [
        EnvelopeSpectrum(
            band_hz=((1 + k * width) / pieces.seconds, (1 + (k + 1) * width) / pieces.seconds),
            seconds=pieces.seconds,
            count=len(pieces),
            power=power / len(pieces),
            random=random,
        )
        for (_, width), (lines, band) in zip(tiers, sums, strict=True)
        for k, (power, random) in enumerate(zip(lines, _random_power(band / len(pieces), lines.shape[1]), strict=True))
    ]


def _spectra(pieces: Pieces) -> Iterator[NDArray[Any]]:
    """Spectra of groups of pieces, (pieces, bins)."""
    return (rfft(group.astype(np.float32), axis=1) for group in pieces.groups())


def _tiers(pieces: Pieces, highest_hz: float, bank: tuple[int, ...]) -> list[tuple[int, int]]:
    """Number and width (bins) of the bands of each tier, from bin 1; a narrower band would smear a fast train."""
    top = int(LIMITS.top_of_nyquist * 0.5 * pieces.size)
    tiers = [(parts, (top - 1) // parts) for parts in bank]
    least = LIMITS.min_band_over_highest * highest_hz * pieces.seconds
    return [(parts, width) for parts, width in tiers if parts == 1 or width >= least]


def _steps(pieces: Pieces, numbers: range, angle: Array | None) -> list[Array]:
    """By piece: when the shaft is at equal steps of its angle, as shares of the piece; none against time."""
    if angle is None:
        return []
    step = (angle[-1] - angle[0]) / (angle.size - 1)
    rows = np.arange(0, pieces.size, max(1, pieces.size // LIMITS.angle_points))
    out = []
    for start in (pieces.starts[i] for i in numbers):
        own = angle[start + rows]
        out.append(np.interp(own[0] + step * rows, own, rows) / pieces.size)
    return out


def _squared_envelope_power(X: NDArray[Any], bins: int, steps: Sequence[Array]) -> tuple[Array, Array]:
    """(bands, bins) squared amplitudes of the lines of the squared envelope of each band, and (bands, width) its power.

    Both are sums over pieces, over the squared mean of the squared envelope and over that mean; under a Hann window.

    X : (pieces, bands, width). steps : by piece, as of `_steps`. The envelope is interpolated and not the samples: its
    mean does not depend on the place between two rows.
    """
    n = _transform_size(X.shape[-1], bins)
    z = ifft(X, n)
    P = X.real**2 + X.imag**2
    mean = np.maximum(P.sum(axis=-1, keepdims=True), LIMITS.least_power) / n  # n times that of the squared envelope
    envelope = z.real**2
    envelope += z.imag**2
    for rows, at in zip(envelope, steps, strict=bool(steps)):
        share = np.interp(np.arange(n) / n, np.arange(at.size) / at.size, at)
        for row in rows:
            row[:] = np.interp(share * n, np.arange(n), row)
    envelope /= mean / n
    S = rfft(envelope)[..., : bins + 1]
    S[..., 0] = 0.0
    windowed = 0.5 * S[..., :bins] - 0.25 * (_before(S)[..., :bins] + S[..., 1:])
    power = windowed.real.astype(np.float64) ** 2 + windowed.imag.astype(np.float64) ** 2
    return power.sum(axis=0) * (4.0 / n) ** 2, (P / mean).sum(axis=0)


def _random_power(P: NDArray[Any], bins: int) -> Array:
    """(bands, bins) mean of the squared amplitudes of the lines of the squared envelope under random phases.

    P : (bands, width) mean over the pieces of the power of a bin, over n times the mean of the squared envelope.
    """
    n = _transform_size(P.shape[1], bins)
    products = rfft(P, n)
    R = irfft(products.real**2 + products.imag**2, n)[:, : bins + 1].astype(np.float64)
    random = 0.25 * R[:, :bins] + 0.0625 * (_before(R)[:, :bins] + R[:, 1:])
    return np.asarray(random * (4.0 / n) ** 2)


def _transform_size(band: int, bins: int) -> int:
    """Length of a transform of a band of some bins that holds lags up to `bins` without wrapping."""
    return int(next_fast_len(max(band + bins, 2 * bins), real=True))


def _before(lags: NDArray[Any]) -> NDArray[Any]:
    """(..., k) values of a function of the lag, conjugate-even about 0, at one lag before each."""
    return np.concatenate([lags[..., 1:2].conj(), lags[..., :-1]], axis=-1)


def _at_one_level(x: Series, rows: int) -> Series:
    """(pieces, size) samples over their level, smoothed over some rows: a level that changes is no strike train."""
    rows = max(3, min(rows, x.shape[1] // 4))
    level = uniform_filter1d(uniform_filter1d(x**2, rows, axis=1, mode="nearest"), rows, axis=1, mode="nearest")
    least = 1e-3 * level.mean(axis=1, keepdims=True) + LIMITS.least_power
    return np.asarray(x / np.sqrt(np.maximum(level, least)))


def _whitening(pieces: Pieces) -> NDArray[np.float32]:
    """(bins,) factors that bring the noise in the spectrum of a piece to 1 and bound the lines."""
    power = np.zeros(pieces.size // 2 + 1)
    for X in _spectra(pieces):
        power += (X.real**2 + X.imag**2).sum(axis=0)
    power /= len(pieces)
    floor = _floor(power, pieces.seconds)
    bound = max(LIMITS.min_tone_ratio, LIMITS.tone_noise_hz * pieces.seconds) / len(pieces)
    return np.asarray(1.0 / np.sqrt(np.maximum(floor, power / max(1.0, bound))), np.float32)


def _floor(power: Array, seconds: float) -> Array:
    """(bins,) noise in a power spectrum: by medians of blocks, so without lines. seconds : one over a bin's width."""
    block = max(LIMITS.floor_block_bins, int(LIMITS.floor_block_hz * seconds))
    whole = power.size // block * block
    if not whole:
        return np.full(power.size, max(float(np.median(power)), 1e-60))
    median = np.maximum(np.median(power[:whole].reshape(-1, block), axis=1), 1e-60)
    centre = (np.arange(median.size) + 0.5) * block
    return np.asarray(np.exp(np.interp(np.arange(power.size), centre, np.log(median))))
