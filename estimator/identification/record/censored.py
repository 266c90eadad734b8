"""Samples of a Gaussian process that are known only to lie beyond a bound, drawn as the others let them be.

A run of them is drawn together, along the principal axes of its covariance given all else, in turn from what its bounds
leave of each (Gibbs sampling of a truncated normal in coordinates where its parts are nearly independent: Geweke,
Comput. Sci. Stat. 23, 1991, 571; each by a slice: Damien & Walker, J. Comput. Graph. Stat. 10, 2001, 206). Sample by
sample a smooth run moves no more than what is unpredictable of one: of a velocity at 20 samples a period the draws had
not left the bounds after 24 turns.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.arrays import Array

MAX_RUN_SAMPLES = 48  # samples drawn together
AXIS_TURNS = 2  # of the axes, each time


def runs(rows: NDArray[np.intp], sides: Array) -> NDArray[np.intp]:
    """(runs + 1,) where runs of neighbours on one side begin in rows (n,), none longer than LONGEST, and n."""
    new = np.append(True, (np.diff(rows) != 1) | (np.diff(sides) != 0))
    first = np.flatnonzero(new)
    within = np.arange(rows.size) - first[np.cumsum(new) - 1]
    return np.append(np.flatnonzero(within % MAX_RUN_SAMPLES == 0), rows.size)


def axes(precision: Array) -> Array:
    """(LONGEST, LONGEST, LONGEST) by length - 1, padded: the principal axes of a run, (samples, axes), times their
    standard deviations. precision : (lags,) of the samples of the process."""
    from scipy.linalg import eigh, toeplitz

    out = np.zeros((MAX_RUN_SAMPLES,) * 3)
    row = np.zeros(MAX_RUN_SAMPLES)
    row[: precision.size] = precision[:MAX_RUN_SAMPLES]
    for k in range(MAX_RUN_SAMPLES):
        q, V = eigh(toeplitz(row[: k + 1]))
        out[k, : k + 1, : k + 1] = V / np.sqrt(np.maximum(q, 1e-12 * q[-1]))
    return out


@njit(cache=True)
def sweep(
    z: Array, rows: NDArray[np.intp], begins: NDArray[np.intp], sides: Array, limits: Array, precision: Array,
    axes: Array, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Every run of z once, in place. rows, sides (1 or -1), limits : (n,) of the samples: side z[row] >= limit."""
    most, reach = axes.shape[1], precision.size - 1
    u, slack, pull, e = np.empty(most), np.empty(most), np.empty(most), np.empty(most)
    for k in range(begins.size - 1):
        first, size = begins[k], begins[k + 1] - begins[k]
        row, side, A = rows[first], sides[first], axes[size - 1]
        for i in range(size):
            u[i] = side * z[row + i]
            slack[i] = u[i] - limits[first + i]
            pull[i] = 0.0
            for lag in range(i + 1, reach + 1):
                pull[i] += precision[lag] * z[row + i - lag]
            for lag in range(size - i, reach + 1):
                pull[i] += precision[lag] * z[row + i + lag]
            pull[i] *= side
        for j in range(size):  # the mean is -A A' pull, and u - mean is A e
            pulled, squared, along = 0.0, 0.0, 0.0
            for i in range(size):
                pulled += A[i, j] * pull[i]
                squared += A[i, j] ** 2
                along += A[i, j] * u[i]
            e[j] = pulled + along / squared
        for _ in range(AXIS_TURNS):
            for j in range(size):
                far = np.sqrt(e[j] ** 2 + 2.0 * rng.standard_exponential())
                low, high = -far - e[j], far - e[j]
                for i in range(size):
                    if A[i, j] > 0.0:
                        low = max(low, -slack[i] / A[i, j])
                    elif A[i, j] < 0.0:
                        high = min(high, -slack[i] / A[i, j])
                if high > low:
                    by = low + (high - low) * rng.random()
                    e[j] += by
                    for i in range(size):
                        u[i] += A[i, j] * by
                        slack[i] += A[i, j] * by
        for i in range(size):
            z[row + i] = side * max(u[i], limits[first + i])
