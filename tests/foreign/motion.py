"""A rotor's motion by other means than the product's: the linear rotor stepped exactly, laws as kicks amid the steps.

Nothing here is imported from the product: laws, units and signs are written from physics.md's text a second time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov

Array = NDArray[np.float64]
CHUNK = 1 << 18  # steps of which forces are in memory
LAWS = (
    "cubic", "quintic", "quadratic", "clearance", "stop", "hertz", "coulomb", "quadratic_damping",
    "displacement_damping", "bouc_wen", "ball_pass", "crack", "stiffness_drift", "local_defect", "rub",
    "saturating", "rippled", "smooth",
    "smooth_friction", "smooth_clearance", "stribeck", "other_loop", "half_sine_strikes", "two_orders", "warming",
    "off_centre",
)  # fmt: skip
FULL_LOOP = LAWS.index("other_loop")


@dataclass(frozen=True, slots=True)
class Law:
    """One law: what it is, the degree of freedom it pushes, those beside it (the cap's other direction; of a disc its
    two caps) and up to five numbers in SI."""

    name: str
    dof: int
    beside: tuple[int, int]
    numbers: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Rotor:
    """M, C, K (n, n) of all degrees of freedom, SI. S : (n,) one-sided PSD of the unknown force, N^2/Hz, 0 for none.
    turn : rad/s of the shaft."""

    M: Array
    C: Array
    K: Array
    S: Array
    turn: float
    laws: list[Law] = field(default_factory=list)

    def flow(self) -> Array:
        """(2n, 2n) of the first-order system of displacements, then velocities."""
        n = len(self.M)
        inverse = np.linalg.inv(self.M)
        return np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ self.K, -inverse @ self.C]])

    def covariance(self) -> Array:
        """(2n, 2n) of the linear rotor at rest in its own noise."""
        n = len(self.M)
        Q = np.zeros((2 * n, 2 * n))
        inverse = np.linalg.inv(self.M)
        Q[n:, n:] = inverse @ np.diag(self.S / 2) @ inverse.T
        return np.asarray(solve_continuous_lyapunov(self.flow(), -Q))


@njit(cache=False)
def push(kind, p, x, v, xo, t, turn, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Restoring force of one law, N; of a shaft x is disc less mean of the caps."""
    if kind == 0:
        return p[0] * x**3
    if kind == 1:
        return p[0] * x**5
    if kind == 2:
        return p[0] * x**2
    if kind == 3:
        return p[0] * (x - p[1]) if x > p[1] else (p[0] * (x + p[1]) if x < -p[1] else 0.0)
    if kind == 4:
        return p[0] * (x - p[1]) if (x > p[1]) == (p[1] > 0) and (x < p[1]) == (p[1] < 0) else 0.0
    if kind == 5:  # p: k, preload, balls, 0 or 1 for x or y
        total = 0.0
        for j in range(int(p[2])):
            angle = 2 * np.pi * j / p[2]
            c, s = np.cos(angle), np.sin(angle)
            along, across = (c, s) if p[3] == 0 else (s, c)
            delta = p[1] + along * x + across * xo
            if delta > 0:
                total += delta**1.5 * along
        if p[1] > 0:
            total -= 0.75 * p[2] * np.sqrt(p[1]) * x
        return p[0] * total
    if kind == 6:
        return p[0] * np.sign(v)
    if kind == 7:
        return p[0] * v * abs(v)
    if kind == 8:
        return p[0] * x * x * v
    if kind == 9:
        return p[0] * z
    if kind == 10:
        return (p[0] * np.cos(p[2] * turn * t) + p[1] * np.sin(p[2] * turn * t)) * x
    if kind == 11:
        return -(p[0] + p[1] * np.cos(turn * t) + p[2] * np.sin(turn * t)) * x
    if kind == 12:
        return (p[0] * t + 0.5 * p[1] * t * t) * x
    if kind == 13:
        return -p[0] * np.exp(-((p[1] * turn * t - p[2]) % (2 * np.pi)) / p[3])
    if kind == 14:  # p: k, kt, clearance, 0 or 1 for x or y
        r = np.hypot(x, xo)
        if r <= p[2]:
            return 0.0
        return (r - p[2]) / r * (p[0] * x + (p[1] if p[3] == 1 else -p[1]) * xo)
    if kind == 15:
        return p[0] * p[1] * np.tanh(x / p[1])
    if kind == 16:
        return p[0] * p[1] * np.sin(x / p[1])
    if kind == 17:
        return p[0] * p[1] * (np.sin(x / p[1]) + p[2] * np.sin(2 * x / p[1]) + p[3] * np.sin(3 * x / p[1]))
    if kind == 18:
        return p[0] * np.tanh(v / p[1])
    if kind == 19:  # a dead zone with round corners, p[2] wide
        up, down = (x - p[1]) / p[2], (-x - p[1]) / p[2]
        return p[0] * p[2] * (np.log1p(np.exp(-abs(up))) + max(up, 0.0) - np.log1p(np.exp(-abs(down))) - max(down, 0.0))
    if kind == 20:
        return p[0] * (1.0 + p[2] * np.exp(-abs(v) / p[1])) * np.tanh(v / (0.05 * p[1]))
    if kind == 21:
        return p[0] * z
    if kind == 22:  # p[3] s long, each early or late by p[4] of a period
        period = 2 * np.pi / (p[1] * turn)
        n = np.floor(t / period)
        late = (np.sin(12.9898 * (n + p[2])) * 43758.5453) % 1.0 - 0.5
        since = t - n * period - (0.3 + p[4] * late) * period
        return -p[0] * np.sin(np.pi * since / p[3]) if 0.0 < since < p[3] else 0.0
    if kind == 23:
        angle = p[2] * turn * t
        return (p[0] * np.cos(angle) + p[1] * np.sin(angle) + 0.4 * p[0] * np.cos(2 * angle)) * x
    if kind == 24:
        return p[0] * (1.0 - np.exp(-t / p[1])) * x
    return p[0] * ((x + p[1]) ** 3 - p[1] ** 3)


