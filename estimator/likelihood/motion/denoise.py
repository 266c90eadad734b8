"""Wiener filter of a displacement that is integrated from noisy measurements.

Noise e in the displacement biases a nonlinear law: a cubic of x + e is too weak by twice the share of e^2 in x^2. White
noise of an accelerometer is 1 / w^4 in the displacement and dominates at the lower band edge. Laws are therefore
evaluated on E[x | measured], the Wiener filter with the measured spectrum, and smoothed over the remaining error
(regression calibration). The linear regressors and the mean tangent of a law keep the measured displacement, as the
likelihood accounts for the noise in them. Displacement sensors are not filtered: their noise is strong above the
resonance, where the filter would remove the third harmonic; the Gram matrices are corrected for it instead.

References
----------
Carroll et al., Measurement Error in Nonlinear Models, 2nd ed., 2006, ch. 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.likelihood.thresholds import LIMITS
from estimator.parallel import map_threads
from estimator.signals.band_limit import noise_shape

from .linear_memory import filtered_series


@dataclass(frozen=True, slots=True)
class DenoisingFilter:
    """Wiener filter of the displacement at every place.

    f_hz : (f,) Hz. less : (places, f) gain of the filter less 1, from -1 (noise only) to 0 (motion only).
    doubt : (places, 2) sd of displacement, m, and velocity, m/s, that remains.
    """

    f_hz: Array
    less: Array
    doubt: Array

    def of(self, x: NDArray[np.floating], rate_hz: float) -> Array:
        """(places, n) m, correction to add to x (places, n); its ends are less exact."""
        w = 2 * np.pi * self.f_hz

        def one(i: int) -> Array:
            return filtered_series(lambda at: np.interp(at, w, self.less[i]).astype(x.dtype), x[i], rate_hz)

        return np.array(map_threads(one, range(len(x))))


def noise_displacement_psd(kinds: Sequence[str], f_hz: Array, noise: Array) -> Array:
    """(places, f) m^2/Hz, one-sided PSD of integrated sensor noise; 0 for displacement sensors.

    noise : (places,) PSD of white noise in the unit of each sensor.
    """
    w = 2 * np.pi * f_hz
    integrated = np.array([kind != "displacement" for kind in kinds])
    return np.asarray(noise_shape(kinds, w) / w**4 * (noise * integrated)[:, None])


def noise_is_negligible(f_hz: Array, e: Array, x2: Array) -> bool:
    """Whether noise e, (places, f) m^2/Hz, is small against the mean square displacement x2, (places,) m^2."""
    return bool((e @ np.gradient(f_hz) <= LIMITS.max_noise_power_share * x2).all())


def denoising_filter(f_hz: Array, seen: Array, e: Array) -> DenoisingFilter:
    """Wiener filter from the spectra of measured displacement and noise.

    f_hz : (f,) Hz, of the band, evenly spaced but for gaps. seen, e : (places, f) m^2/Hz, one-sided PSDs of the
    measured displacement and of the noise in it.
    """
    df, w = np.gradient(f_hz), 2 * np.pi * f_hz
    gain = np.clip(1.0 - e / np.maximum(_smooth(seen), e), 0.0, 1.0)
    lost = seen * gain * (1.0 - gain)
    doubt = np.sqrt(np.stack([lost @ df, lost @ (df * w**2)], axis=1))
    return DenoisingFilter(f_hz, gain - 1.0, doubt)


def restore_mean_tangent(
    force: NDArray[np.floating], mean: Array, correction: NDArray[np.floating], own: int, other: int
) -> None:
    """Change a law's force (n,) N on denoised motion in place: its mean tangent acts on the measured displacement.

    mean : (4,) mean tangents along x, v, xo, vo. correction : (places, n) m, of the denoising. own, other : places of
    the law and of its other direction (-1: not measured).
    """
    force -= mean[0] * correction[own]
    if other >= 0 and mean[2] != 0.0:
        force -= mean[2] * correction[other]


def _smooth(power: Array) -> Array:
    """Means of WIDTH neighbours, (places, f)."""
    count = np.convolve(np.ones(power.shape[1]), np.ones(LIMITS.smoothing_bins), "same")
    return np.array([np.convolve(z, np.ones(LIMITS.smoothing_bins), "same") / count for z in power])
