"""Sensor noise as the memory of a rolling fit shows it, by the power of the residual force in cells of frequency."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.fitting.noise_level import MIN_NOISE_RATIO, grid_minimum

from .anchor import Anchor
from .memory import Memory

MIN_GAIN_NATS = 5.0  # of other sensor noise than that of the anchor, at any place
MIN_BLOCKS = 12.0  # of the memory
NOISE_GRID_POINTS = 61


def renewed_noise(anchor: Anchor, memory: Memory, delta: Array) -> tuple[Array, Array] | None:
    """nu and S, (places,) each, if the memory contradicts the sensor noise of the anchor; None otherwise.

    delta : (k,) increments, scaled.
    """
    data, K = anchor.data, anchor.own
    if memory.n < MIN_BLOCKS or data.residual_is_noise:
        return None
    b = np.append(1.0, delta)
    power = np.einsum("a,ciab,b->ic", b, memory.gram[:, :, : 1 + K, : 1 + K], b)
    n = np.add.reduceat(memory.kept, anchor.cells)
    share = np.add.reduceat(memory.kept, anchor.first)  # of the nodes
    cell = np.searchsorted(anchor.cells, anchor.nodes, side="right") - 1
    used = np.flatnonzero(np.bincount(cell, share, anchor.cells.size) > 0.0)

    def by_cell(z: Array) -> Array:
        """(..., cells) mean of z (..., nodes) over the nodes of each cell."""
        weights = (cell == np.arange(anchor.cells.size)[:, None]) * share
        return np.asarray(z @ weights[used].T / weights[used].sum(axis=1))

    gain = np.abs(anchor.A) ** 2  # (nodes, places, places)
    shape, W = data.noise_shape[:, anchor.nodes], anchor.whitening.weight[:, anchor.nodes]
    own = np.einsum("kii->ik", gain) * shape
    known = data.excitation_shape[:, anchor.nodes] - own * anchor.nu[:, None]
    known += np.einsum("kil,lk->ik", gain, shape * (anchor.nu * anchor.S)[:, None]) / anchor.S[:, None]
    n, nu, S, gained = n[used], anchor.nu.copy(), anchor.S.copy(), 0.0
    for i, z in enumerate(power[:, used]):
        grid = np.concatenate([[0.0], np.geomspace(MIN_NOISE_RATIO, 1e3, NOISE_GRID_POINTS) / own[i].mean()])

        def fit(ratio: Array, i: int = i, z: Array = z) -> tuple[Array, Array]:
            """Nats below the maximum and S at noise ratios."""
            psd = by_cell(W[i] * (known[i] + ratio[:, None] * own[i]))
            level = (z / psd).sum(axis=1) / n.sum()
            return n.sum() * np.log(level) + np.log(psd) @ n, level

        cost, _ = fit(grid)
        best = grid_minimum(grid, cost)
        ends, levels = fit(np.array([anchor.nu[i], best]))
        nu[i], S[i] = best, levels[1]
        gained = max(gained, float(ends[0] - ends[1]))
    return (nu, S) if gained > MIN_GAIN_NATS else None
