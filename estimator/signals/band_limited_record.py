"""Band limit of a whole record, block by block on demand, bit for bit equal to a stream of its pieces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.parallel import map_threads

from .band_limit import BandLimit, BandLimitedMotion, Terms
from .thresholds import LIMITS


class BandLimitedRecord(BandLimit):
    """Band-limited motion of (n, channels) rows, computed as it is asked for."""

    def __init__(
        self,
        y: Array,
        kinds: Sequence[str],
        rate_hz: float,
        band: tuple[float, float],
        extra: Terms = (),
        slow: bool = False,
        undone: Callable[[Array], Complexes] | None = None,
        columns: Sequence[int] | None = None,
    ) -> None:
        """columns : of y, one a kind; None: all of them, in order."""
        super().__init__(kinds, rate_hz, band, extra, slow, undone)
        numbers = list(range(y.shape[1])) if columns is None else list(columns)
        self._y, self._columns = y, slice(None) if numbers == list(range(y.shape[1])) else numbers
        absent = np.zeros(len(y), bool)
        for k in numbers:
            absent |= ~np.isfinite(y[:, k])
        missing = np.concatenate([[0], np.cumsum(absent, dtype=np.int32)])
        self.valid: NDArray[np.bool_] = np.zeros(len(y), bool)
        if len(y) > 2 * self.half:
            inner = missing[2 * self.half + 1 :] == missing[: -2 * self.half - 1]
            self.valid[self.half : self.half + inner.size] = inner

    @property
    def rows(self) -> int:
        return len(self._y)

    def _filtered(self, b: int, dtype: type[np.floating[Any]]) -> NDArray[Any]:
        """(outputs, channels, hop) filtered rows from b hop on, on the block grid of a stream."""
        first = b * self._hop - self.half
        lo, hi = max(first, 0), min(first + self._size, self.rows)
        y = self._y[lo:hi, self._columns].T
        if y.shape[1] < self._size:
            y = np.pad(y, [(0, 0), (lo - first, first + self._size - hi)], constant_values=np.nan)
        return self._block(np.ascontiguousarray(y), dtype)[0]

    def whole(self) -> BandLimitedMotion:
        """The motion of the whole record in memory."""
        return self.of_stretches([slice(0, self.rows)])

    def of_stretches(self, stretches: Sequence[slice], dtype: type[np.floating[Any]] = np.float64) -> BandLimitedMotion:
        """The motion of stretches of rows in memory, laid end to end."""
        total = sum(rows.stop - rows.start for rows in stretches)
        out: list[NDArray[Any]] = [np.empty((len(self.kinds), total), dtype) for _ in self.outputs]
        asked: list[tuple[int, int, int, int]] = []  # block; first and last row of it that is wanted; where they go
        filled = 0
        for rows in stretches:
            for b in range(rows.start // self._hop, -(-rows.stop // self._hop)):
                lo, hi = max(rows.start, b * self._hop), min(rows.stop, (b + 1) * self._hop)
                asked.append((b, lo, hi, filled + lo - rows.start))
            filled += rows.stop - rows.start

        def fill(want: tuple[int, int, int, int]) -> None:
            b, lo, hi, to = want
            z = self._filtered(b, dtype)[:, :, lo - b * self._hop : hi - b * self._hop]
            for whole, part in zip(out, z, strict=True):
                whole[:, to : to + hi - lo] = part

        map_threads(fill, asked)
        return self.motion(stretches[0].start, out, np.concatenate([self.valid[rows] for rows in stretches]))


def band_limit(
    y: Array,
    kinds: Sequence[str],
    rate_hz: float,
    band: tuple[float, float],
    extra: Terms = (),
    undone: Callable[[Array], Complexes] | None = None,
) -> BandLimitedMotion:
    """The whole record (n, channels) at once; the same numbers as any stream of its pieces."""
    there = np.where(np.abs(y) <= LIMITS.max_sample_si, y, np.nan)
    return BandLimitedRecord(y=there, kinds=kinds, rate_hz=rate_hz, band=band, extra=extra, undone=undone).whole()
