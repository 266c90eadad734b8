"""Sums over frequency of the rolling likelihood: log determinant, sensor noise referred to force, level.

Where the force is measured at every place there is no determinant (noise_bias.py): the slope of the residual power by
the noise of the motion sensors takes its place. Laws act along the measured motion, so nothing is taken back there.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.force_balance import Balance


@njit(cache=True, error_model="numpy", nogil=True)
def _log_determinant(inverse, R, row, column, kappa, hessian, g, h):  # type: ignore[no-untyped-def]
    entries, places = row.size, inverse.shape[1]
    Y = np.zeros((entries, places), np.complex128)
    for f in range(inverse.shape[0]):
        for e in range(entries):
            for p in range(places):
                Y[e, p] = 0.0
            for q in range(places):
                r = R[f, column[e], q]
                if r != 0.0:
                    for p in range(places):
                        Y[e, p] += r * inverse[f, q, p]
        for a in range(entries):
            i = row[a]
            g[a] += Y[a, i].real * kappa[f, i]
            if hessian:
                for b in range(a + 1):
                    y, z = Y[a, row[b]], Y[b, i]
                    h[a, b] -= (y.real * z.real - y.imag * z.imag) * np.sqrt(kappa[f, i] * kappa[f, row[b]])
    if hessian:
        for a in range(entries):
            for b in range(a):
                h[b, a] = h[a, b]


def log_determinant(
    A: Complexes, R: Complexes, row: NDArray[np.intp], column: NDArray[np.intp], kappa: Array, hessian: bool = True
) -> tuple[Array, Array]:
    """Gradient (E,) and Hessian (E, E) of 1/2 sum over f of kappa log |det A|^2 by the entries of B, A = B R.

    A : (f, P, P); R : (f, columns, P); row, column : (E,) of each entry; kappa : (f, P) weight of each place's force.
    """
    n = row.size
    g, h = np.zeros(n), np.zeros((n, n) if hessian else (0, 0))
    _log_determinant(np.linalg.inv(A), R, row, column, kappa, hessian, g, h)
    return g, h


@njit(cache=True, error_model="numpy", nogil=True)
def _noise_slope(A, R, row, column, psd, weight, cell, out):  # type: ignore[no-untyped-def]
    for f in range(A.shape[0]):
        for e in range(row.size):
            total = 0.0
            for p in range(A.shape[1]):
                a, r = A[f, row[e], p], R[f, column[e], p]
                total += (a.real * r.real + a.imag * r.imag) * psd[f, p]
            out[cell[f], e] += 2.0 * weight[f] * total


def noise_slope(
    A: Complexes,
    R: Complexes,
    row: NDArray[np.intp],
    column: NDArray[np.intp],
    psd: Array,
    weight: Array,
    cell: NDArray[np.intp],
    per_cell: NDArray[np.intp],
) -> Array:
    """(cells, E) derivative by each entry of the mean over a cell of |A|^2 psd; psd (f, P) of the sensors."""
    out = np.zeros((per_cell.size, row.size))
    _noise_slope(A, R, row, column, psd, weight, cell, out)
    return out / per_cell[:, None]


@njit(cache=True, error_model="numpy", nogil=True)
def _level(y, g, count, ratio):  # type: ignore[no-untyped-def]
    """Most likely S at this ratio of noise to S, and the cost of the ratio."""
    total, level, logs = 0.0, 0.0, 0.0
    for c in range(y.size):
        shape = 1.0 + ratio * g[c]
        total += count[c]
        level += count[c] * y[c] / shape
        logs += count[c] * np.log(shape)
    level /= total
    return level, total * np.log(level) + logs


@njit(cache=True, error_model="numpy", nogil=True)
def _levels(power, floor, count, S, noise):  # type: ignore[no-untyped-def]
    cells, places = power.shape
    y, g = np.empty(cells), np.empty(cells)
    for i in range(places):
        smallest, largest = np.inf, 0.0
        for c in range(cells):
            g[c] = floor[c, i, i]
            seen = 0.0
            for j in range(places):
                if j != i:
                    seen += floor[c, i, j] * noise[j]
            y[c] = max(power[c, i] - seen, 1e-3 * power[c, i])
            smallest, largest = min(smallest, g[c]), max(largest, g[c])
        ratio = 0.0
        S[i], best = _level(y, g, count, 0.0)
        low, high = np.log(1e-3 / largest), np.log(1e4 / smallest)
        for k in range(32):
            trial = np.exp(low + (high - low) * k / 31.0)
            level, value = _level(y, g, count, trial)
            if value < best:
                S[i], best, ratio = level, value, trial
        for narrow in (0.3, 0.03, 0.003):
            if S[i] == 0.0 or ratio == 0.0:
                break
            middle, best = ratio, np.inf
            for k in range(13):
                trial = middle * np.exp(narrow * 1.3 * (k - 6) / 6.0)
                level, value = _level(y, g, count, trial)
                if value < best:
                    S[i], best, ratio = level, value, trial
        noise[i] = S[i] * ratio


def levels(power: Array, floor: Array, count: Array, S: Array, noise: Array) -> tuple[Array, Array]:
    """(S, noise), each (places,), >= 0, that explain the cell powers best given the gain of the noise.

    The gamma likelihood of mean |F|^2 in each cell, S in closed form for every ratio noise / S, the ratio sought on a
    grid that is refined: it may have two maxima. power : (cells, P); floor : (cells, P, P), the gain; count :
    (cells,) independent bins; S, noise : (P,) where to start.
    """
    S, noise = S.copy(), noise.copy()
    _levels(power, floor, count, S, noise)
    return S, noise


def is_force_measured(balance: Balance) -> bool:
    """Whether the force is measured at every place of a balance."""
    return {c.row for c in balance.columns if c.kind == "f"} == set(range(len(balance.places)))


def noise_responses(balance: Balance, R: Complexes) -> Complexes:
    """(f, columns, places) responses by which sensor noise enters each column: R without that of laws."""
    out = R.copy()
    out[:, [c.kind == "law" for c in balance.columns]] = 0.0
    return out


def noise_bias(
    A: Complexes, R: Complexes, row: NDArray[np.intp], column: NDArray[np.intp], share: Array
) -> tuple[Array, Array]:
    """Gradient (E,) and Hessian (E, E) by the entries of B of half of sum(|A|^2 N / S_r), S_r held; A = B R.

    A : (f, P, P); R : (f, columns, P) as the noise sees them; share : (f, P, P), N of each place over S_r of each row.
    """
    seen = R[:, column]  # (f, E, P)
    own = share[:, row]
    g = np.einsum("fep,fep,fep->e", A[:, row].conj(), seen, own).real
    h = np.einsum("fap,fbp,fap->ab", seen.conj(), seen, own).real
    return g, np.where(row[:, None] == row, h, 0.0)


def residual_over_noise(power: Array, spread: Array, count: Array) -> float:
    """Residual power (cells, P) over its expected PSD `spread` (cells, P), summed. count : (cells,) bins."""
    return float(count @ (power / spread).sum(axis=1))
