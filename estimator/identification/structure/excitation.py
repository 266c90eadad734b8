"""Spectrum of a channel in cells of a constant relative width, without its tones: what modes are fitted to.

Spectral matrices of the caps of one direction, averaged over pieces of a record and over narrow cells.

The work of a search in them is counted in operations: it is the same on every machine and in every repetition.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.interpolate import BSpline

from estimator.arrays import Array, Complexes, Series
from estimator.identification.machine.pieces import Pieces
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.model.rig import LineBand
from estimator.signals.band_limit import noise_shape

from .thresholds import LIMITS

KIND_ORDER = {"displacement": 2, "velocity": 1, "acceleration": 0}  # times j w to acceleration


@dataclass(frozen=True, slots=True, kw_only=True)
class CellSpectrum:
    """PSD of the acceleration at a place, averaged in cells, for each block of the record.

    Parameters
    ----------
    f_hz : (cells,) float64
        Mean frequency of each cell.
    psd : (cells,) float64
        One-sided PSD averaged over the blocks, (m/s^2)^2/Hz.
    block_psd : (blocks, cells) float64
        That of each block.
    shape : (cells,) float64
        Shape of the gamma distribution of `psd`: half of its degrees of freedom.
    noise : (cells,) float64
        PSD of white noise of the sensor as acceleration, of mean 1.
    bin_hz : float
        Distance of the bins behind the cells, Hz.
    """

    f_hz: Array
    psd: Array
    block_psd: Array
    shape: Array
    noise: Array
    bin_hz: float


def cell_spectrum(
    y: Array,
    kind: str,
    rate_hz: float,
    band: tuple[float, float],
    lines: Sequence[LineBand] = (),
    trains_hz: Sequence[float] = (),
) -> CellSpectrum | None:
    """Spectrum of one channel in the band.

    Parameters
    ----------
    y : (n,) float64
        Samples, SI; NaN where one is missing.
    kind : {"acceleration", "velocity", "displacement"}
        Kind of the channel.
    rate_hz : float
        Sampling rate, Hz.
    band : (float, float)
        Analysed band, Hz; it ends at 0.45 of the rate at the latest.
    lines : sequence of LineBand
        Narrow lines of the channel, which are left out.
    trains_hz : sequence of float
        Strikes per second of known strike trains. All multiples are left out.

    Returns
    -------
    CellSpectrum or None
        None where the record is too short for its band, or nothing moves in it.
    """
    seconds = int(np.count_nonzero(np.isfinite(y))) / rate_hz
    parts = LIMITS.short_pieces if seconds < LIMITS.short_s else LIMITS.pieces_per_record
    seconds = min(max(seconds / parts, LIMITS.min_piece_s), LIMITS.max_piece_s)
    pieces = Pieces(y, rate_hz, max_seconds=seconds)
    high = min(band[1], 0.45 * rate_hz)
    if len(pieces) < 2 or band[0] * pieces.seconds < 4.0 or high < 1.2 * band[0]:
        return None
    power, blocks = _piece_spectra(pieces)
    f = np.arange(power.size) / pieces.seconds
    inside = (f >= band[0]) & (f <= high)
    if not np.all(power[inside] > 0.0):
        return None
    keep = np.flatnonzero(np.all([inside, beside_lines(f, lines), *(~_teeth(f, train) for train in trains_hz)], axis=0))
    if keep.size < 32:
        return None
    first = first_of_cells(f[keep] / band[0], LIMITS.cell_width_rel)
    bins = np.diff(np.append(first, keep.size))
    centre = np.add.reduceat(f[keep], first) / bins
    scale = (2.0 * np.pi * centre) ** (2 * KIND_ORDER[kind])
    per_block = np.add.reduceat(blocks[:, keep], first, axis=1) / bins * scale
    return CellSpectrum(
        f_hz=centre,
        psd=per_block.mean(axis=0),
        block_psd=per_block,
        shape=bins * len(pieces) * LIMITS.taper_efficiency,
        noise=scale / scale.mean(),
        bin_hz=1.0 / pieces.seconds,
    )


def first_of_cells(ratio: Array, width_rel: float) -> NDArray[np.intp]:
    """(cells,) index of the first bin of each cell. ratio : frequency of each bin over where the first cell begins."""
    cell = np.floor(np.log(ratio) / width_rel).astype(np.intp)
    return np.flatnonzero(np.append(True, np.diff(cell) > 0))


def sine_tapers(size: int) -> Array:
    """(tapers, size) tapers of unit energy, orthogonal to each other."""
    k, row = np.arange(1, LIMITS.taper_count + 1)[:, None], np.arange(1, size + 1)
    return np.asarray(np.sqrt(2.0 / (size + 1)) * np.sin(np.pi * k * row / (size + 1)))


def _piece_spectra(pieces: Pieces) -> tuple[Array, Array]:
    """(bins,) mean PSD over the pieces, and (blocks, bins) PSD of up to sixteen groups of pieces."""
    tapers = sine_tapers(pieces.size)
    groups = np.array_split(np.arange(len(pieces)), LIMITS.max_blocks)
    block_of = np.repeat(np.arange(LIMITS.max_blocks), [len(g) for g in groups])
    blocks = np.zeros((min(len(pieces), LIMITS.max_blocks), pieces.size // 2 + 1))
    done = 0
    for group in pieces.groups():
        for taper in tapers:
            X = rfft(group * taper, axis=1)
            np.add.at(blocks, block_of[done : done + len(group)], X.real**2 + X.imag**2)
        done += len(group)
    blocks *= 2.0 / (pieces.rate_hz * LIMITS.taper_count)
    return blocks.sum(axis=0) / len(pieces), blocks / np.bincount(block_of)[:, None]


def _teeth(f: Array, train_hz: float) -> NDArray[np.bool_]:
    """(bins,) bins at multiples of a frequency; none where they are more than half of all, as where slip blurs them."""
    if not train_hz > 0.0:
        return np.zeros(f.size, dtype=bool)
    number = np.maximum(np.round(f / train_hz), 1.0)
    teeth = np.abs(f - number * train_hz) <= LIMITS.tooth_reach_bins * f[1] + LIMITS.tooth_blur_rel * f
    return np.asarray(teeth & (LIMITS.tooth_reach_bins * f[1] + LIMITS.tooth_blur_rel * f < 0.25 * train_hz))


def spline_basis(x: Array, pieces: int, degree: int) -> Array:
    """(n, splines) B-splines of x (n,), which rises, over so many intervals of equal width."""
    inner = np.linspace(x[0], x[-1], pieces + 1)
    knots = np.concatenate([[inner[0]] * degree, inner, [inner[-1]] * degree])
    return np.asarray(BSpline.design_matrix(np.clip(x, inner[0], inner[-1]), knots, degree).toarray())


def beside_lines(f: Array, lines: Sequence[LineBand]) -> NDArray[np.bool_]:
    """(bins,) whether a bin at f Hz, evenly spaced, is beside all lines and their skirts under the tapers."""
    out = np.ones(f.size, dtype=bool)
    for line in lines:
        skirt = f[1] * (LIMITS.min_line_reach_bins + LIMITS.sidelobe_bins * (line.power_over_psd_hz / f[1]) ** 0.25)
        out &= (f < line.low_hz - skirt) | (f > line.high_hz + skirt)
    return out


class SearchTooLongError(Exception):
    """A search has done more work than it may."""


@dataclass(slots=True)
class Work:
    """Work of a search. done, limit : numbers of derivatives of spectra that take as long."""

    limit: float = np.inf
    done: float = 0.0

    def add(self, derivatives: int) -> None:
        """Count one score of so many derivatives. Raises SearchTooLongError beyond the limit."""
        self.done += derivatives + LIMITS.score_overhead_derivatives
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
    for first in pieces:
        for taper in sine_tapers(size):
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
