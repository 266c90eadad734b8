"""Exact response of a force with memory whose states obey linear equations (a pedestal)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.thresholds import LIMITS
from estimator.model.effect import Effect


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
    states, reads = M[:n, :n], M[n]

    rates_at, modes = np.linalg.eig(states)
    apart = n > 0 and np.linalg.cond(modes) < LIMITS.max_mode_condition

    def transfer(w: Array) -> Complexes:
        iw = 1j * np.maximum(w, LIMITS.min_rad_s)
        if apart:  # a sum over the modes: many times faster than to solve at every frequency
            by_mode = (reads[:n] @ modes) * np.linalg.solve(modes, M[:n, n:]).T
            through = sum((a + iw * b) / (iw - rate) for a, b, rate in zip(*by_mode, rates_at, strict=True))
        else:
            push = M[:n, n] + iw[:, None] * M[:n, n + 1]
            through = (reads[:n] @ np.linalg.solve(iw[:, None, None] * np.eye(n) - states, push[..., None]))[..., 0]
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
