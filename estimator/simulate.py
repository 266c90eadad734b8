"""A simulated rig: what its sensors would send, at the sampling rate, deterministic by seed.

The rotor is stepped `oversample` times per sample (simulate_kernel), seen through a linear-phase anti-alias filter
that is flat to 0.45 of the rate, then through the model's sensor effects. Row k is the signal at t = k / rate_hz.
Chunks of any size give the same numbers: work is done in blocks of fixed size.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from scipy.signal import firwin, kaiserord

from . import simulate_kernel as kernel
from .effect import Effect
from .errors import ModelError
from .model import Model
from .rotor import Array, propagator
from .simulate_plan import Plan, Slots, build, table
from .simulate_speed import Speed
from .simulate_start import start_state

Scheme = Literal["exponential", "rk4"]
BLOCK = 1024  # output samples made at a time
MARGIN = 512  # samples before and after a block that sensor effects may look at
SHAPE_TAPS = 4096  # length of the filter that colours a force


def antialias_taps(oversample: int) -> Array:
    """Even number of taps, unit gain at 0: flat (3e-5) to 0.45 and 90 dB down from 0.55 of the output rate."""
    n, beta = kaiserord(90.0, 0.1 / (0.5 * oversample))
    n += n % 2
    return np.asarray(firwin(n, 1.0 / oversample, window=("kaiser", beta)))


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


class Stepper:
    """The rotor's state and the compiled step. `count` is the number of the next step; step k starts at k * dt."""

    def __init__(self, plan: Plan, dt: float, scheme: Scheme, speed: Speed | None) -> None:
        if scheme not in ("exponential", "rk4"):
            raise ValueError(f'scheme {scheme!r}: "exponential" or "rk4"')
        self.plan, self.dt, self.speed, self.scheme = plan, dt, speed, scheme
        rig, self.slots = plan.rig, Slots.of(plan.rig)
        self._table, states, self._kept = table(plan.acting, self.slots)
        n = self.slots.count
        self.x, self.v, self.z = np.zeros(n), np.zeros(n), np.zeros(states)
        self.count = 0
        self.driven = np.flatnonzero(rig.S)
        self.level = np.sqrt(rig.S[self.driven] / (2.0 * dt))
        self._mix = _correlation(plan, self.driven)
        self._shapes = [
            (int(np.flatnonzero(self.driven == i)[0]), _shape_taps(shape, p, dt))
            for i, shape, p in plan.shapes
            if i in self.driven
        ]
        self._past: Array | None = None  # white force before this call, for the colouring filters
        self._matrices: tuple[Array, Array, Array]
        if scheme == "exponential":
            E, G0, G1 = propagator(rig.M, rig.C, rig.K, dt)
            self._matrices = self.slots.blocks(E, 2, 2), self.slots.blocks(G0, 2), self.slots.blocks(G1, 2)
        else:
            mass = self.slots.vector(np.diag(rig.M), 1.0)
            self._matrices = self.slots.blocks(rig.K), self.slots.blocks(rig.C), mass
        self._channels = plan.channels.astype(np.uintp)
        self._channels[:, 1] = self.slots.of_dof[plan.channels[:, 1]]

    def advance(self, rng: np.random.Generator, out: Array) -> None:
        """Step out.shape[1] times, writing the channels' step averages into out (channels, steps)."""
        steps = out.shape[1]
        F = np.zeros((steps, self.slots.count))
        F[:, self.slots.of_dof[self.driven]] = self._force(rng, steps)
        self.step(F, out)

    def step(self, F: Array, out: Array) -> None:
        """Step under the given held forces F (steps, slots) N."""
        steps = len(F)
        t: Array = np.asarray((self.count + np.arange(steps + 1)) * self.dt, dtype=np.float64)
        phase = self.speed.phase(t) if self.speed else np.zeros(steps + 1)
        run = kernel.rk4 if self.scheme == "rk4" else kernel.exponential
        at = (self.count * self.dt, self.dt, phase, F)
        run(self.x, self.v, self.z, *at, self._table, self._matrices, self._channels, out)
        self.count += steps

    def _force(self, rng: np.random.Generator, steps: int) -> Array:
        white = rng.standard_normal((steps, self.driven.size))
        if self._mix is not None:
            white = white @ self._mix.T
        if self._shapes:
            from scipy.signal import oaconvolve

            if self._past is None:
                self._past = rng.standard_normal((SHAPE_TAPS, self.driven.size))
            whole = np.concatenate([self._past, white])
            self._past = whole[-SHAPE_TAPS:]
            for column, taps in self._shapes:
                white[:, column] = oaconvolve(whole[:, column], taps, mode="full")[SHAPE_TAPS : SHAPE_TAPS + steps]
        return np.asarray(white * self.level)


def _correlation(plan: Plan, driven: np.ndarray) -> Array | None:
    """Factor (forces, forces) that correlates white forces, None if there is nothing to correlate."""
    if not plan.correlation:
        return None
    R = np.eye(driven.size)
    for i, j, rho in plan.correlation:
        if not -1.0 < rho < 1.0:
            raise ModelError(f"correlated_force: rho must lie between -1 and 1, it is {rho:g}")
        if i in driven and j in driven:
            a, b = np.flatnonzero(driven == i)[0], np.flatnonzero(driven == j)[0]
            R[a, b] = R[b, a] = rho
    return np.asarray(np.linalg.cholesky(R))


def _shape_taps(shape: object, p: Array, dt: float) -> Array:
    """Filter whose gain is the root of the effect's multiplier of S, by sampling it in frequency."""
    if not callable(shape):
        raise TypeError("shape must be callable")
    gain = np.sqrt(np.maximum(shape(np.fft.rfftfreq(SHAPE_TAPS, dt), p), 0.0))
    taps = np.roll(np.fft.irfft(gain), SHAPE_TAPS // 2)
    return np.asarray(taps * np.hanning(SHAPE_TAPS + 1)[:SHAPE_TAPS])


def _refuse_without_speed(model: Model, plan: Plan) -> None:
    turning = [a.effect.name for a in plan.acting if a.effect.force and uses_phase(a.effect)]
    if turning or any(c.kind == "tacho" for c in model.channels):
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
