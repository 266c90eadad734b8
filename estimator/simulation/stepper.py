"""The stepping of a plan: state, random force with its spectral shape and correlation, and the compiled step.

Start of a simulation: at rest, or in the stationary state.

The disc mode of a chain relaxes only through the dampers of the caps, in seconds to hours. A start from rest would show
a transient for the whole record. The state is drawn from the exact Gaussian density of the linear rotor. A run before
the record then lets the effects act. Where exp(-H/T) is the stationary density, this run has strong damping on every
mass and the noise of the same temperature: it reaches the same density in a few periods. Otherwise it is a short run
with the true damping.

Shaft angle against time, in closed form, so that any chunk of a simulation sees the same shaft.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from typing import Literal

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.effects.engine.law_loop import force_array
from estimator.errors import ModelError
from estimator.model.rig import Model
from estimator.model.rotor import assemble, linear_covariance, propagator

from . import kernel as kernel
from .plan import Plan, Slots, effect_table
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True)
class ShaftSpeed:
    """A shaft speed: constant, with a ramp and a slow fluctuation.

    Parameters
    ----------
    rpm : float
        Speed at t = 0.
    ramp_rpm_per_s : float
        Rate of change of the speed.
    fluctuation : float
        Rms of the fluctuation as a fraction of `rpm`: eight sines between 0.2 and 2 times `fluctuation_hz`.
    fluctuation_hz : float
        Scale of the frequencies of the fluctuation.
    seed : int
        Seed of the frequencies and phases of the fluctuation.

    Examples
    --------
    >>> import numpy as np
    >>> from estimator.simulation import ShaftSpeed
    >>> turns = ShaftSpeed(600.0).phase(np.array([0.0, 0.1, 0.2])) / (2 * np.pi)
    >>> turns.round(3).tolist()
    [0.0, 1.0, 2.0]
    """

    rpm: float
    ramp_rpm_per_s: float = 0.0
    fluctuation: float = 0.0
    fluctuation_hz: float = 0.5
    _: KW_ONLY
    seed: int = 0

    def phase(self, t: Array) -> Array:
        """Shaft angle in rad at times t in s, any shape; 0 at t = 0 but for the fluctuation."""
        turns = (self.rpm * t + 0.5 * self.ramp_rpm_per_s * t * t) / 60.0
        if self.fluctuation:
            rng = np.random.default_rng(self.seed)
            f = self.fluctuation_hz * rng.uniform(0.2, 2.0, 8)
            start = rng.uniform(0.0, 2.0 * np.pi, 8)
            amplitude = self.rpm / 60.0 * self.fluctuation * np.sqrt(2.0 / 8)
            for fi, a in zip(f, start, strict=True):
                turns = turns + amplitude / (2 * np.pi * fi) * np.sin(2 * np.pi * fi * t + a)
        return np.asarray(2.0 * np.pi * turns)

    def pulses(self, t: Array, width_s: float, duty: float = 0.1) -> Array:
        """Tacho signal at times t in s, 0 to 1: high for `duty` of a turn from angle 0, averaged over `width_s`."""

        def high(turns: Array) -> Array:  # turns spent high since 0
            whole = np.floor(turns)
            return np.asarray(whole * duty + np.minimum(turns - whole, duty))

        before = self.phase(t - 0.5 * width_s) / (2 * np.pi)
        after = self.phase(t + 0.5 * width_s) / (2 * np.pi)
        moved = after - before
        still = np.asarray(np.mod(before, 1.0) < duty, dtype=float)
        return np.where(moved > 0, (high(after) - high(before)) / np.where(moved > 0, moved, 1.0), still)


class Stepper:
    """The rotor's state and the compiled step.

    plan : of the model. dt : s, length of a step. speed : of the shaft; None: angle 0.
    x, v : (slots,) m and m/s. z : memory states. count : number of the next step; step k starts at k * dt.
    """

    def __init__(self, plan: Plan, dt: float, speed: ShaftSpeed | None) -> None:
        self.plan, self.dt, self.speed = plan, dt, speed
        rig, self.slots = plan.rig, Slots.of(plan.rig)
        self._table, states, self._kept = effect_table(plan.acting, self.slots)
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
        E, G0, G1 = propagator(rig.M, rig.C, rig.K, dt)
        self._matrices = self.slots.blocks(E, 2, 2), self.slots.blocks(G0, 2), self.slots.blocks(G1, 2)
        self._channels = plan.channels.astype(np.uintp)
        self._channels[:, 1] = self.slots.of_dof[plan.channels[:, 1]]

    def advance(self, rng: np.random.Generator, out: Array) -> None:
        """Step out.shape[1] times under a random force; fill out (channels, steps) with the averages of the steps."""
        steps = out.shape[1]
        F = np.zeros((steps, self.slots.count))
        F[:, self.slots.of_dof[self.driven]] = self._force(rng, steps)
        self.step(F, out)

    def run_in(self, rng: np.random.Generator, steps: int) -> None:
        """Step under a random force without output."""
        room = np.empty((len(self._channels), steps + 1))
        self.advance(rng, room[:, 1:])  # a slice has the array layout that is compiled already

    def step(self, F: Array, out: Array) -> None:
        """Step under given forces F (steps, slots) N, held over a step; fill out (channels, steps)."""
        steps = len(F)
        t: Array = np.asarray((self.count + np.arange(steps + 1)) * self.dt, dtype=np.float64)
        phase = self.speed.phase(t) if self.speed else np.zeros(steps + 1)
        at = (self.count * self.dt, self.dt, phase, F)
        kernel.exponential(self.x, self.v, self.z, *at, self._table, self._matrices, self._channels, out)
        self.count += steps

    def _force(self, rng: np.random.Generator, steps: int) -> Array:
        """(steps, driven) N, random force of each driven degree of freedom."""
        white = rng.standard_normal((steps, self.driven.size))
        if self._mix is not None:
            white = white @ self._mix.T
        if self._shapes:
            from scipy.signal import oaconvolve

            if self._past is None:
                self._past = rng.standard_normal((LIMITS.shape_taps, self.driven.size))
            whole = np.concatenate([self._past, white])
            self._past = whole[-LIMITS.shape_taps :]
            for column, taps in self._shapes:
                white[:, column] = oaconvolve(whole[:, column], taps, mode="full")[
                    LIMITS.shape_taps : LIMITS.shape_taps + steps
                ]
        return np.asarray(white * self.level)


def _correlation(plan: Plan, driven: np.ndarray) -> Array | None:
    """Factor (forces, forces) that correlates white forces; None if all are independent."""
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
    """(shape_taps,) filter whose gain is the root of the spectral shape, by sampling in frequency."""
    if not callable(shape):
        raise TypeError("shape must be callable")
    gain = np.sqrt(np.maximum(shape(np.fft.rfftfreq(LIMITS.shape_taps, dt), p), 0.0))
    taps = np.roll(np.fft.irfft(gain), LIMITS.shape_taps // 2)
    return np.asarray(taps * np.hanning(LIMITS.shape_taps + 1)[: LIMITS.shape_taps])


def start_state(
    model: Model,
    plan: Plan,
    stepper: Stepper,
    rng: np.random.Generator,
    start: Literal["boltzmann", "rest"],
    first: int,
) -> tuple[Array, Array, Array, int]:
    """Motion x (slots,) m, v (slots,) m/s, memories z and the number `first` of the next step.

    Raises ModelError where there is no stationary state.
    """
    rig, n = plan.rig, len(plan.rig.dofs)
    if start == "rest":
        return stepper.x, stepper.v, stepper.z, first
    if not np.any(rig.S):
        raise ModelError("no force drives the rotor, so there is no stationary state: set S, or start from rest")
    P = linear_covariance(rig.M, rig.C, rig.K, np.diag(rig.S / 2.0))
    refuse_escape(plan, np.sqrt(np.diag(P)[:n]), np.diag(rig.M) * np.diag(P)[n:])
    w, U = np.linalg.eigh(P / np.sqrt(np.outer(np.diag(P), np.diag(P))))
    u = np.sqrt(np.diag(P)) * (U @ (np.sqrt(np.maximum(w, 0.0)) * rng.standard_normal(2 * n)))
    stepper.x, stepper.v = stepper.slots.vector(u[:n]), stepper.slots.vector(u[n:])
    if plan.acting:
        known = stationarity(model)
        if known.exact and not plan.correlation and not plan.shapes:
            _thermalise(plan, stepper, rng, known.temperature)
        else:
            steps = round(LIMITS.burn_s / stepper.dt)
            stepper.count = first - steps
            stepper.run_in(rng, steps)
    return stepper.x, stepper.v, stepper.z, first


def _thermalise(plan: Plan, stepper: Stepper, rng: np.random.Generator, temperature: float) -> None:
    """Run with damping 0.5 m w on every mass at a temperature in J, for 60 times the slowest damping time."""
    rig = plan.rig
    m, w = np.diag(rig.M), np.sqrt(np.diag(rig.K) / np.diag(rig.M))
    strong = replace(rig, C=np.diag(0.5 * m * w), S=2.0 * 2.0 * temperature * 0.5 * m * w)
    other = type(stepper)(replace(plan, rig=strong), stepper.dt, stepper.speed)
    other.x, other.v, other.z = stepper.x, stepper.v, stepper.z
    steps = round(60.0 / (0.5 * w.min()) / stepper.dt)
    while steps > 0:
        other.run_in(rng, min(steps, 65536))
        steps -= 65536
    stepper.x, stepper.v, stepper.z = other.x, other.v, other.z


def refuse_escape(plan: Plan, sigma: Array, temperature: Array) -> None:
    """Raise ModelError where the static force of the effects lets a cap leave its potential well for good.

    sigma : (dofs,) m, temperature : (dofs,) J, of each degree of freedom of the linear rotor. The barrier is the
    highest potential along x. On either side it must exceed min_barrier_t temperatures.
    """
    for i, dof in enumerate(plan.rig.dofs):
        laws = [a for a in plan.acting if a.where[1] == i and a.effect.stationary_density and a.effect.force]
        laws = [a for a in laws if a.effect.kind == "force"]
        if not laws:
            continue
        x = np.linspace(0.0, 60.0 * sigma[i], 6001)
        for side in (1.0, -1.0):
            force = plan.rig.K[i, i] * x
            for a in laws:
                force = force + side * force_array(a.effect, a.p, side * x, s=a.s)
            V = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1])) * (x[1] - x[0])])
            if force[-1] < 0.0 and V.max() < LIMITS.min_barrier_t * temperature[i]:
                names = ", ".join(a.effect.name for a in laws)
                raise ModelError(
                    f"{dof}: {names} softens without end and has no stationary density "
                    f"(barrier {V.max() / temperature[i]:.1f} T, at least {LIMITS.min_barrier_t:g} T is needed): "
                    "weaken it, or use hertz"
                )


@dataclass(frozen=True, slots=True)
class Stationarity:
    """Whether exp(-H/T) is the stationary density of a model, H its energy.

    It is where the intensity of the forces is Q = 2 T C, with C the symmetric part of the damping matrix.

    Parameters
    ----------
    temperature : float
        T in J that matches best; infinite without damping.
    mismatch : float
        ``|Q - 2 T C| / |Q|``; 0 where the condition holds.
    blocking : tuple of str
        Effects that no temperature suits.
    """

    temperature: float
    mismatch: float
    blocking: tuple[str, ...]

    @property
    def exact(self) -> bool:
        """Whether exp(-H/T) is exactly stationary."""
        return self.mismatch < 1e-9 and not self.blocking


def stationarity(model: Model) -> Stationarity:
    """Whether exp(-H/T) is the stationary density of a model.

    Parameters
    ----------
    model : Model
        A rig whose linear values and masses are all given.

    Returns
    -------
    Stationarity
        Temperature, mismatch, and the effects that break the condition.

    Raises
    ------
    ModelError
        A linear value or a mass is missing.

    Examples
    --------
    >>> from estimator import Channel, Model, Setting
    >>> from estimator.simulation import stationarity
    >>> cap = {"bearing1.x": {"kL": Setting(1.0e7), "c": Setting(50.0), "S": Setting(1.0e-4)}}
    >>> rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 8000.0), mass={"bearing1": 0.2}, linear=cap)
    >>> stationarity(rig).exact, stationarity(rig).temperature
    (True, 5e-07)
    """
    rig = assemble(model)
    Q, C = np.diag(rig.S / 2.0), 0.5 * (rig.C + rig.C.T)
    T = float(np.sum(Q * C) / (2.0 * np.sum(C * C))) if np.any(C) else np.inf
    mismatch = float(np.linalg.norm(Q - 2.0 * T * C) / np.linalg.norm(Q)) if np.any(Q) and np.isfinite(T) else np.inf
    effects = [effect_of(use) for use in model.effects]
    blocking = tuple(e.name for e in effects if not e.stationary_density and e.kind != "sensor")
    return Stationarity(T, mismatch, blocking)
