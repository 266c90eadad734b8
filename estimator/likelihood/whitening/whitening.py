"""Residual force and regressors as whitened block spectra, which the path likelihood is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.response.regressor_set import Regressor, regressor_response
from estimator.likelihood.thresholds import LIMITS
from estimator.parallel import map_threads

from .determinant import tangent_times
from .line_leakage import Leakage, line_leakage
from .sensor_noise import SensorNoise

Spectrum = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class WhitenedRegressors:
    """Whitened block spectra of k regressors.

    names : (k,) of the parameters. scales : (k,) parameter in SI units per scaled unit. tangents : (k, places,
    places, bins) kg, contribution to A per scaled unit. spectra : by place, (regressors there, blocks, 2 bins), real
    and imaginary parts in turn. index : by place, number of the regressor of each row of `spectra`.
    """

    names: tuple[str, ...]
    scales: Array
    tangents: Complexes
    spectra: dict[int, Spectrum]
    index: dict[int, NDArray[np.int64]]


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
        self, i: int, series: Array | Spectrum, scale: float = 1.0, out: Spectrum | None = None,
        blocks: NDArray[np.int64] | None = None,
    ) -> Spectrum:  # fmt: skip
        """(blocks, 2 bins) whitened spectra of scale times a series (n,) N at place i, in the bins of the band.

        out : array to fill; None: a new one. blocks : numbers of the blocks of the series; None: all.
        """
        from scipy.fft import rfft

        z, root = series.reshape(-1, self.data.block), self._root[i]
        level = None if self._level_root is None else self._level_root[i][slice(None) if blocks is None else blocks]
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
            if level is not None:
                made.view(np.complex64)[...] *= level[a : a + len(made)]
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
        )
