"""Residual force and regressors as whitened block spectra, which the path likelihood is made of.

Sensor noise referred to force: through the shaft, the noise of one bearing enters both residual forces.

The residual forces are r = A y = F + A n, with n the noise of the sensors. Where a shaft couples the caps they
are correlated, R = S + A N A^H. A force that follows the motion y has with r the mean product T A^-1 R, T its mean
response. With each row whitened by itself, W = 1 / diag R, the slope of the determinant T A^-1 leaves T A^-1 (R W - 1):
noise of bearing 2 would look like a force at bearing 1 that follows bearing 2. So the response of every force is taken
as that to the measured motion, T A^-1 R W A. It is T where the rows are independent.

Leakage of narrow lines between blocks, projected out of the block spectra.

A disc rings for seconds on its shaft, a tone for ever, and a block lasts a third of a second. The part of the residual
force that goes with them ends at both ends of every block. That spreads it over all bins. The Fourier sum over a block
of a sampled line of constant amplitude at f0 has the shape 1 + i cot(pi (f - f0) / rate), and that of its conjugate the
shape at -f0. Higher powers of the cotangent come in where the line grows, decays or wanders. The shapes are projected
out of every series alike, and the lost share of each bin is counted.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.motion_record import TIME_FOLDS, MotionRecord
from estimator.likelihood.response.regressor_set import Regressor, regressor_response
from estimator.likelihood.thresholds import LIMITS
from estimator.parallel import map_threads

from .determinant import tangent_times


@dataclass(frozen=True, slots=True)
class Leakage:
    """Shapes of the leakage of narrow lines.

    shapes : (places, bins, k) orthonormal, of whitened spectra. kept : (places, bins) share of each bin that remains.
    """

    shapes: NDArray[np.float32]
    kept: Array

    def take_out(self, i: int, Z: NDArray[np.float32]) -> None:
        """Project the shapes out of spectra Z (blocks, 2 bins) at place i, in place. It needs as much memory again."""
        own = self.shapes[i]
        parts = np.concatenate([Z[:, 0::2], Z[:, 1::2]])  # real and imaginary parts
        parts -= (parts @ own) @ own.T
        Z[:, 0::2], Z[:, 1::2] = parts[: len(Z)], parts[len(Z) :]


def line_leakage(data: MotionRecord, weights: NDArray[np.floating]) -> Leakage | None:
    """The shapes; None where no disc resonates in the band and no line is strong.

    weights : (places, bins) of the spectra.
    """
    forms = [form for f0 in leaking_lines(data) for form in _forms(data, f0, LIMITS.line_powers)]
    for f0 in () if data.rotor is None else data.rotor.resonances_hz:
        if data.band[0] < f0 < data.band[1]:
            forms += _forms(data, f0, LIMITS.disc_powers)  # the notch of the shaft leaves it out
    if not forms:
        return None
    forms.append(np.ones(data.f_hz.size))
    columns = np.stack(forms, axis=1) / np.linalg.norm(forms, axis=1)
    shapes, kept = [], []
    for own in weights:
        Q, _ = np.linalg.qr(own[:, None] * columns)
        kept.append(1.0 - np.sum(Q**2, axis=1))
        shapes.append(Q)
    return Leakage(np.array(shapes, np.float32), np.array(kept))


def _forms(data: MotionRecord, f0: float, powers: tuple[int, int]) -> list[Array]:
    """Shapes (bins,) of what leaks from f0, Hz. powers : highest power of the cotangent at f0 and at -f0."""
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


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise:
    """Sensor noise in the residual forces, and the weights that whiten them.

    weight : (places, bins) S over the PSD of each residual force. share : (places, bins) share of sensor noise in that
    PSD. root : (bins, places) one over the root of that PSD. shared : (bins, places, places) correlations of the
    residual forces by noise; None where they are independent.
    """

    weight: Array
    share: Array
    root: Array
    shared: Complexes | None

    def correlation(self, i: int, j: int) -> Complexes | float:
        """(bins,) correlation of two residual forces by sensor noise."""
        return 0.0 if self.shared is None else np.asarray(self.shared[:, i, j])

    def to_measured(self, A: Complexes) -> Complexes | None:
        """(bins, places, places) factor from the response to the motion to the response to the measured motion.

        A : (bins, places, places) along the line of the determinant. None where the two responses are the same.
        """
        if self.shared is None:
            return None
        apart = self.shared * self.root[:, None, :] / self.root[:, :, None]  # R W - 1
        return np.asarray(np.eye(A.shape[1]) + np.linalg.solve(A, apart @ A))


def referred_noise(data: MotionRecord, A: Complexes, nu: Array, S: Array) -> SensorNoise:
    """Sensor noise in residual forces. A : (bins, places, places) kg. nu : (places,) noise over S. S : (places,)."""
    referred = referred_psd(data, A, nu * S) / S[:, None]
    weight = 1.0 / (data.excitation_shape + referred)
    P = len(data.places)
    noise = data.noise_shape * (nu * S)[:, None]
    R = np.einsum("kil,lk,kjl->kij", A, noise, A.conj())
    R[:, range(P), range(P)] = 0.0
    root = np.sqrt(weight / S[:, None]).T
    shared = R * root[:, :, None] * root[:, None, :]
    correlated = np.abs(shared).max(initial=0.0) > LIMITS.min_correlation
    return SensorNoise(weight=weight, share=referred * weight, root=root, shared=shared if correlated else None)


def force_correlation(data: MotionRecord, weight: Array, i: int, j: int) -> Complexes:
    """(bins,) correlation of the residual forces of places i and j per correlation of their excitation.

    weight : (places, bins).
    """
    own = np.sqrt(weight[i] * weight[j])
    return np.asarray(own * np.sqrt(data.excitation_shape[i] * data.excitation_shape[j]), complex)


def referred_psd(data: MotionRecord, A: Complexes, N: Array) -> Array:
    """(places, bins) PSD of sensor noise referred to force, N^2/Hz. N : (places,) PSD of white noise of the sensors."""
    return np.asarray(np.einsum("kil,lk->ik", np.abs(A) ** 2, data.noise_shape * N[:, None]))


Spectrum = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class WhitenedRegressors:
    """Whitened block spectra of k regressors.

    names : (k,) of the parameters. scales : (k,) parameter in SI units per scaled unit. tangents : (k, places,
    places, bins) kg, contribution to A per scaled unit. spectra : by place, (regressors there, blocks, 2 bins), real
    and imaginary parts in turn. index : by place, number of the regressor of each row of `spectra`. apart : (k, folds,
    places, places, 2) mean tangent of each fold minus that of the record, per scaled unit.
    """

    names: tuple[str, ...]
    scales: Array
    tangents: Complexes
    spectra: dict[int, Spectrum]
    index: dict[int, NDArray[np.int64]]
    apart: Array


@dataclass(kw_only=True)
class Whitening:
    """Turns time series into whitened block spectra.

    data : the motion. noise : sensor noise referred to force, with the weights. s : (bins,) rad/s, line of the
    determinant. measured : (bins, places, places), factor from a response to the motion to the response to the measured
    motion; None where they are the same. leakage : of narrow lines, taken out of the spectra; None where no line
    is strong.
    """

    data: MotionRecord
    noise: SensorNoise
    s: Complexes
    measured: Complexes | None = None
    _root: NDArray[np.float32] = field(init=False)  # (places, 2 bins), of real and imaginary parts
    _bins: slice | NDArray[np.int64] = field(init=False)
    _level_root: list[Spectrum] | None = field(init=False)
    leakage: Leakage | None = field(init=False)

    def __post_init__(self) -> None:
        # one-sided PSD normalisation: the mean of |F|^2 over bins is S
        self._root = np.sqrt(self.weight * 2.0 / (self.data.rate_hz * self.data.block)).astype(np.float32)
        bins = self.data.bins
        self._level_root = None if self.data.level is None else [
            (1.0 / np.sqrt(self.relative_psd(i, own))).astype(np.float32) for i, own in enumerate(self.data.level)
        ]  # fmt: skip
        self.leakage = line_leakage(self.data, self._root)
        self._root = np.repeat(self._root, 2, axis=1)
        unbroken = bins[-1] - bins[0] == bins.size - 1  # a slice is read four times faster
        self._bins = slice(int(bins[0]), int(bins[-1]) + 1) if unbroken else bins

    @property
    def weight(self) -> Array:
        """(places, bins) S over the expected PSD of the residual force."""
        return self.noise.weight

    def spectrum(
        self, i: int, series: Array | Spectrum, scale: float = 1.0, out: Spectrum | None = None, first: int = 0
    ) -> Spectrum:
        """(blocks, 2 bins) whitened spectra of scale times a series (n,) N at place i, in the bins of the band.

        out : array to fill; None: a new one. first : number of the block that the series begins with.
        """
        from scipy.fft import rfft

        z, root = series.reshape(-1, self.data.block), self._root[i]
        if out is None:
            out = np.empty((len(z), root.size), np.float32)
        single = z.dtype == np.float32
        root = root * np.float32(scale) if single else root
        for a in range(0, len(z), LIMITS.blocks_per_fft):
            part, made = z[a : a + LIMITS.blocks_per_fft], out[a : a + LIMITS.blocks_per_fft]
            part = part if single else (scale * part).astype(np.float32)  # it may be too small for that before
            np.multiply(self._in_band(np.asarray(rfft(part, axis=1))).view(np.float32), root, out=made)
            if self.leakage is not None:
                self.leakage.take_out(i, made)
            if self._level_root is not None:
                made.view(np.complex64)[...] *= self._level_root[i][first + a : first + a + len(made)]
        return out

    def _in_band(self, Z: NDArray[Any]) -> NDArray[Any]:
        """(blocks, bins) of the band; a view where the bins are contiguous."""
        return Z[:, self._bins] if isinstance(self._bins, slice) else np.take(Z, self._bins, axis=1)

    def relative_psd(self, i: int, level: Array) -> Array:
        """(blocks, bins) PSD of the residual force at place i over that of the record.

        level : (blocks,) of the excitation. Sensor noise does not rise with it.
        """
        return np.asarray(level[:, None] + (1.0 - level[:, None]) * self.noise.share[i])

    def power(self, i: int, Z: Spectrum) -> Array:
        """(blocks,) power of a spectrum Z (blocks, 2 bins) at place i, before the weights by the level of blocks."""
        if self._level_root is not None:
            Z = (Z.view(np.complex64) / self._level_root[i]).view(np.float32)
        return np.asarray(np.einsum("bk,bk->b", Z, Z), np.float64)

    def tangents_to_measured(self, tangents: Complexes) -> Complexes:
        """(k, places, places, bins) tangents as the determinant needs them: responses to the measured motion."""
        if self.measured is None:
            return tangents
        return tangent_times(tangents, self.measured)

    def whiten(self, regressors: list[Regressor]) -> WhitenedRegressors:
        """The whitened spectra and the tangents of regressors."""
        index: dict[int, list[int]] = {}
        for k, regressor in enumerate(regressors):
            for i in regressor.series:
                index.setdefault(i, []).append(k)

        def at(i: int) -> Spectrum:
            out = np.empty((len(index[i]), self.data.blocks, 2 * self.weight.shape[1]), np.float32)
            for row, k in zip(out, index[i], strict=True):
                self.spectrum(i, regressors[k].series[i], regressors[k].scale, row)
                if (shape := regressors[k].shape) is not None:
                    row.view(np.complex64)[...] *= shape.astype(np.complex64)
            return out

        spectra = dict(zip(index, map_threads(at, index), strict=True))
        tangents = self.tangents_to_measured(np.array([regressor_response(t, self.s) for t in regressors]))
        return WhitenedRegressors(
            names=tuple(t.name for t in regressors),
            scales=np.array([t.scale for t in regressors]),
            tangents=tangents,
            spectra=spectra,
            index={i: np.array(k) for i, k in index.items()},
            apart=np.array(
                [np.zeros((TIME_FOLDS, *t.tangent.shape)) if t.apart is None else t.apart * t.scale for t in regressors]
            ),
        )
