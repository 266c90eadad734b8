"""Free-run simulation: the fitted model driven by the measured force alone, compared with the measurement.

The force is known as band-limited samples. It is interpolated to the steps of the integration (a zero-order hold of
the samples would cost more than most missing terms), and both sides are compared in the analysis band.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.likelihood.motion.force_balance import force_channels, motion_channels
from estimator.likelihood.motion.known_spectra import fitted_bins
from estimator.likelihood.motion.motion_record import mean_psd
from estimator.likelihood.motion.prepare import valid_starts
from estimator.model.rig import Model
from estimator.signals.band_limited_record import band_limit
from estimator.signals.channel_response import anti_alias_response

from .thresholds import LIMITS


def resampled(z: Array, size: int, shift: float) -> Array:
    """(..., size) band-limited rows of z (..., n), each taken `shift` of an output step later."""
    Z = np.fft.rfft(z, axis=-1)
    n = min(z.shape[-1], size) // 2 + 1
    out = np.zeros((*z.shape[:-1], size // 2 + 1), complex)
    out[..., :n] = Z[..., :n] * np.exp(2j * np.pi * np.arange(n) * shift / size)
    return np.asarray(np.fft.irfft(out, size, axis=-1) * (size / z.shape[-1]))


def free_run(model: Model, force: Array, rate_hz: float, first: int = 0) -> Array:
    """(places, n) motion in the kind that each place's channel measures, from rest, under (places, n) N.

    model : every value given. first : rows of the record before these, for what turns with the time.
    Raises ModelError for an incomplete or unstable model.
    """
    from estimator.simulation.plan import simulation_plan
    from estimator.simulation.shaft_speed import ShaftSpeed
    from estimator.simulation.stepper import Stepper

    channels = tuple(model.channels[c] for c in motion_channels(model))
    plan = simulation_plan(replace(model, channels=channels))
    speed = ShaftSpeed(model.speed_rpm) if model.speed_rpm is not None else None
    stepper = Stepper(plan, 1.0 / (rate_hz * LIMITS.oversample_factor), speed)
    stepper.count = first * LIMITS.oversample_factor
    dofs = [plan.rig.index(p) for p in model.places]
    out = np.empty_like(force)
    pad, chunk = int(0.25 * rate_hz), int(LIMITS.chunk_s * rate_hz)
    n = force.shape[1]
    whole = np.empty((len(channels), n * LIMITS.oversample_factor))
    for a in range(0, n, chunk):
        lo, hi, end = max(a - pad, 0), min(a + chunk + pad, n), min(a + chunk, n)
        fine = resampled(force[:, lo:hi], (hi - lo) * LIMITS.oversample_factor, 0.5)
        part = fine[:, (a - lo) * LIMITS.oversample_factor : (end - lo) * LIMITS.oversample_factor]
        F = np.zeros((part.shape[1], stepper.x.size))
        F[:, dofs] = part.T
        steps = np.empty((len(channels), part.shape[1]))
        stepper.step(F, steps)
        whole[:, a * LIMITS.oversample_factor : end * LIMITS.oversample_factor] = steps
    for a in range(0, n, chunk):
        lo, hi, end = max(a - pad, 0), min(a + chunk + pad, n), min(a + chunk, n)
        part = resampled(
            whole[:, lo * LIMITS.oversample_factor : hi * LIMITS.oversample_factor],
            hi - lo,
            -0.5 / LIMITS.oversample_factor,
        )
        out[:, a:end] = part[:, a - lo : end - lo]
    return out


def simulation_rmse(model: Model, y: Array, rate_hz: float, decay_s: float, first: float = 0.0) -> dict[str, float]:
    """Channel name -> rms in SI of measured minus simulated motion in the band, from the fraction `first` on.

    model : every value given. y : (n, channels), SI, the sensors' responses taken back. decay_s : until free motion is
    down to 1 / e. The bins of the fit count: below the band the disc on its shaft rings on for minutes from where it
    happened to be. Fit on the rows before, and simulate those after, for a held-out figure. Raises DataError without a
    measured force at every place.
    """
    motions, forces = motion_channels(model), force_channels(model)
    P = len(motions)
    if len(forces) < P:
        raise DataError("a free run needs a measured force at every place: add channels of kind force")
    lead = int(LIMITS.settle_decay_times * decay_s * rate_hz)
    start = max(int(first * len(y)) - lead, 0)
    used = [*motions, *(forces[i] for i in range(P))]
    kinds = [model.channels[c].kind for c in used]
    measured = band_limit(y[start:, used], kinds, rate_hz, model.band, undone=anti_alias_response(model, rate_hz))
    force = np.where(measured.valid, measured.a[P:], 0.0)
    simulated = band_limit(free_run(model, force, rate_hz, start).T, kinds[:P], rate_hz, model.band)
    good = measured.valid & simulated.valid
    good[:lead] = False
    block = 1 << int(np.ceil(np.log2(LIMITS.block_cycles * rate_hz / model.band[0])))
    half = block // 2  # blocks overlap by half
    starts = np.concatenate([valid_starts(good, block), half + valid_starts(good[half:], block)])
    rows = (starts[:, None] + np.arange(block)).ravel()
    if not rows.size:
        raise DataError(f"the record is too short for a free run of {lead / rate_hz:.1f} s and what is compared after")
    out = {}
    for i, c in enumerate(motions):
        name = {"acceleration": "a", "velocity": "v", "displacement": "x"}[kinds[i]]
        error = getattr(simulated, name)[i] - getattr(measured, name)[i]
        psd = mean_psd(error[rows], block, rate_hz)[1][fitted_bins(model, rate_hz, block)]
        out[model.channels[c].name] = float(np.sqrt(psd.sum() * rate_hz / block))
    return out
