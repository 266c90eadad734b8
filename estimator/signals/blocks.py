"""Blocks of a record and their spectra under a window.

Blocks of `size` rows overlap by half under a window whose squares add up to 1, so the blocks are a tight frame:
the sum over all bins is, by Parseval, exactly the sum over time; with the bins of the band it is the energy of the
band-limited signal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.errors import DataError


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
    """Blocks and bins.

    rate_hz : rows per second. size : rows of a block. bins : (b,) indices into the rfft, ascending.
    """

    rate_hz: float
    size: int
    bins: NDArray[np.intp]

    @property
    def hop(self) -> int:
        """Rows from one block to the next."""
        return self.size // 2

    @property
    def f_hz(self) -> Array:
        """(b,) Hz."""
        return np.asarray(self.bins * (self.rate_hz / self.size))

    @property
    def window(self) -> Array:
        """The window in units that make |Z|^2 a one-sided PSD."""
        return np.asarray(taper(self.size) * np.sqrt(2.0 / (self.rate_hz * self.hop)))


def block_layout(
    rate_hz: float, band: tuple[float, float], notches: tuple[tuple[float, float], ...] = ()
) -> BlockLayout:  # fmt: skip
    """Layout of blocks long enough for the lower band edge, with the bins of the band outside of notches (f1, f2), Hz.

    Raises DataError if too few bins are left.
    """
    low, high = band
    size = 1 << max(8, int(np.ceil(np.log2(32.0 * rate_hz / low))))
    f = np.arange(size // 2 + 1) * (rate_hz / size)
    keep = (f >= low) & (f <= high)
    for a, b in notches:
        keep &= (f < a) | (f > b)
    bins = np.flatnonzero(keep)
    if bins.size < 32:
        raise DataError(f"band {low:g}-{high:g} Hz leaves {bins.size} frequency bins: widen it")
    return BlockLayout(rate_hz=rate_hz, size=size, bins=bins)


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
