"""Gap-free pieces of one channel, all of one length, for spectra that are averaged over them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.fft import prev_fast_len

from estimator.arrays import Array, true_runs

from .thresholds import LIMITS


class Pieces:
    """Gap-free pieces of one channel.

    Parameters
    ----------
    samples : (n,) float64 or float32
        NaN where a sample is missing. It is not changed.
    rate_hz : float
        Rows per second.
    max_seconds : float
        Longest piece.
    """

    def __init__(self, samples: Array, rate_hz: float, max_seconds: float = LIMITS.max_piece_s) -> None:
        self._samples = _bridged(samples)
        runs = true_runs(np.isfinite(self._samples))
        size = _common_size(runs[:, 1] - runs[:, 0], int(max_seconds * rate_hz)) if len(runs) else 0
        self.size = int(prev_fast_len(size, real=True)) if size >= LIMITS.min_piece_rows else 0
        self.rate_hz = rate_hz
        self.starts: list[int] = []
        if self.size >= LIMITS.min_piece_rows:
            for start, stop in runs:
                count = (stop - start) // self.size
                spare = (stop - start) - count * self.size
                self.starts += [int(start + spare // 2 + i * self.size) for i in range(count)]

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def seconds(self) -> float:
        """Length of a piece, s."""
        return self.size / self.rate_hz

    def groups(self, max_rows: int = 1 << 20) -> Iterator[Array]:
        """Some pieces at a time, (pieces, size), each less its mean: at most about `max_rows` samples."""
        step = max(1, max_rows // max(self.size, 1))
        for first in range(0, len(self.starts), step):
            starts = self.starts[first : first + step]
            rows = np.stack([self._samples[s : s + self.size] for s in starts]).astype(np.float64, copy=False)
            rows -= rows.mean(axis=1, keepdims=True)
            yield rows


def _bridged(samples: Array) -> Array:
    """The samples with short gaps bridged by straight lines."""
    missing = ~np.isfinite(samples)
    if not missing.any() or missing.all():
        return samples
    edges = true_runs(missing)
    inner = (edges[:, 0] > 0) & (edges[:, 1] < samples.size)
    short = edges[(edges[:, 1] - edges[:, 0] <= LIMITS.bridged_gap_rows) & inner]
    count = int((short[:, 1] - short[:, 0]).sum())
    if not 0 < count <= LIMITS.max_bridged_share * samples.size:
        return samples
    out = samples.copy()
    rows = np.concatenate([np.arange(a, b) for a, b in short])
    known = np.flatnonzero(~missing)
    out[rows] = np.interp(rows, known, samples[known])
    return out


def _common_size(lengths: NDArray[np.intp], most: int) -> int:
    """Rows of a piece: long and yet covering most of the runs of given lengths (rows)."""
    sizes = np.unique(np.minimum(lengths, most))
    sizes = sizes[:: max(1, sizes.size // 200)]
    covered = np.array([(lengths // s).sum() * s for s in sizes])
    return int(sizes[np.argmax(covered * np.sqrt(sizes))])
