"""The stepping of a plan: state, random force with its spectral shape and correlation, and the compiled step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from estimator.arrays import Array
from estimator.errors import ModelError
from estimator.model.rotor import propagator

from . import kernel as kernel
from .plan import Plan, effect_table
from .shaft_speed import ShaftSpeed
from .thresholds import LIMITS


class Stepper:
    """The rotor's state and the compiled step.

    plan : of the model. dt : s, length of a step. speed : of the shaft; None: angle 0.
    x, v : (slots,) m and m/s, of the degrees of freedom, and 0 in a last slot. z : memory states. count : number of the
    next step; step k starts at k * dt.
    """

    def __init__(self, plan: Plan, dt: float, speed: ShaftSpeed | None) -> None:
        self.plan, self.dt, self.speed = plan, dt, speed
        rig, n = plan.rig, len(plan.rig.dofs)
        self._table, states, self._kept = effect_table(plan.acting, n)
        self.x, self.v, self.z = np.zeros(n + 1), np.zeros(n + 1), np.zeros(states)
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
        self._matrices = tuple(np.ascontiguousarray(A) for A in propagator(rig.M, rig.C, rig.K, dt))
        self._channels = plan.channels.astype(np.uintp)

    def advance(self, rng: np.random.Generator, out: Array) -> None:
        """Step out.shape[1] times under a random force; fill out (channels, steps) with the averages of the steps."""
        steps = out.shape[1]
        F = np.zeros((steps, self.x.size))
        F[:, self.driven] = self._force(rng, steps)
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


def _shape_taps(shape: Callable[..., Array], p: Array, dt: float) -> Array:
    """(shape_taps,) filter whose gain is the root of the spectral shape, by sampling in frequency."""
    gain = np.sqrt(np.maximum(shape(np.fft.rfftfreq(LIMITS.shape_taps, dt), p), 0.0))
    taps = np.roll(np.fft.irfft(gain), LIMITS.shape_taps // 2)
    return np.asarray(taps * np.hanning(LIMITS.shape_taps + 1)[: LIMITS.shape_taps])
