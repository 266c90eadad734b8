"""Forces with memory whose states obey nonlinear equations (Bouc-Wen): force along the motion, and mean response.

The states are integrated on a grid finer than the samples, with band-limited interpolation of the motion.

The likelihood needs the mean response <T(f)> of the force to an added small displacement. It is the average over small
steps of displacement that are launched all along the path. A regression of the force on the motion would be biased, as
the motion is not Gaussian.

The step responses follow from the states and the force linearised about the path.
Over a step of the grid the states change by A dZ + b (x0 + x1)/2 + d (x1 - x0), and the force by r dZ + s x + u v, for
a small change dZ of the states and a small motion x, v. All six are derivatives of the integrator itself, so what is
made of them is the derivative of the force that the path is given, kinks included.

Exact response of a force with memory whose states obey linear equations (a pedestal).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from estimator.arrays import Array, Complexes, Series
from estimator.effects.engine.memory_loop import LinearisedMemory, force_along_path, reads_motion
from estimator.likelihood.thresholds import LIMITS
from estimator.model.effect import Effect

from .law_smoothing import MARGIN_ROWS, decimated, interpolated


def state_matrix(effect: Effect, p: Array, lin: Array) -> Array | None:
    """(n + 1, n + 2) derivatives of dz/dt of the n states and of the force by (z, x, v); None if not linear.

    p : parameters of the law, SI. lin : (3,) m, kL, c of the bearing cap.
    """
    n = effect.states
    rates, force = effect.rates, effect.memory_force
    if rates is None or force is None:
        return None

    def seen(u: Array) -> Array:
        """(n + 1,) dz/dt and force at u = (z, x, v)."""
        dz = np.zeros(n + 1)
        rates(u[:n], u[n], u[n + 1], p, lin, dz)
        dz[n] = force(u[:n], u[n], u[n + 1], p, lin)
        return dz

    M = np.stack([seen(one) for one in np.eye(n + 2)], axis=1)
    for u in np.random.default_rng(0).normal(size=(4, n + 2)):
        if not np.allclose(seen(u), M @ u, rtol=1e-6, atol=1e-9 * np.abs(M).max()):
            return None
    return M


def linear_response(effect: Effect, p: Array, lin: Array) -> Callable[[Array], Complexes] | None:
    """Function of w (f,) rad/s: force per displacement, N/m; None if not linear. lin : (3,) m, kL, c."""
    n, M = effect.states, state_matrix(effect, p, lin)
    if M is None:
        return None
    own, reads = M[:n, :n], M[n]

    rates_at, modes = np.linalg.eig(own)
    apart = n > 0 and np.linalg.cond(modes) < LIMITS.max_mode_condition

    def transfer(w: Array) -> Complexes:
        iw = 1j * np.maximum(w, LIMITS.min_rad_s)
        if apart:  # a sum over the modes: many times faster than to solve at every frequency
            by_mode = (reads[:n] @ modes) * np.linalg.solve(modes, M[:n, n:]).T
            through = sum((a + iw * b) / (iw - rate) for a, b, rate in zip(*by_mode, rates_at, strict=True))
        else:
            push = M[:n, n] + iw[:, None] * M[:n, n + 1]
            through = (reads[:n] @ np.linalg.solve(iw[:, None, None] * np.eye(n) - own, push[..., None]))[..., 0]
        return np.asarray(through + reads[n] + iw * reads[n + 1])

    return transfer


def response_derivative(effect: Effect, p: Array, lin: Array, which: int) -> Callable[[Array], Complexes] | None:
    """Derivative of the linear response by the cap's stiffness kL (which = 1) or damping c (2).

    None if the law is not linear, or its response does not depend on the parameter.
    """
    step = LIMITS.derivative_step_rel * np.eye(3)[which] * abs(lin[which])
    up, down = linear_response(effect, p, lin + step), linear_response(effect, p, lin - step)
    if up is None or down is None or not step.any():
        return None
    w = np.sqrt(max(lin[1] / lin[0], 1.0)) * np.array([0.5, 1.5])
    if np.allclose(up(w), down(w), rtol=1e-9):
        return None
    return lambda w: (up(w) - down(w)) / (2 * step[which])


def filtered_series(response: Callable[[Array], Complexes], x: Array, rate_hz: float, by: int = 1) -> Array:
    """(by n,) series (n,) filtered by a response at w (f,) rad/s, at `by` times its rate (periodic at the ends)."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(x.size, real=True)
    f: Array = np.asarray(np.fft.rfftfreq(size, 1 / rate_hz), dtype=np.float64)
    return np.asarray(irfft(rfft(x, size) * response(2 * np.pi * f), by * size)[: by * x.size] * by)


