"""A simulated rig: the samples of its sensors, deterministic by seed.

The rotor is stepped `oversample` times per sample. Its motion passes a linear-phase anti-alias filter that is flat to
0.45 of the rate, then the sensor effects of the model and the anti-alias filter that the model names. Row k is the
signal at t = k / rate_hz. Calls of any length give the same numbers: the work is done in blocks of fixed size.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from estimator.arrays import Array
from estimator.errors import ModelError
from estimator.model.rig import Model
from estimator.signals import low_pass

from . import kernel as kernel
from .plan import Plan, simulation_plan
from .shaft_speed import ShaftSpeed
from .start import bring_to_start
from .stepper import Stepper
from .thresholds import LIMITS


def antialias_taps(oversample: int) -> Array:
    """(taps,) even number: unit gain at 0, flat (3e-5) to 0.45 and 90 dB down from 0.55 of the output rate."""
    n, beta = low_pass.kaiser_order(90.0, 0.1 / (0.5 * oversample))
    n += n % 2
    return low_pass.kaiser_low_pass(n, 1.0 / oversample, beta)


class Simulator:
    """An endless record of a rig: `next(n)` gives the following n rows.

    Parameters
    ----------
    model : Model
        A rig whose linear values, masses and effect parameters are all given.
    rate_hz : float
        Sampling rate, Hz.
    seed : int
        Seed of the random forces and of the sensor effects.
    oversample : int
        Steps per sample, at least 2.
    start : {"boltzmann", "rest"}
        The stationary state, or rest.
    speed : ShaftSpeed or None
        Speed of the shaft; None: the constant speed of the model.

    Raises
    ------
    ModelError
        The model is incomplete, unstable or without a stationary density.
    ValueError
        `oversample` or `rate_hz` is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> from estimator import Channel, Model, Setting
    >>> from estimator.simulation import Simulator
    >>> cap = {"bearing1.x": {"kL": Setting(1.0e7), "c": Setting(50.0), "S": Setting(1.0e-4)}}
    >>> rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 8000.0), mass={"bearing1": 0.2}, linear=cap)
    >>> one, other = Simulator(rig, 25600.0, seed=1), Simulator(rig, 25600.0, seed=1)
    >>> parts = np.concatenate([one.next(300), one.next(212)])
    >>> parts.shape, np.array_equal(parts, other.next(512))
    ((512, 1), True)
    """

    def __init__(
        self,
        model: Model,
        rate_hz: float,
        seed: int = 0,
        oversample: int = 8,
        *,
        start: Literal["boltzmann", "rest"] = "boltzmann",
        speed: ShaftSpeed | None = None,
    ) -> None:
        if oversample < 2 or rate_hz <= 0:
            raise ValueError("oversample must be at least 2 and rate_hz positive")
        self.model, self.rate_hz, self.oversample = model, float(rate_hz), oversample
        self.speed = speed or (ShaftSpeed(model.speed_rpm) if model.speed_rpm is not None else None)
        self.plan = simulation_plan(model)
        if self.speed is None:
            _refuse_without_speed(model, self.plan)
        motion, *sensor_seeds = np.random.SeedSequence(seed).spawn(1 + len(self.plan.sensors))
        self._rng = np.random.default_rng(motion)
        self._sensor_rngs = [np.random.default_rng(s) for s in sensor_seeds]
        self._step = Stepper(self.plan, 1.0 / (rate_hz * oversample), self.speed)
        self._taps = antialias_taps(oversample)
        before = LIMITS.margin_samples * oversample + self._taps.size // 2
        bring_to_start(model, self._step, self._rng, start, -before)
        self._steps = np.zeros((len(self.plan.channels), self._taps.size + LIMITS.block_samples * oversample))
        self._step.advance(self._rng, self._steps[:, : self._taps.size])
        self._tail = np.zeros((0, len(model.channels)))  # stepped rows whose sensors have not been applied
        self._raw_index = -LIMITS.margin_samples
        self._ready = np.zeros((0, len(model.channels)))

    def next(self, n: int) -> Array:
        """The next rows.

        Parameters
        ----------
        n : int
            Number of rows.

        Returns
        -------
        (n, channels) float64
            Samples in SI units, channels in the model's order; a tacho is 0 to 1.

        Raises
        ------
        ModelError
            The motion grows without bound.
        """
        parts, have = [self._ready], len(self._ready)
        while have < n:
            parts.append(self._block())
            have += LIMITS.block_samples
        rows = np.concatenate(parts) if len(parts) > 1 else parts[0]
        self._ready = rows[n:]
        return rows[:n].copy()

    def _block(self) -> Array:
        """(block_samples, channels) next rows with sensor effects."""
        need = LIMITS.block_samples + 2 * LIMITS.margin_samples
        while len(self._tail) < need:
            self._tail = np.concatenate([self._tail, self._raw()])
        rows, self._tail = self._tail[:need], self._tail[LIMITS.block_samples :]
        for (channel, effect, p), rng in zip(self.plan.sensors, self._sensor_rngs, strict=True):
            if effect.apply is None:
                raise ModelError(f"effect {effect.name}: a sensor effect needs apply")
            rows = rows.copy()
            rows[:, channel] = effect.apply(rows[:, channel], self.rate_hz, p, rng)
        return self._recorded(rows)[LIMITS.margin_samples : LIMITS.margin_samples + LIMITS.block_samples]

    def _recorded(self, rows: Array) -> Array:
        """The rows behind the recorder's anti-alias filter, without its delay; a tacho does not pass it."""
        design, padded = self.model.anti_alias, [(LIMITS.margin_samples, LIMITS.margin_samples), (0, 0)]
        if design is None:
            return np.asarray(rows)
        behind = [k for k, c in enumerate(self.model.channels) if c.kind != "tacho"]
        whole = np.pad(rows[:, behind], padded, mode="reflect")
        H = design.response(np.asarray(np.fft.rfftfreq(len(whole), 1.0 / self.rate_hz), dtype=np.float64), self.rate_hz)
        out = rows.copy()
        filtered = np.fft.irfft(np.fft.rfft(whole, axis=0) * H[:, None], len(whole), axis=0)
        out[:, behind] = filtered[LIMITS.margin_samples : -LIMITS.margin_samples]
        return out

    def _raw(self) -> Array:
        """(block_samples, channels) next rows before any sensor effect."""
        kept, steps = self._taps.size, self._steps
        self._step.advance(self._rng, steps[:, kept:])
        stepped = np.empty((LIMITS.block_samples, len(steps)))
        kernel.decimate(steps, self._taps, self.oversample, stepped)
        steps[:, :kept] = steps[:, -kept:].copy()
        if not np.all(np.isfinite(stepped)):
            raise ModelError("the simulated rotor ran away: an effect feeds energy in or the step is too long for it")
        out = np.zeros((LIMITS.block_samples, len(self.model.channels)))
        t: Array = np.asarray((self._raw_index + np.arange(LIMITS.block_samples)) / self.rate_hz, dtype=np.float64)
        column = 0
        for i, channel in enumerate(self.model.channels):
            if channel.kind == "tacho":
                out[:, i] = self.speed.pulses(t, 1.0 / self.rate_hz) if self.speed else 0.0
            else:
                out[:, i] = stepped[:, column]
                column += 1
        self._raw_index += LIMITS.block_samples
        return out


