"""Spectrum of a channel in cells of a constant relative width, without its tones, to which modes are fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.interpolate import BSpline

from estimator.arrays import Array
from estimator.identification.machine.pieces import Pieces
from estimator.model.rig import LineBand

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
) -> CellSpectrum | str:
    """Spectrum of one channel in the band, or why the record has none.

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
    CellSpectrum or str
        The reason is one line.
    """
    pieces, high = _resolving_pieces(y, rate_hz, band[0]), min(band[1], 0.45 * rate_hz)
    if isinstance(pieces, str):
        return pieces
    if high < 1.2 * band[0]:
        return f"the band is too narrow: it ends at {high:g} Hz"
    power, blocks = _piece_spectra(pieces)
    f = np.arange(power.size) / pieces.seconds
    inside = (f >= band[0]) & (f <= high)
    if not np.all(power[inside] > 0.0):
        return "nothing moves in the band"
    keep = np.flatnonzero(np.all([inside, beside_lines(f, lines), *(~_teeth(f, train) for train in trains_hz)], axis=0))
    if keep.size < 32:
        return f"the record resolves {keep.size} frequencies of the band beside lines and strikes, fewer than 32"
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


def _resolving_pieces(y: Array, rate_hz: float, low_hz: float) -> Pieces | str:
    """The pieces of a record that resolve a band from low_hz, or why none do, one line. y : (n,)."""
    record_s = int(np.count_nonzero(np.isfinite(y))) / rate_hz
    piece_s = min(max(record_s / _piece_count(record_s), LIMITS.min_piece_s), LIMITS.max_piece_s)
    pieces = Pieces(y, rate_hz, max_seconds=piece_s)
    if len(pieces) < 2:
        return f"the record is too short: it has no two pieces of {piece_s:.2g} s without a gap"
    least_s = LIMITS.min_piece_periods / low_hz
    if least_s <= pieces.seconds:
        return pieces
    length_s = least_s * _piece_count(least_s * LIMITS.short_pieces)
    longer = f"record {length_s:.0f} s, or " if least_s <= LIMITS.max_piece_s else ""
    begin_hz = LIMITS.min_piece_periods / pieces.seconds
    return f"the record is too short for a band from {low_hz:g} Hz: {longer}begin the band at {begin_hz:.2g} Hz"


def _piece_count(record_s: float) -> int:
    """Number of pieces of a record of some length, s."""
    return LIMITS.short_pieces if record_s < LIMITS.short_s else LIMITS.pieces_per_record


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
            for block, power in zip(block_of[done : done + len(group)], X.real**2 + X.imag**2, strict=True):
                blocks[block] += power
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
    """(n, splines) B-splines of x (n,), which rises, over so many intervals of equal width. degree : 0 is constant."""
    inner = np.linspace(x[0], x[-1], pieces + 1)
    knots = np.concatenate([[inner[0]] * degree, inner, [inner[-1]] * degree])
    return np.asarray(BSpline.design_matrix(np.clip(x, inner[0], inner[-1]), knots, degree).toarray())


def beside_lines(f: Array, lines: Sequence[LineBand]) -> NDArray[np.bool_]:
    """(bins,) whether a bin at f Hz, evenly spaced, is outside all lines and their skirts under the tapers."""
    out = np.ones(f.size, dtype=bool)
    for line in lines:
        skirt = f[1] * (LIMITS.min_line_reach_bins + LIMITS.sidelobe_bins * (line.power_over_psd_hz / f[1]) ** 0.25)
        out &= (f < line.low_hz - skirt) | (f > line.high_hz + skirt)
    return out
