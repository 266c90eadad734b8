"""Counts to SI, the same arithmetic for live, replay and analysis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.reading import Info

Counts = NDArray[np.int16] | NDArray[np.int32]


class Scaling:
    """SI value = count * scale + offset for the signals of `info`, or for those `columns` of it."""

    def __init__(self, info: Info, columns: list[int] | None = None) -> None:
        self.columns = None if columns is None or columns == list(range(len(info.signals))) else columns
        chosen = info.signals if columns is None else [info.signals[i] for i in columns]
        self.scale = np.array([s.scale for s in chosen], dtype=np.float64)
        self.offset = np.array([s.offset for s in chosen], dtype=np.float64)
        self.full_scale = 2 ** (info.count_bits - 1) - 1  # a count there or beyond may be a clipped value

    def select(self, counts: Counts) -> Counts:
        return counts if self.columns is None else counts[:, self.columns]

    def si(self, counts: Counts, out: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Selected counts (n, channels) in SI."""
        values = np.multiply(counts, self.scale, out=out)
        if self.offset.any():
            values += self.offset
        return values

    def clipped(self, counts: Counts) -> NDArray[np.bool_] | None:
        """(n, channels) where a selected count is at or beyond full scale; None if nowhere."""
        if not counts.size or (counts.max() < self.full_scale and counts.min() > -self.full_scale):
            return None
        out: NDArray[np.bool_] = (counts >= self.full_scale) | (counts <= -self.full_scale)
        return out
