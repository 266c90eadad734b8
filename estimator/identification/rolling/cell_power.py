"""The power of the residual force in cells of frequency, as the memory of a rolling fit has it.

It shows sensor noise other than that of the anchor, and a spectrum that no force and no noise of the model explains.
"""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.fitting.noise_level import MIN_NOISE_RATIO, grid_minimum

from .anchor import Anchor
from .memory import Memory

MIN_GAIN_NATS = 5.0  # of other sensor noise than that of the anchor, at any place
MIN_BLOCKS = 12.0  # of the memory
NOISE_GRID_POINTS = 61
MAX_COLOUR_P = 1e-8  # of the power of a cell, by chance: with 50 cells one false reason in a million estimates


def cell_power(anchor: Anchor, memory: Memory, delta: Array) -> tuple[Array, Array]:
    """Power of the whitened residual force in a memory, (places, cells) N^2/Hz, and the weighted number of bins of each
    cell, (cells,). The power is a sum over the bins and the weighted blocks. delta : (k,) increments, scaled."""
    b, K = np.append(1.0, delta), 1 + anchor.own
    power = np.einsum("a,ciab,b->ic", b, memory.gram[:, :, :K, :K], b)
    return power, np.add.reduceat(memory.kept, anchor.cells)


def excess_power(anchor: Anchor, memory: Memory, delta: Array) -> list[tuple[float, float]]:
    """For every place what the cell that stands out most has more than the model, relative, and its frequency, Hz.

    0 where none stands out by more than chance, or where a force is measured. delta : (k,) increments, scaled.
    """
    from scipy.special import chdtr, chdtrc

    if anchor.data.measured_force:
        return [(0.0, 0.0)] * len(anchor.data.places)
    powers, bins = cell_power(anchor, memory, delta)
    f_hz = anchor.data.f_hz
    middle = np.array([0.5 * (f_hz[c.start] + f_hz[c.stop - 1]) for c in anchor.cell_slices])
    n, freedom = np.maximum(bins, 1e-300), 2.0 * bins * memory.n / memory.n2
    ratio = powers / n / (powers.sum(axis=1, keepdims=True) / n.sum())
    p = np.minimum(chdtr(freedom, freedom * ratio), chdtrc(freedom, freedom * ratio))
    told = (p < MAX_COLOUR_P) & (bins > 0.0)
    worst = np.argmax(np.where(told, np.maximum(ratio, 1.0 / np.maximum(ratio, 1e-300)), 0.0), axis=1)
    at = np.arange(len(powers)), worst
    return list(zip(np.where(told[at], ratio[at] - 1.0, 0.0).tolist(), middle[worst].tolist(), strict=True))


def renewed_noise(anchor: Anchor, memory: Memory, delta: Array) -> tuple[Array, Array] | None:
    """nu and S, (places,) each, if the memory contradicts the sensor noise of the anchor; None otherwise.

    delta : (k,) increments, scaled.
    """
    data = anchor.data
    if memory.n < MIN_BLOCKS:
        return None
    powers, bins = cell_power(anchor, memory, delta)
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
    n, nu, S, gained = bins[used], anchor.nu.copy(), anchor.S.copy(), 0.0
    for i, z in enumerate(powers[:, used]):
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
