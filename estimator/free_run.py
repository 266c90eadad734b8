"""Free-run simulation under a measured force: the fitted model driven by the force alone, beside the measurement.

The force is known as band-limited samples. It is interpolated to the steps of the integration (a zero-order hold of
the samples would cost more than most missing terms), and both sides are compared in the analysis band.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .balance import force_channels, motion_channels
from .bandlimit import band_limit
from .effects.custom import effect_of
from .effects.places import at
from .errors import DataError
from .gram import spectra, valid_blocks
from .model import EffectUse, Model, Setting
from .record import Record
from .solution import Solution

Floats = NDArray[np.float64]
OVERSAMPLE = 8
SETTLE = 12.0  # decay times until the start from rest is forgotten
CHUNK_S = 4.0


def fitted_model(solution: Solution) -> Model:
    """The model with every value of a solution filled in, ready for the simulator."""
    model, balance, point, values = solution.record.model, solution.balance, solution.point, solution.values
    linear, mass = {}, dict(model.mass)
    for i, place in enumerate(balance.places):
        given = dict(model.linear.get(place, {}))
        new = {key: Setting(values[f"{place}.{key}"]) for key in ("kL", "c") if f"{place}.{key}" in values}
        linear[place] = given | new | {"S": Setting(float(point.S[i]))}
        if f"{place}.m" in values:
            mass[place] = values[f"{place}.m"]
    shapes = {law.name(j): float(p) for law in balance.laws for j, p in enumerate(law.p)}
    uses = []
    for use in model.effects:
        effect = effect_of(use)
        parameters = {
            key: {
                q.name: Setting(values.get(name, shapes.get(name)))
                for q in effect.parameters
                for name in (f"{key}.{effect.name}.{q.name}",)
            }
            for key in at(effect, use, model)
        }
        uses.append(EffectUse(use.name, parameters, use.custom))
    return replace(model, linear=linear, mass=mass, effects=tuple(uses))


def resampled(z: Floats, size: int, shift: float) -> Floats:
    """(..., size) band-limited rows of z (..., n), each taken `shift` of an output step later."""
    Z = np.fft.rfft(z, axis=-1)
    n = min(z.shape[-1], size) // 2 + 1
    out = np.zeros((*z.shape[:-1], size // 2 + 1), complex)
    out[..., :n] = Z[..., :n] * np.exp(2j * np.pi * np.arange(n) * shift / size)
    return np.asarray(np.fft.irfft(out, size, axis=-1) * (size / z.shape[-1]))


def free_run(model: Model, force: Floats, rate_hz: float, first: int = 0) -> Floats:
    """(places, n) motion in the kind that each place's channel measures, from rest, under (places, n) N.

    model : every value given. first : rows of the record before these, for what turns with the time.
    Raises ModelError for an incomplete or unstable model.
    """
    from .simulate_plan import build
    from .simulate_speed import Speed
    from .simulate_step import Stepper

    channels = tuple(model.channels[c] for c in motion_channels(model))
    plan = build(replace(model, channels=channels))
    speed = Speed(model.speed_rpm) if model.speed_rpm is not None else None
    stepper = Stepper(plan, 1.0 / (rate_hz * OVERSAMPLE), "exponential", speed)
    stepper.count = first * OVERSAMPLE
    slots = stepper.slots.of_dof[[plan.rig.index(p) for p in model.places]]
    out = np.empty_like(force)
    pad, chunk = int(0.25 * rate_hz), int(CHUNK_S * rate_hz)
    n = force.shape[1]
    stepped: list[Floats] = []
    for a in range(0, n, chunk):
        lo, hi = max(a - pad, 0), min(a + chunk + pad, n)
        fine = resampled(force[:, lo:hi], (hi - lo) * OVERSAMPLE, 0.5)
        part = fine[:, (a - lo) * OVERSAMPLE : (min(a + chunk, n) - lo) * OVERSAMPLE]
        F = np.zeros((part.shape[1], stepper.slots.count))
        F[:, slots] = part.T
        steps = np.empty((len(channels), part.shape[1]))
        stepper.step(F, steps)
        stepped.append(steps)
    whole = np.concatenate(stepped, axis=1)
    for a in range(0, n, chunk):
        lo, hi = max(a - pad, 0), min(a + chunk + pad, n)
        part = resampled(whole[:, lo * OVERSAMPLE : hi * OVERSAMPLE], hi - lo, -0.5 / OVERSAMPLE)
        out[:, a : min(a + chunk, n)] = part[:, a - lo : min(a + chunk, n) - lo]
    return out


def simulation_rmse(solution: Solution, first: float = 0.0) -> dict[str, float]:
    """Channel name -> rms in SI of measured minus simulated motion in the band, from the fraction `first` on.

    The bins of the fit count: below the band the disc on its shaft rings on for minutes from where it happened to be.
    Fit on the rows before, and simulate those after, for a held-out figure. Raises DataError without a measured force
    at every place.
    """
    start = solution.start
    return beside_record(fitted_model(solution), solution.record, float(np.max(2 * start.m / start.c)), first)


def beside_record(model: Model, record: Record, decay_s: float, first: float = 0.0) -> dict[str, float]:
    """The same of a model whose every value is given. decay_s : until free motion is down to 1 / e."""
    rate = record.rate_hz
    P = len(model.places)
    if len(force_channels(model)) < P:
        raise DataError("a free run needs a measured force at every place: add channels of kind force")
    lead = int(SETTLE * decay_s * rate)
    start = max(int(first * record.motion.rows) - lead, 0)
    valid = record.motion.valid[start:]
    force = np.where(valid, np.stack([record.force[i] for i in range(P)])[:, start:], 0.0)
    y = free_run(model, force, rate, start)
    kinds = [model.channels[c].kind for c in motion_channels(model)]
    simulated = band_limit(y.T, kinds, rate, model.band)
    out = {}
    for i, c in enumerate(motion_channels(model)):
        name = {"acceleration": "a", "velocity": "v", "displacement": "x"}[kinds[i]]
        measured = getattr(record.motion, name)[i, start:]
        good = valid & simulated.valid
        good[:lead] = False
        error = getattr(simulated, name)[i] - measured
        blocks = valid_blocks(good, record.grid)
        if not blocks.size:
            raise DataError(f"the record is too short for a free run of {lead / rate:.1f} s and what is compared after")
        psd = np.mean(np.abs(spectra(error[None], blocks, record.grid)) ** 2, axis=(0, 1))
        out[model.channels[c].name] = float(np.sqrt(psd.sum() * rate / record.grid.size))
    return out
