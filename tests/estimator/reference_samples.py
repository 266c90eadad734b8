"""Records to test against that the product's simulator did not make: rejection samples of exp(-V/T), a BAOAB Langevin
integrator (another scheme than the product's), for one or two caps."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def boltzmann(n: int, kL: Array, kNL: Array, coupling: Array, temperature: float, seed: int) -> Array:
    """(n, d) exact samples of exp(-V/T), V = sum kL x^2/2 + kNL x^4/4 + x' coupling x / 2, kNL >= 0, by rejection."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(np.linalg.inv(np.diag(kL) + coupling) * temperature)
    out: list[Array] = []
    have = 0
    while have < n:
        x = rng.standard_normal((n, len(kL))) @ root.T
        keep = x[rng.random(n) < np.exp(-(kNL * x**4).sum(axis=1) / (4.0 * temperature))]
        out.append(keep)
        have += len(keep)
    return np.concatenate(out)[:n]


@numba.njit(cache=True)
def _force(x, kL, kNL, K, force):  # type: ignore[no-untyped-def]
    for i in range(x.size):
        force[i] = -(kL[i] * x[i] + kNL[i] * x[i] ** 3)
        for j in range(x.size):
            force[i] -= K[i, j] * x[j]


@numba.njit(cache=True)
def _baoab(m, c, kL, kNL, K, noise, dt, n, sub, start, gauss):  # type: ignore[no-untyped-def]
    d = m.size
    x, v, force = start[0].copy(), start[1].copy(), np.zeros(d)
    decay = np.exp(-c / m * dt)
    kick = np.zeros(d)
    for i in range(d):
        if c[i] > 0.0:
            kick[i] = np.sqrt(noise[i] / (2.0 * c[i] * m[i]) * (1.0 - decay[i] ** 2))
    X, V = np.empty((n, d)), np.empty((n, d))
    for t in range(n * sub):
        _force(x, kL, kNL, K, force)
        for i in range(d):
            v[i] += 0.5 * dt * force[i] / m[i]
            x[i] += 0.5 * dt * v[i]
            v[i] = decay[i] * v[i] + kick[i] * gauss[t, i]
            x[i] += 0.5 * dt * v[i]
        _force(x, kL, kNL, K, force)
        for i in range(d):
            v[i] += 0.5 * dt * force[i] / m[i]
        if t % sub == sub - 1:
            X[t // sub], V[t // sub] = x, v
    return X, V


def langevin(m, c, kL, kNL, K, Q, rate_hz, n, seed, sub=8, burn_s=0.05):  # type: ignore[no-untyped-def]
    """(x, v), each (n, d), of M a + C v + kL x + kNL x^3 + K x = F with E[F F'] = Q delta; started near equilibrium."""
    rng = np.random.default_rng(seed)
    m, c, kL, kNL, Q = (np.asarray(q, float) for q in (m, c, kL, kNL, Q))
    temperature = np.max(np.where(c > 0.0, Q / np.where(c > 0.0, 2.0 * c, 1.0), 0.0))
    cov = np.linalg.inv(np.diag(kL) + K) * temperature
    start = np.stack([np.linalg.cholesky(cov) @ rng.standard_normal(m.size), rng.standard_normal(m.size)])
    start[1] *= np.sqrt(temperature / m)
    burn = int(burn_s * rate_hz)
    gauss = rng.standard_normal(((n + burn) * sub, m.size))
    x, v = _baoab(m, c, kL, kNL, K, Q, 1.0 / rate_hz / sub, n + burn, sub, start, gauss)
    return x[burn:], v[burn:]
