"""A simulated rig: what its sensors would send, at the sampling rate, deterministic by seed.

The rotor is stepped `oversample` times per sample (simulate_kernel), seen through a linear-phase anti-alias filter
that is flat to 0.45 of the rate, then through the model's sensor effects. Row k is the signal at t = k / rate_hz.
Chunks of any size give the same numbers: work is done in blocks of fixed size.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from estimator.arrays import Array
from estimator.errors import ModelError
from estimator.model.effect import Effect
from estimator.model.rig import Model
from estimator.signals import low_pass

from . import kernel as kernel
from .plan import Plan, build
from .shaft_speed import Speed
from .start import start_state
from .stepper import Scheme, Stepper

BLOCK = 1024  # output samples made at a time
MARGIN = 512  # samples before and after a block that sensor effects may look at


def antialias_taps(oversample: int) -> Array:
    """Even number of taps, unit gain at 0: flat (3e-5) to 0.45 and 90 dB down from 0.55 of the output rate."""
    n, beta = low_pass.kaiser_order(90.0, 0.1 / (0.5 * oversample))
    n += n % 2
    return low_pass.kaiser_low_pass(n, 1.0 / oversample, beta)


class Simulator:
    """A rig that goes on for ever: `next(n)` gives the following n rows.

    Parameters
    ----------
    model : every linear value, mass and effect parameter given.
    rate_hz : output rate; `oversample` steps are taken per sample.
    scheme : "exponential" (exact for the linear part, second order in the effects) or "rk4" (the paper's). Both
        hold the force over the step with variance S / (2 dt).
    start : "boltzmann" (stationary, see simulate_start) or "rest".
    speed : shaft speed; default the constant speed of the model.

    Raises ModelError for a model that is incomplete, unstable or without a stationary density.
    """

    def __init__(
        self,
        model: Model,
        rate_hz: float,
        seed: int = 0,
        oversample: int = 8,
        *,
        scheme: Scheme = "exponential",
        start: Literal["boltzmann", "rest"] = "boltzmann",
        speed: Speed | None = None,
    ) -> None:
        if oversample < 2 or rate_hz <= 0:
            raise ValueError("oversample must be at least 2 and rate_hz positive")
        self.model, self.rate_hz, self.oversample = model, float(rate_hz), oversample
        self.speed = speed or (Speed(model.speed_rpm) if model.speed_rpm is not None else None)
        self.plan = build(model)
        if self.speed is None:
            _refuse_without_speed(model, self.plan)
        motion, *sensor_seeds = np.random.SeedSequence(seed).spawn(1 + len(self.plan.sensors))
        self._rng = np.random.default_rng(motion)
        self._sensor_rngs = [np.random.default_rng(s) for s in sensor_seeds]
        self._step = Stepper(self.plan, 1.0 / (rate_hz * oversample), scheme, self.speed)
        self._taps = antialias_taps(oversample)
        before = MARGIN * oversample + self._taps.size // 2
        self._step.x, self._step.v, self._step.z, self._step.count = start_state(
            model, self.plan, self._step, self._rng, start, -before
        )
        self._steps = np.zeros((len(self.plan.channels), self._taps.size + BLOCK * oversample))
        self._step.advance(self._rng, self._steps[:, : self._taps.size])
        self._tail = np.zeros((0, len(model.channels)))  # stepped rows whose sensors have not been applied
        self._raw_index = -MARGIN
        self._ready = np.zeros((0, len(model.channels)))

    def next(self, n: int) -> Array:
        """(n, channels) float64, SI, channels in the model's order (a tacho is 0 to 1)."""
        parts, have = [self._ready], len(self._ready)
        while have < n:
            parts.append(self._block())
            have += BLOCK
        rows = np.concatenate(parts) if len(parts) > 1 else parts[0]
        self._ready = rows[n:]
        return rows[:n].copy()

    def _block(self) -> Array:
        need = BLOCK + 2 * MARGIN
        while len(self._tail) < need:
            self._tail = np.concatenate([self._tail, self._raw()])
        rows, self._tail = self._tail[:need], self._tail[BLOCK:]
        for (channel, effect, p), rng in zip(self.plan.sensors, self._sensor_rngs, strict=True):
            if effect.apply is None:
                raise ModelError(f"effect {effect.name}: a sensor effect needs apply")
            rows = rows.copy()
            rows[:, channel] = effect.apply(rows[:, channel], self.rate_hz, p, rng)
        return np.asarray(rows[MARGIN : MARGIN + BLOCK])

    def _raw(self) -> Array:
        """The next BLOCK rows before any sensor effect."""
        kept, steps = self._taps.size, self._steps
        self._step.advance(self._rng, steps[:, kept:])
        stepped = np.empty((BLOCK, len(steps)))
        kernel.decimate(steps, self._taps, self.oversample, stepped)
        steps[:, :kept] = steps[:, -kept:].copy()
        if not np.all(np.isfinite(stepped)):
            raise ModelError("the simulated rotor ran away: an effect feeds energy in or the step is too long for it")
        out = np.zeros((BLOCK, len(self.model.channels)))
        t: Array = np.asarray((self._raw_index + np.arange(BLOCK)) / self.rate_hz, dtype=np.float64)
        column = 0
        for i, channel in enumerate(self.model.channels):
            if channel.kind == "tacho":
                out[:, i] = self.speed.pulses(t, 1.0 / self.rate_hz) if self.speed else 0.0
            else:
                out[:, i] = stepped[:, column]
                column += 1
        self._raw_index += BLOCK
        return out


def _refuse_without_speed(model: Model, plan: Plan) -> None:
    turning = [a.effect.name for a in plan.acting if a.effect.force and uses_phase(a.effect)]
    if turning or model.tacho is not None:
        raise ModelError(f"no shaft speed, but {', '.join(turning) or 'a tacho channel'} needs it: give speed_rpm")


def uses_phase(effect: Effect) -> bool:
    """Whether an effect's law reads the shaft angle."""
    import dis

    return effect.force is not None and any(i.argval == "phase" for i in dis.get_instructions(effect.force))


def quantise(y: Array, full_scale: float, bits: int = 16) -> Array:
    """What a converter of `bits` sends, in SI: whole counts of full_scale / (2^(bits-1) - 1), clipped at full scale."""
    top = 2 ** (bits - 1) - 1
    return np.asarray(np.clip(np.rint(y * (top / full_scale)), -top, top) * (full_scale / top))


def simulate(
    model: Model,
    rate_hz: float,
    seconds: float,
    seed: int = 0,
    *,
    noise: float | Mapping[str, float] = 0.0,
    full_scale: float | Mapping[str, float] | None = None,
    oversample: int = 8,
    scheme: Scheme = "exponential",
    start: Literal["boltzmann", "rest"] = "boltzmann",
    speed: Speed | None = None,
) -> Array:
    """(n, channels) of a simulated record, n = round(seconds * rate_hz), as a real device would send it.

    noise : rms of white sensor noise over the whole band. full_scale : of the 16-bit counts; None leaves the signal
    unrounded. Either by channel name, or one number for every acceleration, velocity and displacement channel.
    """
    source = Simulator(model, rate_hz, seed, oversample, scheme=scheme, start=start, speed=speed)
    y = source.next(round(seconds * rate_hz))
    rng = np.random.default_rng(np.random.SeedSequence((seed, 1)))
    for i, channel in enumerate(model.channels):
        motion = channel.kind not in ("force", "tacho")
        rms = noise.get(channel.name, 0.0) if isinstance(noise, Mapping) else noise * motion
        if rms:
            y[:, i] += rms * rng.standard_normal(len(y))
        top = full_scale.get(channel.name) if isinstance(full_scale, Mapping) else full_scale if motion else None
        if top:
            y[:, i] = quantise(y[:, i], top)
    return y