@njit(cache=False)
def steps(
    state, memory, half, drive, rate, inverse, forces, kinds, dofs, beside, numbers, t0, dt, turn, out_x, out_v, out_a
):  # type: ignore[no-untyped-def]  # noqa: E501  # pragma: no cover
    """Advance in place; displacement, velocity and acceleration amid every step, where its force is what is held. half,
    drive : of half a step. t0 : the middle of the first step."""
    n = inverse.shape[0]
    law, kick = np.zeros(n), np.zeros(n)
    for k in range(forces.shape[0]):
        law[:] = 0.0
        t = t0 + k * dt
        state[:] = half @ state + drive @ forces[k]
        for i in range(kinds.size):
            d, (o, far) = dofs[i], beside[i]
            if kinds[i] == 11:
                bend = state[d] - 0.5 * (state[o] + state[far])
                f = push(11, numbers[i], bend, 0.0, 0.0, t, turn, 0.0)
                law[d] += f
                law[o] -= 0.5 * f
                law[far] -= 0.5 * f
                continue
            x, v = state[d], state[n + d]
            if kinds[i] == 9 or kinds[i] == FULL_LOOP:  # the latter unloads steeper than it loads, by a beta of its own
                z, beta = memory[i], 0.5 if kinds[i] == 9 else numbers[i, 2]
                memory[i] = z + dt * (v - (beta * abs(v) * z + (1 - beta) * v * abs(z)) / numbers[i, 1])
            law[d] += push(kinds[i], numbers[i], x, v, state[o], t, turn, memory[i])
        kick[:] = dt * (inverse @ law)
        state[n:] -= 0.5 * kick
        out_x[k], out_v[k] = state[:n], state[n:]
        out_a[k] = rate @ state + inverse @ (forces[k] - law)
        state[n:] -= 0.5 * kick
        state[:] = half @ state + drive @ forces[k]


def motion(
    rotor: Rotor, force: Callable[[Array, Array], Array], rate_hz: float, seconds: float, rng: np.random.Generator
) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Chunks of (forces, displacement, velocity, acceleration), each (steps, n), SI.

    force : of (steps,) s and (steps, n) N of even white noise makes the force that acts, held along a step. rate_hz :
    of the steps.
    """
    n, dt, F = len(rotor.M), 1.0 / rate_hz, rotor.flow()
    inverse = np.linalg.inv(rotor.M)
    push_in = np.vstack([np.zeros((n, n)), inverse])
    whole = expm(np.block([[F, push_in], [np.zeros((n, 3 * n))]]) * 0.5 * dt)
    half, drive = np.ascontiguousarray(whole[: 2 * n, : 2 * n]), np.ascontiguousarray(whole[: 2 * n, 2 * n :])
    kinds = np.array([LAWS.index(one.name) for one in rotor.laws], dtype=np.int64)
    dofs = np.array([one.dof for one in rotor.laws], dtype=np.int64)
    beside = np.array([one.beside for one in rotor.laws], dtype=np.int64).reshape(-1, 2)
    numbers = np.zeros((len(kinds), 5))
    for row, one in zip(numbers, rotor.laws, strict=True):
        row[: len(one.numbers)] = one.numbers
    P = rotor.covariance()
    w, U = np.linalg.eigh((P + P.T) / 2)
    state = U @ (np.sqrt(np.maximum(w, 0.0)) * rng.standard_normal(2 * n))
    memory = np.zeros(len(kinds))
    total = int(seconds * rate_hz)
    for first in range(0, total, CHUNK):
        size = min(CHUNK, total - first)
        t = (first + np.arange(size)) * dt
        forces = rng.standard_normal((size, n)) * np.sqrt(rotor.S * rate_hz / 2)
        forces = force(t, forces)
        out = np.empty((3, size, n))
        steps(state, memory, half, drive, np.ascontiguousarray(F[n:]), inverse, forces, kinds, dofs, beside, numbers,
              first * dt, dt, rotor.turn, *out)  # fmt: skip
        yield forces, *out
