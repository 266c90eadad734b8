"""Spectral matrices of the caps of one direction, averaged over pieces of a record and over narrow cells.

The work of a search in them is counted in operations: it is the same on every machine and in every repetition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.fft import rfft

from estimator.arrays import Array, Complexes, Series
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.signals.band_limit import noise_shape

from .excitation import beside_lines, first_of_cells, sine_tapers
from .thresholds import LIMITS


class SearchTooLongError(Exception):
    """A search has done more work than it may."""


@dataclass(slots=True)
class Work:
    """Work of a search. done, limit : in equivalent derivatives of spectra."""

    limit: float = np.inf
    done: float = 0.0

    def add(self, derivatives: int) -> None:
        """Count one score of so many derivatives. Raises SearchTooLongError beyond the limit."""
        self.add_all([derivatives + LIMITS.score_overhead_derivatives])

    def add_all(self, done: Iterable[float]) -> None:
        """Count the work of searches beside this one. Raises SearchTooLongError beyond the limit."""
        self.done += sum(done)
        if self.done > self.limit:
            raise SearchTooLongError


@dataclass(frozen=True, slots=True, kw_only=True)
class CrossSpectra:
    """Averaged spectral matrices of the acceleration of the caps of one direction.

    Parameters
    ----------
    places : tuple of int
        Their indices in the motion record.
    f_hz : (cells,) float64
        Mean frequency of each cell.
    psd : (cells, places, places) complex128
        One-sided spectral matrix, (m/s^2)^2/Hz.
    n : (cells,) float64
        Complex degrees of freedom of each matrix.
    noise : (cells, places) float64
        PSD of white noise of each sensor as acceleration, over its PSD in the unit of the sensor.
    """

    places: tuple[int, ...]
    f_hz: Array
    psd: Complexes
    n: Array
    noise: Array


def cross_spectra(
    data: MotionRecord, series: Series, places: tuple[int, ...], response: Callable[[Array], Complexes]
) -> CrossSpectra:
    """Spectra of the acceleration that goes with a series of motion or force, without narrow lines.

    Parameters
    ----------
    data : MotionRecord
        The record.
    series : (places of the record, n) floating
        Velocity, m/s, or residual force, N.
    places : tuple of int
        Indices of the caps.
    response : callable
        (f,) Hz -> (f, caps, caps) acceleration per unit of the series.
    """
    pieces, size = _pieces(data)
    f: Array = np.asarray(np.arange(size // 2 + 1) * (data.rate_hz / size), np.float64)
    keep = np.flatnonzero((f >= data.band[0]) & (f <= data.band[1]) & beside_lines(f, data.lines))
    S = np.zeros((keep.size, len(places), len(places)), np.complex128)
    tapers = sine_tapers(size)
    for first in pieces:
        for taper in tapers:
            F = rfft(series[list(places), first : first + size] * taper, axis=1)[:, keep].T
            S += F[:, :, None] * F[:, None, :].conj()
    T = response(f[keep]) * np.sqrt(2.0 / (data.rate_hz * LIMITS.taper_count * len(pieces)))
    S = T @ S @ T.conj().swapaxes(1, 2)
    first_bins = first_of_cells(f[keep] / f[keep[0]], LIMITS.matrix_cell_width_rel)
    bins = np.diff(np.append(first_bins, keep.size))
    centre = np.add.reduceat(f[keep], first_bins) / bins
    kinds = tuple(data.kinds[i] for i in places)
    return CrossSpectra(
        places=places,
        f_hz=centre,
        psd=np.asarray(np.add.reduceat(S, first_bins, axis=0) / bins[:, None, None], np.complex128),
        n=bins * len(pieces) * LIMITS.taper_efficiency,
        noise=noise_shape(kinds, 2 * np.pi * centre).T,
    )


def _pieces(data: MotionRecord) -> tuple[list[int], int]:
    """First rows of pieces of neighbouring blocks, and their length."""
    together = max(data.blocks // LIMITS.min_matrix_pieces, 1)
    while True:
        ends = np.cumsum([0, *(part.stop - part.start for part in data.stretches)]) // data.block
        first = [b for a, end in zip(ends, ends[1:], strict=False) for b in range(a, end - together + 1, together)]
        if len(first) * together >= data.blocks // 2 or together == 1:
            return [b * data.block for b in first], together * data.block
        together //= 2
