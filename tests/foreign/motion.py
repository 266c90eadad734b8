"""A rotor's motion by other means than the product's: its modes stepped exactly, laws as kicks amid the steps.

Nothing here is imported from the product: laws, units and signs are written from physics.md's text a second time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_lyapunov

Array = NDArray[np.float64]
CHUNK = 1 << 18  # steps of which forces are in memory
LAWS = (
    "cubic", "quintic", "quadratic", "clearance", "stop", "hertz", "coulomb", "quadratic_damping",
    "displacement_damping", "bouc_wen", "ball_pass", "crack", "stiffness_drift", "local_defect", "rub",
    "saturating", "rippled", "smooth",
    "smooth_friction", "smooth_clearance", "stribeck", "other_loop", "half_sine_strikes", "two_orders", "warming",
    "off_centre",
)  # fmt: skip
WITH_MEMORY = (LAWS.index("bouc_wen"), LAWS.index("other_loop"))
MAX_MODAL_ERROR = 1e-8  # of the flow put together again from its modes, relative: rounding
Rotation = Callable[[Array], Array]  # (n,) s -> (n,) rad of the shaft


@dataclass(frozen=True, slots=True, kw_only=True)
class Law:
    """One law between two points of the rotor, or a point and the ground.

    name : of `LAWS`. along : (n,) weights of the degrees of freedom that make its displacement; the force acts back by
    the same weights. across : (n,) weights of the displacement across it. numbers : up to five, SI.
    """

    name: str
    along: Array
    across: Array
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

    def modes(self) -> tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]]:
        """Of each pair one: (n,) 1/s, (2n, n) shapes of displacement and velocity, (n, 2n) what a state is of it."""
        F = self.flow()
        values, shapes = np.linalg.eig(F)
        inverse = np.linalg.inv(shapes)
        error = np.abs((shapes * values) @ inverse - F) / np.abs(F).max()
        upper = values.imag > 0
        if error.max() > MAX_MODAL_ERROR or upper.sum() != len(self.M):
            raise ValueError("the rotor has a mode that does not swing, or two that are one")
        if values.real.max() >= 0:
            raise ValueError("the rotor is not stable")
        return values[upper], shapes[:, upper], inverse[upper]


@njit(cache=False)
def push(kind, p, x, v, xo, t, angle, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Restoring force of one law, N; of a shaft x is disc less mean of the caps. angle : rad of the shaft."""
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
        return (p[0] * np.cos(p[2] * angle) + p[1] * np.sin(p[2] * angle)) * x
    if kind == 11:
        return -(p[0] + p[1] * np.cos(angle) + p[2] * np.sin(angle)) * x
    if kind == 12:
        return (p[0] * t + 0.5 * p[1] * t * t) * x
    if kind == 13:
        return -p[0] * np.exp(-((p[1] * angle - p[2]) % (2 * np.pi)) / p[3])
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
        if angle == 0.0:
            return 0.0
        period = 2 * np.pi * t / (p[1] * angle)
        n = np.floor(t / period)
        late = (np.sin(12.9898 * (n + p[2])) * 43758.5453) % 1.0 - 0.5
        since = t - n * period - (0.3 + p[4] * late) * period
        return -p[0] * np.sin(np.pi * since / p[3]) if 0.0 < since < p[3] else 0.0
    if kind == 23:
        passed = p[2] * angle
        return (p[0] * np.cos(passed) + p[1] * np.sin(passed) + 0.4 * p[0] * np.cos(2 * passed)) * x
    if kind == 24:
        return p[0] * (1.0 - np.exp(-t / p[1])) * x
    return p[0] * ((x + p[1]) ** 3 - p[1] ** 3)


