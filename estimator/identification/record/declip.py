"""What a limiter took from a channel, restored: the samples at its ceiling are known to be at least that, and the rest
of the channel says how far beyond they lie.

The channel without its ceiling is taken as Gaussian with the spectrum that an autoregression gives it. Each run of
samples at the ceiling is drawn from what it is likely to be between its neighbours, beyond the ceiling, in turn until
the draws have forgotten where they began (Gibbs sampling of censored data; Tanner & Wong, J. Am. Stat. Assoc. 82, 1987,
528). A draw, not the mean: the power is right. Crests that a strong cubic makes higher than that come out 5 % low. The
spectrum follows from the restored channel. Leaving such samples out instead leaves nothing of a record: a tenth of a
per cent of them stand in every second of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.model.rig import MOTION, Model

from .censored import axes, runs, sweep
from .clipping import clipping_level, extreme_pileups

AR_ORDER = 64  # of the autoregression, and how far a sample depends on others
SPECTRUM_ROUNDS, SWEEPS_PER_SPECTRUM = 3, 8  # spectra in turn with the samples; draws of every sample with one spectrum
SPECTRUM_SAMPLES = 1 << 19  # samples, for the spectrum
MAX_CLIPPED_SHARE = 0.15  # of the samples of a channel, that are restored
RESTORED_MESSAGE = (
    "the sensor clips: the clipped samples are reconstructed from their neighbours; a larger range is better"
)
# reasons why a parameter is not identifiable, at this cap or at the other one of a coupling shaft
SPOILED_MESSAGE = "a sensor clips, here or at the other end of the shaft, and the clipped samples cannot be restored"
LOST_MESSAGE = "the sensor clips, and the clipped samples cannot be restored: use a larger range"


def restore_clipped(model: Model, y: Array, places: frozenset[str]) -> tuple[Array, dict[str, float]]:
    """The record (n, channels), SI, with the motion channels at these places beyond their ceilings, itself if nothing
    is to be restored; and by place how far off that is, rms over that of the channel: inf where something was taken
    that cannot be restored. The same draws for the same record."""
    out, off = y, {}
    for k, channel in enumerate(model.channels):
        if channel.place not in places or channel.kind not in MOTION:
            continue
        low, high = ceilings(y[:, k])
        at = (y[:, k] <= low) | (y[:, k] >= high)
        if at.any() and at.mean() < MAX_CLIPPED_SHARE:
            out = y.copy() if out is y else out
            out[:, k], error = _beyond(y[:, k], at, low, high, np.random.default_rng(k))
            off[channel.place] = error / float(np.nanstd(out[:, k]))
        elif at.any() or clipping_level(y[:, k]) is not None:
            off[channel.place] = np.inf
    return out, off


def _beyond(y: Array, at: NDArray[np.bool_], low: float, high: float, rng: np.random.Generator) -> tuple[Array, float]:
    """(n,) the channel with its samples at the ceilings drawn beyond them; and the rms by which that is off, as draws
    differ from each other as they do from what was there."""
    there = np.isfinite(y)
    middle = float(np.mean(y[there]))
    z = np.where(there, y - middle, 0.0)
    inner = np.flatnonzero(at)
    inner = inner[(inner >= AR_ORDER) & (inner < y.size - AR_ORDER)]
    sides = np.where(y[inner] >= high, 1.0, -1.0)
    limits = np.where(sides > 0, high, -low) - sides * middle
    begins = runs(inner, sides)
    before = z
    for turn in range(SPECTRUM_ROUNDS + 1):
        if turn < SPECTRUM_ROUNDS:
            precision = _precision(z)
            own = axes(precision)
        else:  # another draw by the last spectrum
            before = z.copy()
        for _ in range(SWEEPS_PER_SPECTRUM):
            sweep(z, inner, begins, sides, limits, precision, own, rng)
    out = y.copy()
    out[inner] = sides * np.maximum(sides * (z[inner] + middle), np.where(sides > 0, high, -low))  # but for rounding
    return out, float(np.sqrt(0.5 * np.mean((z - before) ** 2)))


def _precision(z: Array) -> Array:
    """(ORDER + 1,) inverse covariance of the samples, by lag."""
    from scipy.linalg import solve_toeplitz

    part = z[:SPECTRUM_SAMPLES]
    power = np.abs(np.fft.rfft(part, 2 * part.size)) ** 2
    r = np.fft.irfft(power)[: AR_ORDER + 1] / part.size
    a = np.append(1.0, -solve_toeplitz(r[:-1], r[1:]))
    return np.asarray(np.correlate(a, a, "full")[AR_ORDER:] / (a @ r))


def ceilings(y: Array) -> tuple[float, float]:
    """Values below and above which a channel does not go, as many samples have them and none has more: -inf, inf where
    its extremes thin out, or where noise came after the limiter."""
    low, high = np.nanmin(y), np.nanmax(y)
    top, bottom = extreme_pileups(y, low, high)
    return (-np.inf if bottom is None else -bottom[0]), (np.inf if top is None else top[0])
