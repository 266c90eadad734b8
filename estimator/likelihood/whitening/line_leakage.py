"""Leakage of narrow lines, and of noise at an edge of the band, projected out of the block spectra.

A disc rings for seconds on its shaft, a tone for ever, and a block lasts a third of a second. The part of the residual
force that goes with them ends at both ends of every block. That spreads it over all bins. The Fourier sum over a block
of a sampled line of constant amplitude at f0 has the shape 1 + i cot(pi (f - f0) / rate), and that of its conjugate the
shape at -f0. Higher powers of the cotangent come in where the line grows, decays or wanders. The shapes are projected
out of every series alike, and the lost share of each bin is counted. Noise that is strong beside one edge of the band
leaks in the shapes of a line there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.thresholds import LIMITS
from estimator.signals.band_limit import passband


@dataclass(frozen=True, slots=True)
class Leakage:
    """Shapes of the leakage of narrow lines and of noise at an edge of the band.

    shapes : (places, bins, k) orthonormal, of whitened spectra. kept : (places, bins) share of each bin that remains.
    edges_hz : by place, the edge of the band from which noise leaks; 0 for none.
    """

    shapes: NDArray[np.float32]
    kept: Array
    edges_hz: tuple[float, ...]

    def take_out(self, i: int, Z: NDArray[np.float32]) -> None:
        """Project the shapes out of spectra Z (blocks, 2 bins) at place i, in place. It needs as much memory again."""
        shapes = self.shapes[i]
        parts = np.concatenate([Z[:, 0::2], Z[:, 1::2]])  # real and imaginary parts
        parts -= (parts @ shapes) @ shapes.T
        Z[:, 0::2], Z[:, 1::2] = parts[: len(Z)], parts[len(Z) :]


def line_leakage(data: MotionRecord, weights: NDArray[np.floating]) -> Leakage | None:
    """The shapes; None where no disc resonates in the band, no line is strong and no noise leaks.

    An edge that leaked once is taken out in all of a fit: with and without it likelihoods are of other data.

    weights : (places, bins) of the spectra.
    """
    forms = [form for f0 in leaking_lines(data) for form in _forms(data, f0, LIMITS.line_powers)]
    for f0 in () if data.rotor is None else data.rotor.resonances_hz:
        if data.band[0] < f0 < data.band[1]:
            forms += _forms(data, f0, LIMITS.disc_powers)  # the notch of the shaft leaves it out
    known = data.leaking_edges_hz or (0.0,) * len(weights)
    edges = tuple(
        edge or leaking_edge(data, 1.0 / np.square(own, dtype=np.float64)) or 0.0
        for edge, own in zip(known, weights, strict=True)
    )
    if not forms and not any(edges):
        return None
    shapes = np.zeros((len(weights), data.f_hz.size, len(forms) + sum(LIMITS.line_powers) + 1), np.float32)
    kept = np.ones(weights.shape)
    for i, (own, edge) in enumerate(zip(weights, edges, strict=True)):
        columns = [*forms, *(_forms(data, edge, LIMITS.line_powers) if edge else ())]
        if columns:
            columns.append(np.ones(data.f_hz.size))
            Q, _ = np.linalg.qr(own[:, None] * (np.stack(columns, axis=1) / np.linalg.norm(columns, axis=1)))
            kept[i] -= np.sum(Q**2, axis=1)
            shapes[i, :, : Q.shape[1]] = Q
    return Leakage(shapes[:, :, shapes.any(axis=(0, 1))], kept, edges)


def _forms(data: MotionRecord, f0: float, powers: tuple[int, int]) -> list[Array]:
    """Shapes (bins,) of the leakage from f0, Hz. powers : highest power of the cotangent at f0 and at -f0."""
    here, mirrored = (1.0 / np.tan(np.pi * (data.f_hz - f) / data.rate_hz) for f in (f0, -f0))
    return [z**k for z, most in zip((here, mirrored), powers, strict=True) for k in range(1, most + 1)]


def leaking_lines(data: MotionRecord) -> list[float]:
    """Frequencies of the lines that leak most, Hz, at most `max_lines`.

    A block without a window puts 1 / (pi k)^2 of the power of a line in the bin k bins away.
    """
    seconds = data.block / data.rate_hz
    leaks = []
    for line in data.lines:
        away = max(0.5 * (line.high_hz - line.low_hz) * seconds, 1.0)
        power = line.power_over_psd_hz * seconds * 2.0 / (np.pi**2 * away)
        if power > LIMITS.min_leakage_bins and not np.any(np.abs(data.f_hz - line.centre_hz) < 0.5 / seconds):
            leaks.append((power, line.centre_hz))
    return [hz for _, hz in sorted(leaks, reverse=True)[: LIMITS.max_lines]]


def leaking_edge(data: MotionRecord, psd: Array) -> float | None:
    """The frequency beside which so much noise lies that it leaks into all of the band, Hz; None where none does.

    Acceleration that is integrated has noise at the lower edge that is thousands of times that amid the band,
    displacement that is differentiated at the upper edge. The covariance of a block of T s falls as 1 - lag / T.

    psd : (bins,) expected PSD of the residual force, to a factor.
    """
    from scipy.fft import irfft, rfft

    f: Array = np.asarray(np.fft.rfftfreq(data.block, 1.0 / data.rate_hz), np.float64)
    lag = np.arange(data.block)
    full = np.interp(f, data.f_hz, psd) * passband(f, data.rate_hz, data.band) ** 2
    seen = rfft(irfft(full, data.block) * (1.0 - np.minimum(lag, data.block - lag) / data.block)).real[data.bins]
    if np.max(seen / psd) < 1.0 + LIMITS.max_noise_leakage_rel:
        return None
    return float(f[np.argmax(full)] - 0.5 * data.rate_hz / data.block)  # between two bins