@njit(cache=False)
def steps(
    modes,
    memory,
    half,
    drive,
    forces,
    kinds,
    numbers,
    at,
    kicks,
    t0,
    dt,
    angles,
    seen,
    seen_a,
    through,
    pulled,
    out,
    laws,
):  # type: ignore[no-untyped-def]  # noqa: E501  # pragma: no cover
    """Advance `modes` in place. Amid every step, where its force is what is held: displacement, velocity and
    acceleration of what is seen in `out`, the forces of the laws in `laws`. t0 : the middle of the first step."""
    for k in range(forces.shape[0]):
        f, t = forces[k], t0 + k * dt
        for i in range(modes.size):
            q = modes[i] * half[i]
            for j in range(f.size):
                q += drive[i, j] * f[j]
            modes[i] = q
        for i in range(kinds.size):
            x = v = xo = 0.0
            for j in range(modes.size):
                x += (at[0, i, j] * modes[j]).real
                v += (at[1, i, j] * modes[j]).real
                xo += (at[2, i, j] * modes[j]).real
            p = numbers[i]
            if kinds[i] == WITH_MEMORY[0] or kinds[i] == WITH_MEMORY[1]:  # the second unloads steeper than it loads
                z, beta = memory[i], 0.5 if kinds[i] == WITH_MEMORY[0] else p[2]
                memory[i] = z + dt * (v - (beta * abs(v) * z + (1 - beta) * v * abs(z)) / p[1])
            laws[k, i] = push(kinds[i], p, x, v, xo, t, angles[k], memory[i])
        for i in range(kinds.size):
            for j in range(modes.size):
                modes[j] -= 0.5 * kicks[j, i] * laws[k, i]
        for i in range(seen.shape[1]):
            x = v = a = 0.0
            for j in range(modes.size):
                q = modes[j]
                x += (seen[0, i, j] * q).real
                v += (seen[1, i, j] * q).real
                a += (seen_a[i, j] * q).real
            for j in range(f.size):
                a += through[i, j] * f[j]
            for j in range(kinds.size):
                a -= pulled[i, j] * laws[k, j]
            out[0, k, i], out[1, k, i], out[2, k, i] = x, v, a
        for i in range(modes.size):
            q = modes[i]
            for j in range(kinds.size):
                q -= 0.5 * kicks[i, j] * laws[k, j]
            q *= half[i]
            for j in range(f.size):
                q += drive[i, j] * f[j]
            modes[i] = q


def motion(
    rotor: Rotor, force: Callable[[Array, Array], Array], rate_hz: float, seconds: float, rng: np.random.Generator,
    rotation: Rotation | None = None, seen: Array | None = None, driven: list[int] | None = None,
) -> Iterator[tuple[Array, Array, Array, Array, Array]]:  # fmt: skip
    """Chunks of (forces (steps, driven), displacement, velocity, acceleration (steps, seen), laws (steps, laws)), SI.

    force : of (steps,) s and (steps, driven) N of even white noise makes the force that acts, held along a step.
    rate_hz : of the steps. rotation : of the shaft, even at `rotor.turn` if None. seen : (seen, n) weights of the
    degrees of freedom, each by itself if None. driven : degrees of freedom that a force acts on, all if None.
    """
    n, dt = len(rotor.M), 1.0 / rate_hz
    seen = np.eye(n) if seen is None else seen
    driven = list(range(n)) if driven is None else driven
    inverse = np.linalg.inv(rotor.M)
    values, shapes, left = rotor.modes()
    x_of, v_of, push_in = 2 * shapes[:n], 2 * shapes[n:], left[:, n:] @ inverse  # twice: of each pair one is stepped
    half = np.exp(values * dt / 2)
    drive = ((half - 1) / values)[:, None] * push_in[:, driven]
    along = np.array([one.along for one in rotor.laws]).reshape(-1, n)
    across = np.array([one.across for one in rotor.laws]).reshape(-1, n)
    kinds = np.array([LAWS.index(one.name) for one in rotor.laws], dtype=np.int64)
    numbers = np.zeros((len(kinds), 5))
    for row, one in zip(numbers, rotor.laws, strict=True):
        row[: len(one.numbers)] = one.numbers
    at = np.stack([along @ x_of, along @ v_of, across @ x_of])
    P = rotor.covariance()
    w, U = np.linalg.eigh((P + P.T) / 2)
    modes = left @ (U @ (np.sqrt(np.maximum(w, 0.0)) * rng.standard_normal(2 * n)))
    memory = np.zeros(len(kinds))
    total = int(seconds * rate_hz)
    for first in range(0, total, CHUNK):
        size = min(CHUNK, total - first)
        t = (first + np.arange(size)) * dt
        forces = rng.standard_normal((size, len(driven))) * np.sqrt(rotor.S[driven] * rate_hz / 2)
        forces = force(t, forces)
        angles = rotor.turn * t if rotation is None else rotation(t)
        out, laws = np.empty((3, size, len(seen))), np.empty((size, len(kinds)))
        steps(
            modes, memory, half, drive, forces, kinds, numbers, at, dt * (push_in @ along.T), first * dt, dt, angles,
            np.stack([seen @ x_of, seen @ v_of]), (seen @ v_of) * values, seen @ inverse[:, driven],
            seen @ inverse @ along.T, out, laws,
        )  # fmt: skip
        yield forces, *out, laws
