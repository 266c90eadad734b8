"""Level of the sensor noise, from the spectrum of the residual force."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.thresholds import LIMITS
from estimator.likelihood.whitening.sensor_noise import referred_psd
from estimator.parallel import map_threads

MIN_NOISE_RATIO = 1e-4  # sensor noise referred to force over S, least that is searched


def sensor_noise_ratio(point: WorkingPoint) -> tuple[Array, Array]:
    """(places,) nu, PSD of the sensor noise over S, by maximum likelihood on the spectrum of the residual force.

    Also (places,) the mean over the band of nu = 1 referred to force, over S.
    """
    data = point.data
    referred = data.noise_referred_to_force(point.A)
    noise = referred_psd(data, point.A, point.nu * point.S) / point.S[:, None]
    known = data.excitation_shape + noise - point.nu[:, None] * referred
    known = np.maximum(known, LIMITS.min_shape_rel * known.max(axis=1, keepdims=True))
    weight = referred.mean(axis=1)

    def at(i: int) -> float:
        step = point.fit.delta[point.whitened.index[i]].astype(np.float32)  # the noise is of the values after it
        Z = point.spectra[i] + np.tensordot(step, point.whitened.spectra[i], 1)
        Z = Z.reshape(data.blocks, -1, 2)
        power = np.einsum("bkc,bkc->k", Z, Z) / data.blocks / point.whitening.weight[i]
        grid = np.concatenate([[0.0], np.geomspace(MIN_NOISE_RATIO, 1e3, 61) / weight[i]])
        shape = known[i] + grid[:, None] * referred[i]
        S = np.mean(power / shape, axis=1)
        cost = np.log(S) + np.mean(np.log(shape), axis=1)
        return grid_minimum(grid, cost)

    return np.array(map_threads(at, range(len(data.places)))), weight


def grid_minimum(grid: Array, cost: Array) -> float:
    """The point of least cost between those of a geometric grid whose first point is 0: the vertex of a parabola."""
    k = int(np.argmin(cost))
    if k < 2 or k == grid.size - 1:
        return float(grid[k])
    before, here, after = cost[k - 1 : k + 2]
    bend = before - 2 * here + after
    shift = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return float(grid[k] * (grid[k + 1] / grid[k]) ** shift)
