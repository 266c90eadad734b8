"""Blocks of a record, their spectra, and cross-spectral Gram matrices by frequency cell.

Blocks of `size` rows overlap by half under a window whose squares add up to 1, so the blocks are a tight frame:
the sum over all bins is, by Parseval, exactly the sum over time; with the bins of the band it is the energy of the
band-limited signal. Every stretch counts alike, and the number of independent complex bins is half the number of bins
that are summed (the redundancy is 2). Because the coefficients of the balance do not depend on frequency, bins can be
added up in cells that need be narrow only where the force spectrum is not flat.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.errors import DataError

FREQUENCY_CELLS = 24  # of the band, by default


@cache
def taper(size: int) -> Array:
    """Kaiser-Bessel-derived window (alpha 3) whose squares, half a block apart, add up to 1.

    A tone is 40 dB down three bins away and 50 to 60 dB at four (a sine window: 32 and 37 dB).
    """
    rise = np.cumsum(np.kaiser(size // 2 + 1, 3.0 * np.pi))
    half = np.sqrt(rise[:-1] / rise[-1])
    return np.concatenate([half, half[::-1]])


@dataclass(frozen=True, kw_only=True)
class BlockLayout:
    """Blocks, bins and frequency cells.

    rate_hz : rows per second. size : rows of a block. bins : (b,) indices into the rfft, ascending. starts : (cells,)
    first bin of each cell. longer : factor on the usual length of the blocks.
    """

    rate_hz: float
    size: int
    bins: NDArray[np.intp]
    starts: NDArray[np.intp]
    longer: int = 1

    @property
    def hop(self) -> int:
        return self.size // 2

    @property
    def f_hz(self) -> Array:
        return np.asarray(self.bins * (self.rate_hz / self.size))

    @property
    def window(self) -> Array:
        """The window in units that make |Z|^2 a one-sided PSD."""
        return np.asarray(taper(self.size) * np.sqrt(2.0 / (self.rate_hz * self.hop)))

    @cached_property
    def per_cell(self) -> NDArray[np.intp]:
        """(cells,) number of bins."""
        return np.diff(np.append(self.starts, self.bins.size))

    @property
    def cell_of_bin(self) -> NDArray[np.intp]:
        return np.repeat(np.arange(self.starts.size), self.per_cell)

    def mean_by_cell(self, z: Array) -> Array:
        """(cells, ...) mean over the bins of each cell of z (bins, ...)."""
        return np.asarray((np.add.reduceat(z, self.starts, axis=0).T / self.per_cell).T)


@dataclass(frozen=True, slots=True)
class FrequencyNodes:
    """Frequencies at which the Jacobian is evaluated, each for `weight` neighbouring bins of one cell.

    f_hz : (nodes,) Hz. weight : (nodes,) bins. cell : (nodes,) number of the cell.
    """

    f_hz: Array
    weight: Array
    cell: NDArray[np.intp]

    def mean_by_cell(self, z: Array, per_cell: NDArray[np.intp]) -> Array:
        """(cells, ...) mean over the bins of each cell of z (nodes, ...)."""
        shape = (-1, *(1 for _ in z.shape[1:]))
        first = np.searchsorted(self.cell, np.arange(per_cell.size))
        return np.asarray(np.add.reduceat(z * self.weight.reshape(shape), first, axis=0) / per_cell.reshape(shape))


def frequency_nodes(grid: BlockLayout, peaks_hz: Array | None = None, widths_hz: Array | None = None) -> FrequencyNodes:
    """Frequencies for the Jacobian: every bin, or few where the response is smooth between resonances.

    Nodes are no farther apart than a sixth of the width at a resonance and a fifteenth of the distance from it: the
    midpoint rule is then good to 1e-3 of a standard deviation of the parameters (tested).
    """
    f, cell = grid.f_hz, grid.cell_of_bin
    if peaks_hz is None or widths_hz is None:
        return FrequencyNodes(f, np.ones(f.size), cell)
    apart = np.abs(f[:, None] - peaks_hz) / 15.0
    allowed = np.maximum(apart, widths_hz / 6.0).min(axis=1) / (grid.rate_hz / grid.size)
    starts: list[int] = []
    for a, n in zip(grid.starts, grid.per_cell, strict=True):
        step = int(np.clip(allowed[a : a + n].min(), 1, max(1, n // 3)))
        starts += range(int(a), int(a + n), step)
    after_gaps = np.flatnonzero(np.diff(grid.bins) > 1) + 1  # a node is on one side of what is left out
    at = np.union1d(starts, after_gaps)
    weight = np.diff(np.append(at, f.size)).astype(float)
    return FrequencyNodes(np.add.reduceat(f, at) / weight, weight, cell[at])


def block_layout(
    rate_hz: float,
    band: tuple[float, float],
    notches: tuple[tuple[float, float], ...] = (),
    cells: int = FREQUENCY_CELLS,
    longer: int = 1,
) -> BlockLayout:
    """Layout of blocks long enough for the lower band edge, with the bins of the band outside of notches (f1, f2), Hz.

    longer : factor on the length of the blocks, a power of 2, for narrower bins.

    Raises DataError if too few bins are left.
    """
    low, high = band
    size = longer << max(8, int(np.ceil(np.log2(32.0 * rate_hz / low))))
    f = np.arange(size // 2 + 1) * (rate_hz / size)
    keep = (f >= low) & (f <= high)
    for a, b in notches:
        keep &= (f < a) | (f > b)
    bins = np.flatnonzero(keep)
    if bins.size < 32:
        raise DataError(f"band {low:g}-{high:g} Hz leaves {bins.size} frequency bins: widen it")
    edges = np.geomspace(low, high, cells + 1)[1:-1]
    starts = np.unique(np.concatenate([[0], np.searchsorted(f[bins], edges)]))
    starts = starts[starts < bins.size]
    kept = [0]
    for s in starts[1:]:
        if s - kept[-1] >= 4:
            kept.append(int(s))
    return BlockLayout(rate_hz=rate_hz, size=size, bins=bins, starts=np.array(kept, dtype=np.intp), longer=longer)


def valid_blocks(valid: NDArray[np.bool_], grid: BlockLayout) -> NDArray[np.intp]:
    """Numbers of the blocks without an invalid row; block b starts at row b * hop."""
    if valid.size < grid.size:
        return np.empty(0, np.intp)
    bad = np.flatnonzero(~valid)
    begin = np.arange(0, valid.size - grid.size + 1, grid.hop)
    return np.flatnonzero(np.searchsorted(bad, begin + grid.size) == np.searchsorted(bad, begin))


def block_spectra(columns: Array, blocks: NDArray[np.intp], grid: BlockLayout) -> NDArray[np.complex128]:
    """(columns, blocks, bins) windowed spectra; columns (k, n) rows from the first block's row 0 on."""
    frames = np.lib.stride_tricks.sliding_window_view(columns, grid.size, axis=1)[:, :: grid.hop]
    neighbours = blocks.size > 0 and blocks[-1] - blocks[0] == blocks.size - 1
    part = frames[:, blocks[0] : blocks[-1] + 1] if neighbours else frames[:, blocks]
    z = np.fft.rfft(part * grid.window, axis=2)
    first, last = int(grid.bins[0]), int(grid.bins[-1])
    if last - first + 1 == grid.bins.size:  # no notch: a view will do
        return z[:, :, first : last + 1]
    return np.asarray(z[:, :, grid.bins])


def gram_by_cell(z: NDArray[np.complex128], grid: BlockLayout, weights: Array | None = None) -> Array:
    """(cells, k, k) real part of the sums of Z Z^H over blocks and bins of each cell. weights : (blocks,)."""
    k = z.shape[0]
    if weights is not None:
        z = z * np.sqrt(weights)[:, None]
    out = np.empty((grid.starts.size, k, k))
    stops = np.append(grid.starts, grid.bins.size)[1:]
    for c, (a, b) in enumerate(zip(grid.starts, stops, strict=True)):
        flat = np.ascontiguousarray(z[:, :, a:b]).view(np.float64).reshape(k, -1)
        out[c] = flat @ flat.T
    return out