def _refuse_without_speed(model: Model, plan: Plan) -> None:
    """Raise ModelError where a law or a tacho needs the shaft speed."""
    by_angle = [a.effect.name for a in plan.acting if a.effect.turns]
    if by_angle or model.tacho is not None:
        raise ModelError(f"no shaft speed, but {', '.join(by_angle) or 'a tacho channel'} needs it: give speed_rpm")


def quantise(y: Array, full_scale: float, bits: int = 16) -> Array:
    """Samples in SI after a converter: whole counts of full_scale / (2^(bits-1) - 1), clipped at full scale."""
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
    start: Literal["boltzmann", "rest"] = "boltzmann",
    speed: ShaftSpeed | None = None,
) -> Array:
    """A simulated record, as a device would send it.

    Parameters
    ----------
    model : Model
        A rig whose linear values, masses and effect parameters are all given.
    rate_hz : float
        Sampling rate, Hz.
    seconds : float
        Length of the record, s.
    seed : int
        Seed of the random forces, the sensor effects and the noise.
    noise : float or mapping of str to float
        Rms of white sensor noise over the whole band, in the unit of the channel: by channel name, or one number for
        every acceleration, velocity and displacement channel.
    full_scale : float, mapping of str to float, or None
        Full scale of the 16-bit counts, as `noise`; None leaves the signal unrounded.
    oversample, start, speed
        As those of `Simulator`.

    Returns
    -------
    (n, channels) float64
        Samples in SI units, n = round(seconds * rate_hz), channels in the model's order; a tacho is 0 to 1.

    Raises
    ------
    ModelError
        The model is incomplete, unstable or without a stationary density.

    Examples
    --------
    >>> from estimator import Channel, Model, Setting, simulate
    >>> cap = {"bearing1.x": {"kL": Setting(1.0e7), "c": Setting(50.0), "S": Setting(1.0e-4)}}
    >>> rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 8000.0), mass={"bearing1": 0.2}, linear=cap)
    >>> simulate(rig, rate_hz=25600.0, seconds=0.1, seed=1).shape
    (2560, 1)
    """
    source = Simulator(model, rate_hz, seed, oversample, start=start, speed=speed)
    y = source.next(round(seconds * rate_hz))
    _add_noise(y, model, np.random.default_rng(np.random.SeedSequence((seed, 1))), noise, full_scale)
    return y


def _add_noise(
    y: Array,
    model: Model,
    rng: np.random.Generator,
    noise: float | Mapping[str, float],
    full_scale: float | Mapping[str, float] | None,
) -> None:
    """Add sensor noise to y (n, channels) and round it to counts, in place. The arguments are those of `simulate`."""
    for i, channel in enumerate(model.channels):
        motion = channel.kind not in ("force", "tacho")
        rms = noise.get(channel.name, 0.0) if isinstance(noise, Mapping) else noise * motion
        if rms:
            y[:, i] += rms * rng.standard_normal(len(y))
        top = full_scale.get(channel.name) if isinstance(full_scale, Mapping) else full_scale if motion else None
        if top:
            y[:, i] = quantise(y[:, i], top)
