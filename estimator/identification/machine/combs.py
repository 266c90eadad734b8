"""Combs of lines in the spectra of squared envelopes, and the chance that noise has them.

Under noise alone the nats of a line, minus the logarithm of its chance, are exponentially distributed; the nats of a
comb of n lines are gamma distributed with n degrees. One line may contribute only so much: one line is no comb.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import gammaincc, gammaln

from estimator.arrays import Array

from .envelope import EnvelopeSpectrum
from .spectra import LevelSpectrum, local_noise
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class LineTable:
    """Nats of every bin of one envelope spectrum for lines of one width.

    Parameters
    ----------
    channel : str
        Name.
    spectrum : EnvelopeSpectrum
        Of one band of the channel.
    width : int
        Bins of a line.
    level : LevelSpectrum
        The spectrum averaged over the width, with its local noise.
    nats : (bins,) float64
        Against noise; 0 in bins that are left out.
    usable : (bins,) bool
        False in bins at orders of the shaft and at the mains.
    """

    channel: str
    spectrum: EnvelopeSpectrum
    width: int
    level: LevelSpectrum
    nats: Array
    usable: NDArray[np.bool_]

    def bins_at(self, hz: Array) -> NDArray[np.intp]:
        """Nearest bins of some frequencies, Hz; beyond the last bin: its number."""
        return np.minimum(np.rint(hz * self.spectrum.seconds), self.nats.size).astype(np.intp)


@dataclass(frozen=True, slots=True, kw_only=True)
class Comb:
    """The clearest comb of a search in one table.

    hz : fundamental. log_p : of the table, its grid paid for. nats : of all its lines, without a bound. table : where.
    """

    hz: float
    log_p: float
    nats: float
    table: LineTable


def _avoided_bins(P: Array, width: int, hz: Array, sd_hz: Array, seconds: float) -> NDArray[np.bool_]:
    """(bins,) whether a bin of a spectrum P belongs to a line at some frequencies, or to the flank of one."""
    lines = np.zeros(P.size, bool)
    reach = 0.5 * width + sd_hz * seconds + (2.0 if width > 1 else 0.0)  # under a box a line has no flanks to tell
    for centre, r in zip(hz * seconds, reach, strict=True):
        lines[max(0, int(np.ceil(centre - r))) : max(0, int(centre + r) + 1)] = True
    out = lines.copy()
    for d in (1, 2):  # the flanks of a line under the window are lower than its peak
        out[:-d] |= lines[d:] & (P[:-d] < P[d:])
        out[d:] |= lines[:-d] & (P[d:] < P[:-d])
    return out


def line_tables(
    channel: str, spectrum: EnvelopeSpectrum, avoided: tuple[Array, Array]
) -> Iterator[LineTable | None]:  # fmt: skip
    """The table of one spectrum for every width of a line; None of one with too few clear lines for a comb.

    avoided : frequencies (Hz) at which lines have another cause, and their standard deviations.
    """
    for width in LIMITS.line_widths_bins:
        if spectrum.power.size < 8 * width:
            continue
        count = max(1.0, spectrum.count * width / LIMITS.hann_bin_correlation) if width > 1 else float(spectrum.count)
        P = uniform_filter1d(spectrum.power, width, mode="nearest") if width > 1 else spectrum.power
        random = uniform_filter1d(spectrum.random, width, mode="nearest") if width > 1 else spectrum.random
        usable = ~_avoided_bins(P, width, *avoided, spectrum.seconds)
        usable[: LIMITS.lowest_bins] = False
        thin = P[width // 2 :: width]
        compared = np.where(usable & (LIMITS.least_ratio * random < P), P, 0.0)
        compared = np.maximum.reduceat(compared, width * np.arange(thin.size))
        noise = np.repeat(local_noise(thin, count, compared), width)[: P.size]
        noise = np.pad(noise, (0, P.size - noise.size), mode="edge")
        noise = np.maximum(noise, random)
        level = LevelSpectrum(seconds=spectrum.seconds, count=count, power=P, noise=noise)
        nats = np.where(usable, -level.log_p(np.arange(P.size)), 0.0)
        table = LineTable(channel=channel, spectrum=spectrum, width=width, level=level, nats=nats, usable=usable)
        yield table if np.count_nonzero(nats > LIMITS.clear_line_nats) >= LIMITS.min_clear_harmonics else None


def best_comb(table: LineTable, fundamentals_hz: Array, sideband_hz: float = 0.0, searched: float = 0.0) -> Comb | None:
    """The clearest comb at some fundamentals; None where none has two clear harmonics, the first or second among them.

    Parameters
    ----------
    table : LineTable
        Of one band and line width.
    fundamentals_hz : (g,) float64
        Hz, tried one by one.
    sideband_hz : float
        Distance of sidebands that belong to the comb, Hz; 0 for none.
    searched : float
        Fundamentals that are paid for; 0: as many as are tried.
    """
    if not fundamentals_hz.size:
        return None
    m = np.arange(1, LIMITS.harmonic_counts[-1] + 1)
    nats = np.append(table.nats, 0.0)
    usable = np.append(table.usable, False)
    main = fundamentals_hz[:, None] * m
    at = table.bins_at(main)
    own, count = nats[at], usable[at].astype(np.int64)
    clear = own > LIMITS.clear_line_nats
    eligible = (clear.sum(axis=1) >= LIMITS.min_clear_harmonics) & (clear[:, 0] | clear[:, 1])
    if not eligible.any():
        return None
    total, bounded = own.copy(), np.minimum(own, LIMITS.max_line_nats)
    if sideband_hz:
        for side in (main - sideband_hz, main + sideband_hz):
            beside = table.bins_at(np.maximum(side, 0.0))
            total += nats[beside]
            bounded += np.minimum(nats[beside], LIMITS.max_line_nats)
            count += usable[beside]
    pick = np.array(LIMITS.harmonic_counts) - 1
    sums, counts = np.cumsum(bounded, axis=1)[:, pick], np.cumsum(count, axis=1)[:, pick]
    log_p = np.where(counts > 0, log_gamma_tail(np.maximum(counts, 1), sums), 0.0).min(axis=1)
    log_p = np.where(eligible, log_p, 0.0)
    everything = total.sum(axis=1)
    i = int(np.argmin(log_p - 1e-4 * everything))
    paid = np.log(max(searched, fundamentals_hz.size) * len(LIMITS.harmonic_counts))
    return Comb(hz=float(fundamentals_hz[i]), log_p=float(log_p[i] + paid), nats=float(everything[i]), table=table)


def log_gamma_tail(n: NDArray[np.int64], x: Array) -> Array:
    """Logarithm of the chance that a gamma variable with n degrees exceeds x; an upper bound where it is tiny."""
    shape = n.astype(np.float64)
    with_log = -x + (shape - 1.0) * np.log(np.maximum(x, 1e-9)) - gammaln(shape)
    far = with_log - np.log1p(-np.minimum((shape - 1.0) / np.maximum(x, 1e-9), 0.9))
    near = np.log(np.maximum(gammaincc(shape, np.minimum(x, 100.0)), 1e-60))
    return np.asarray(np.where(x > np.maximum(60.0, 3.0 * shape), far, near))


def clear_harmonics(comb: Comb) -> tuple[NDArray[np.intp], Array]:
    """Numbers of the clear harmonics of a comb, and their depths of modulation (amplitudes less the noise)."""
    table = comb.table
    m = np.arange(1, LIMITS.harmonic_counts[-1] + 1)
    at = table.bins_at(np.asarray(comb.hz * m, dtype=np.float64))
    m, at = m[at < table.nats.size], at[at < table.nats.size]
    clear = table.nats[at] > LIMITS.clear_line_nats
    power = [_lobe(table, int(k))[1].sum() for k in at[clear]]
    return m[clear].astype(np.intp), np.sqrt(np.array(power) / LIMITS.hann_bin_correlation)


def refined_fundamental(comb: Comb) -> float:
    """The fundamental (Hz) of a comb by the centroids of its clear harmonics."""
    numbers, _ = clear_harmonics(comb)
    centres: list[float] = []
    for m in numbers:
        bins, power = _lobe(comb.table, int(comb.table.bins_at(np.array([m * comb.hz]))[0]))
        centres.append(float(bins @ power / power.sum()) / comb.table.spectrum.seconds if power.any() else m * comb.hz)
    k = numbers.astype(np.float64)
    return float(k @ np.array(centres) / (k @ k)) if numbers.size else comb.hz


def _lobe(table: LineTable, k: int) -> tuple[Array, Array]:
    """Bins of a line about bin k, and their powers over the noise."""
    reach = 1 + table.width // 2
    bins = np.arange(max(1, k - reach), min(k + reach + 1, table.nats.size))
    return bins.astype(np.float64), np.maximum(table.spectrum.power[bins] - table.level.noise[bins], 0.0)


def clear_peaks(table: LineTable, low_hz: float, high_hz: float, most: int) -> Array:
    """Frequencies (Hz) of the clearest usable lines between two frequencies."""
    first = max(LIMITS.lowest_bins, int(np.ceil(low_hz * table.spectrum.seconds)))
    last = min(int(high_hz * table.spectrum.seconds) + 1, table.nats.size - 1)
    nats = table.nats
    bins = first + np.flatnonzero(nats[first:last] > LIMITS.clear_line_nats)
    bins = bins[(nats[bins] >= nats[bins - 1]) & (nats[bins] >= nats[bins + 1])]
    bins = bins[np.argsort(-nats[bins])][:most]
    return bins / table.spectrum.seconds


def clearest(combs: Sequence[Comb | None]) -> Comb | None:
    """The comb of the lowest chance; of several of equal chance, the one with the most nats."""
    found = [c for c in combs if c is not None]
    return min(found, key=lambda c: c.log_p - 1e-4 * c.nats) if found else None
