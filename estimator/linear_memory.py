"""Forces with memory whose states obey linear equations (a pedestal): their response to motion, exactly; and what a
response makes of a series."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .effect import Effect

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
SLOWEST = 1e-3  # rad/s: a state that only integrates has no response at rest


def response(effect: Effect, p: Array, lin: Array) -> Callable[[Array], Complexes] | None:
    """Force per displacement, N/m, at w (f,) rad/s, for parameters p and (m, kL, c); None if not linear."""
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
    states, reads = M[:n, :n], M[n]

    def transfer(w: Array) -> Complexes:
        iw = 1j * np.maximum(w, SLOWEST)
        z = np.linalg.solve(iw[:, None, None] * np.eye(n) - states, (M[:n, n] + iw[:, None] * M[:n, n + 1])[..., None])
        return np.asarray((reads[:n] @ z)[..., 0] + reads[n] + iw * reads[n + 1])

    return transfer


def filtered(response: Callable[[Array], Complexes], x: Array, rate_hz: float) -> Array:
    """(n,) what a response at w (f,) rad/s makes of a series (n,)."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(x.size, real=True)
    f: Array = np.asarray(np.fft.rfftfreq(size, 1 / rate_hz), dtype=np.float64)
    return np.asarray(irfft(rfft(x, size) * response(2 * np.pi * f), size)[: x.size])
