"""Counts to SI, the same arithmetic for live, replay and analysis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.contract import Info

Counts = NDArray[np.int16] | NDArray[np.int32]


def now_at(first: Info, info: Info) -> list[int] | str:
    """Where the signals of `first` are in another description of the same device: by name, or else in order if there
    are as many; or why its samples are no continuation."""
    if info.rate_hz != first.rate_hz:
        return f"{info.rate_hz:g} Hz instead of {first.rate_hz:g} Hz"
    names, wanted = [s.name for s in info.signals], [s.name for s in first.signals]
    if len(names) != len(wanted) and (not set(wanted) <= set(names) or len(set(wanted)) < len(wanted)):
        return f"channels {', '.join(names)} instead of {', '.join(wanted)}"
    named = set(wanted) <= set(names) and len(set(wanted)) == len(wanted)  # a device may give one name to several
    columns = [names.index(name) for name in wanted] if named else list(range(len(wanted)))
    for column, signal in zip(columns, first.signals, strict=True):
        if (unit := info.signals[column].unit) != signal.unit:
            return f"{signal.name} in {unit or 'no unit'} instead of {signal.unit or 'none'}"
    return columns


def full_scale_count(count_bits: int) -> int:
    """A count there or beyond may be a clipped value; a signal of one bit has only two values, and is never clipped."""
    return 2 ** (count_bits - 1) - 1 if count_bits > 1 else 2**31


class Scaling:
    """SI value = count * scale + offset for the signals of `info`, or for those `columns` of it."""

    def __init__(self, info: Info, columns: list[int] | None = None) -> None:
        self.columns = None if columns is None or columns == list(range(len(info.signals))) else columns
        chosen = info.signals if columns is None else [info.signals[i] for i in columns]
        self.scale = np.array([s.scale for s in chosen], dtype=np.float64)
        self.offset = np.array([s.offset for s in chosen], dtype=np.float64)
        self.full_scale = full_scale_count(info.count_bits)

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
