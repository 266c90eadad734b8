"""Spectra and Gram matrices of half-overlapping blocks as they come, one at a time.

A law is evaluated once for every row: what it gave over the second half of a block is the first half of the next. The
transforms are single precision, each column scaled to about 1 before: their rounding, 1e-7 of a column's rms, is spread
over all bins and stays far below the random force wherever the resonance is less sharp than a million to one. Products
and sums are double, for there the terms of the balance cancel.
"""

from __future__ import annotations

from math import isfinite

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.signals.blocks import BlockLayout

from .law_columns import Columns, Stretch
from .law_smoothing import MARGIN_ROWS, LawStates

Complex64s = NDArray[np.complex64]


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"reassoc", "contract"})
def _windowed(first, second, window, out):  # type: ignore[no-untyped-def]
    """Fill out (2 n,), single, with `first` and `second` (n,) under the window over their mean size, returned."""
    n, total = first.size, 0.0
    for i in range(n):
        total += abs(first[i]) + abs(second[i])
    size = total / (2 * n)
    if not size > 0.0:  # nothing there, or not a number
        out[:] = 0.0
        return size
    for i in range(n):
        out[i] = first[i] * (window[i] / size)
        out[n + i] = second[i] * (window[n + i] / size)
    return size


@njit(cache=True, error_model="numpy", nogil=True)
def _doubled(z, sizes, weights, out):  # type: ignore[no-untyped-def]
    """Fill out (k, 2 b), double, with z (k, 2 b), single, times the size of its row and the weight of its bin (b,)."""
    for k in range(z.shape[0]):
        for b in range(weights.size):
            w = sizes[k] * weights[b]
            out[k, 2 * b] = z[k, 2 * b] * w
            out[k, 2 * b + 1] = z[k, 2 * b + 1] * w


class Spectra:
    """Of one block. z : (columns, bins) in units of `sizes` (columns,)."""

    def __init__(self, z: Complex64s, sizes: Array) -> None:
        self.z, self.sizes = z, sizes

    def force(self, B: Array, columns: NDArray[np.intp]) -> Complex64s:
        """(rows, bins) B Z, B (rows, len(columns)) the coefficients of these columns."""
        parts = self.z[columns].view(np.float32)
        return np.asarray(((B * self.sizes[columns]).astype(np.float32) @ parts).view(np.complex64))

    def gram(self, grid: BlockLayout, weights: Array | None = None) -> Array:
        """(cells, k, k) real part of the sums of Z Z^H over the bins of each cell. weights : (bins,)."""
        k, bins = self.z.shape
        root = np.ones(bins) if weights is None else np.sqrt(weights)
        flat = np.empty((k, 2 * bins))
        _doubled(self.z.view(np.float32), self.sizes, root, flat)
        out = np.empty((grid.starts.size, k, k))
        stops = np.append(grid.starts, grid.bins.size)[1:]
        for c, (a, b) in enumerate(zip(grid.starts, stops, strict=True)):
            part = flat[:, 2 * a : 2 * b]
            np.matmul(part, part.T, out=out[c])
        return out


class BlockSpectra:
    """Spectra of the blocks of a stream. columns : all of them; own : those that every block is asked for."""

    def __init__(self, columns: Columns, own: NDArray[np.intp], grid: BlockLayout) -> None:
        self._columns, self._grid, self._own = columns, grid, own
        self._all = np.arange(len(columns.balance.columns))
        laws = columns.balance.laws
        self._kept = {
            int(k)
            for k in own
            if (c := columns.balance.columns[k]).kind == "law" and laws[c.law].effect.kind != "memory"
        }
        self._held: dict[int, tuple[Array, Array]] = {}  # force and tangents over the second half of the last block
        self._frames = np.empty((self._all.size, grid.size), np.float32)
        self._window = np.ascontiguousarray(grid.window)

    def restart(self) -> None:
        """The next block does not follow on the last one."""
        self._held = {}

    def take(self, stretch: Stretch, wide: bool) -> tuple[Spectra, Array]:
        """Spectra of the next block, (k, bins), and sums of tangents, (k, 4), of all columns or of the own ones.

        Raises DataError if a force is not finite.
        """
        from scipy.fft import rfft

        grid, hop = self._grid, self._grid.hop
        asked = self._all if wide else self._own
        later = stretch.part(hop, grid.size)
        states: list[dict[tuple[int, bool], LawStates]] = [{}, {}]
        whole: dict[tuple[int, bool], LawStates] = {}
        sizes, tangents = np.empty(asked.size), np.zeros((asked.size, 4))
        for i, k in enumerate(asked.tolist()):
            column = self._columns.balance.columns[k]
            if column.kind == "f":
                first, second = _split(stretch.force[column.row], hop)
            elif column.kind != "law":
                first, second = _split(getattr(stretch, column.kind)[column.row], hop)
            elif k in self._kept:
                before = self._held.get(k) or self._columns.law(k, stretch.part(0, hop), states[0])
                self._held[k] = self._columns.law(k, later, states[1])
                first, second = before[0], self._held[k][0]
                tangents[i] = before[1] + self._held[k][1]
            else:
                force, tangents[i] = self._columns.law(k, stretch, whole)
                first, second = force[:hop], force[hop:]
            sizes[i] = _windowed(first, second, self._window, self._frames[i])
            if not isfinite(sizes[i]):
                raise self._columns.not_finite(k)
        z = rfft(self._frames[: asked.size], axis=1, overwrite_x=True)
        a, b = int(grid.bins[0]), int(grid.bins[-1]) + 1
        z = z[:, a:b] if b - a == grid.bins.size else z[:, grid.bins]
        return Spectra(np.ascontiguousarray(z), sizes), tangents


def _split(z: Array, hop: int) -> tuple[Array, Array]:
    return z[MARGIN_ROWS : MARGIN_ROWS + hop], z[MARGIN_ROWS + hop : MARGIN_ROWS + 2 * hop]
