"""What laws see of a displacement that is integrated from noisy measurements: of each frequency as much as is likely
to be motion.

A law of x + e is bent: a cubic comes out weak by twice the share of e^2 in x^2. White noise of an accelerometer is
1 / w^4 in the displacement, and rules it at the lower edge of the band. So laws see E[x | measured], by Wiener's filter
with the spectrum as measured, and are smoothed by what is then in doubt (the mean of the law, given the measurement:
regression calibration, Carroll et al., Measurement Error in Nonlinear Models, 2006, ch. 4). The linear terms keep the
displacement as it is, as the likelihood knows the noise in it, and so does the mean tangent of a law. Noise of sensors
of displacement is strong above the resonance, where the filter would take the third harmonic, which the motion tells,
for noise: `fit` takes it out of the Gram matrices instead (dressing.flutter).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.parallel import map_threads
from estimator.signals.band_limit import noise_shape

from .linear_memory import filtered_series

MAX_NOISE_POWER_SHARE = 5e-4  # of the displacement; noise below it biases a cubic by at most twice as much
SMOOTHING_BINS = 7  # over which the spectrum of the motion is smooth


@dataclass(frozen=True, slots=True)
class DenoisingFilter:
    """f_hz : (f,). less : (places, f) what a law sees of x beside x itself, -1 (nothing of it) to 0 (all).

    doubt : (places, 2) sd of the displacement and velocity that are then in doubt. reach : rows on either side that
    what is seen of one depends on.
    """

    f_hz: Array
    less: Array
    doubt: Array
    reach: int

    def of(self, x: NDArray[np.floating], rate_hz: float) -> Array:
        """(places, n) what laws see beside x (places, n), sound but for `reach` rows at either end; as precise as x."""
        w = 2 * np.pi * self.f_hz

        def one(i: int) -> Array:
            return filtered_series(lambda at: np.interp(at, w, self.less[i]).astype(x.dtype), x[i], rate_hz)

        return np.array(map_threads(one, range(len(x))))


def noise_displacement_psd(kinds: Sequence[str], f_hz: Array, noise: Array) -> Array:
    """(places, f) one-sided PSD in m^2/Hz of what white noise, (places,) in the unit of each sensor, integrates to; 0
    for sensors of displacement."""
    w = 2 * np.pi * f_hz
    integrated = np.array([kind != "displacement" for kind in kinds])
    return np.asarray(noise_shape(kinds, w) / w**4 * (noise * integrated)[:, None])


def noise_is_negligible(f_hz: Array, e: Array, x2: Array) -> bool:
    """Whether noise e, (places, f) m^2/Hz, is little beside the displacement, x2 (places,) m^2, everywhere."""
    return bool((e @ np.gradient(f_hz) <= MAX_NOISE_POWER_SHARE * x2).all())


def denoising_filter(f_hz: Array, seen: Array, e: Array, reach: int) -> DenoisingFilter:
    """f_hz : (f,) of the band, evenly spaced but for what is left out. seen, e : (places, f) one-sided PSDs in m^2/Hz
    of the displacement as measured and of what in it is noise."""
    df, w = np.gradient(f_hz), 2 * np.pi * f_hz
    gain = np.clip(1.0 - e / np.maximum(_smooth(seen), e), 0.0, 1.0)
    lost = seen * gain * (1.0 - gain)
    doubt = np.sqrt(np.stack([lost @ df, lost @ (df * w**2)], axis=1))
    return DenoisingFilter(f_hz, gain - 1.0, doubt, reach)


def restore_mean_tangent(
    force: NDArray[np.floating], mean: Array, calm: NDArray[np.floating], own: int, other: int
) -> None:
    """Of a law's force (n,) on what it sees, made in place: its mean tangent is of the whole displacement.

    mean : (4,) tangents along x, v and those of the other direction. calm : (places, n). other : -1 where none is.
    """
    force -= mean[0] * calm[own]
    if other >= 0 and mean[2] != 0.0:
        force -= mean[2] * calm[other]


def _smooth(power: Array) -> Array:
    """Means of WIDTH neighbours, (places, f)."""
    count = np.convolve(np.ones(power.shape[1]), np.ones(SMOOTHING_BINS), "same")
    return np.array([np.convolve(z, np.ones(SMOOTHING_BINS), "same") / count for z in power])