@dataclass(frozen=True, slots=True)
class MeanResponse:
    """Mean response of a force to displacement.

    taps : (lags,) N/m, force per past displacement, dt apart. dt : s. tangent : N s/m, to velocity alone.
    """

    taps: Array
    dt: float
    tangent: float

    def at(self, f_hz: Array) -> Complexes:
        """(f,) N/m."""
        size = 1 << int(np.ceil(np.log2(8 * self.taps.size)))
        f, z = np.fft.rfftfreq(size, self.dt), np.fft.rfft(self.taps, size)
        return np.interp(f_hz, f, z.real) + 1j * (np.interp(f_hz, f, z.imag) + 2 * np.pi * f_hz * self.tangent)


def memory_force_and_response(
    effect: Effect, p: Array, lin: Array, x: Series, v: Series, rate_hz: float
) -> tuple[Array, MeanResponse]:
    """Force (n,) N along a path, states from rest, and its mean response. lin : (3,) m, kL, c."""
    n, rate = x.size, LIMITS.memory_grid_factor * rate_hz
    mean = StepResponses(x, v, 1.0 / rate)
    out, start = np.empty(n), np.zeros(effect.states)
    fast, stride = (
        reads_motion(effect, p, lin)[1],
        min(max(n // LIMITS.memory_rows_per_piece // LIMITS.min_pieces, 1), LIMITS.max_piece_stride),
    )
    for a in range(0, n, LIMITS.memory_rows_per_piece):
        b = min(a + LIMITS.memory_rows_per_piece, n)
        rows = np.clip(np.arange(a - MARGIN_ROWS, b + MARGIN_ROWS), 0, n - 1)
        fine = interpolated(x[rows], LIMITS.memory_grid_factor)
        speed = interpolated(v[rows], LIMITS.memory_grid_factor) if fast else np.zeros_like(fine)
        stepped = a // LIMITS.memory_rows_per_piece % stride == 0
        force, states, about = force_along_path(effect, p, lin, fine, speed, 1.0 / rate, start, stepped)
        start = states[(b - a) * LIMITS.memory_grid_factor].copy()  # where the next piece begins
        out[a:b] = decimated(force, LIMITS.memory_grid_factor)
        if about is not None:
            mean.add(about)
    return out, mean.response()


class StepResponses:
    """Sums of step responses along a path x, v (any rate), on rows dt apart."""

    def __init__(self, x: Series, v: Series, dt: float) -> None:
        cycle = 2 * np.pi * float(np.sqrt(np.dot(x, x) / np.dot(v, v))) / dt  # rows
        self.dt, self.stride = dt, max(1, int(cycle / LIMITS.steps_per_cycle))
        self.sums, self.counts = np.zeros((2, int(LIMITS.memory_cycles * cycle) + 2))
        self.rows, self.tangent = 0, 0.0

    def add(self, about: LinearisedMemory) -> None:
        """Add the step responses along a piece of the path."""
        _launch(about.step, about.force, self.stride, LIMITS.followed_halvings, self.sums, self.counts)
        self.rows, self.tangent = self.rows + len(about.force), self.tangent + float(about.force[:, -1].sum())

    def response(self) -> MeanResponse:
        return MeanResponse(self.sums / np.maximum(self.counts, 1.0), self.dt, self.tangent / max(self.rows, 1))


@njit(cache=True, error_model="numpy", nogil=True)
def _launch(step, force, stride, halvings, sums, counts):  # type: ignore[no-untyped-def]
    """Add to sums (lags,) what displacement that rises by 1 over a step of the grid adds to the force from row to row,
    a rise every `stride` rows; to counts (lags,) how many there were."""
    n, S = step.shape[:2]
    z, after = np.zeros(S), np.zeros(S)
    number = 0
    for i in range(0, n - 1, stride):
        number += 1
        followed = 0  # how often 2 divides the number
        while followed < halvings and (number >> followed) % 2 == 0:
            followed += 1
        life = sums.size >> (halvings - followed)
        if i + 1 + life > n:
            continue
        for j in range(S):
            z[j] = step[i, j, S + 1] + 0.5 * step[i, j, S]
        before = 0.0
        for k in range(life):
            row = i + 1 + k
            f = force[row, S]
            for j in range(S):
                f += force[row, j] * z[j]
            sums[k] += f - before
            counts[k] += 1.0
            before = f
            for j in range(S):
                a = step[row, j, S]
                for other in range(S):
                    a += step[row, j, other] * z[other]
                after[j] = a
            for j in range(S):
                z[j] = after[j]
