"""Forces and the terms of laws turned into the weighted spectra of blocks that the path likelihood is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.motion_record import TIME_FOLDS, MotionRecord
from estimator.likelihood.response.regressor_set import Regressor, regressor_response
from estimator.parallel import map_threads

from .determinant import tangent_times
from .disc_ringing import Ringing, ringing
from .sensor_noise import SensorNoise

Spectrum = NDArray[np.float32]
BLOCKS_PER_FFT = 32  # blocks at a time: more do not stay in the cache


@dataclass(frozen=True, slots=True, kw_only=True)
class WhitenedRegressors:
    """Terms turned into weighted spectra, by place: (terms there, blocks, 2 bins) float32."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    scales: Array
    tangents: Complexes  # (terms, places, places, bins), contribution to A per scaled unit
    spectra: dict[int, Spectrum]
    index: dict[int, NDArray[np.int64]]  # place -> number of the term of each row of spectra
    apart: Array  # (terms, folds, places, places, 2) mean tangents of time folds less those of all, per scaled unit


@dataclass
class Whitening:
    """Turns series into weighted block spectra at a working point. s : (bins,) of the determinant. measured : (bins,
    places, places) from a response to the motion to one to what is measured: sensor_noise.py."""

    data: MotionRecord
    noise: SensorNoise
    s: Complexes
    measured: Complexes | None = None
    _root: NDArray[np.float32] = field(init=False)  # (places, 2 bins), of real and imaginary parts
    _bins: slice | NDArray[np.int64] = field(init=False)
    _level_root: list[Spectrum] | None = field(init=False)
    ringing: Ringing | None = field(init=False)

    def __post_init__(self) -> None:
        # one-sided PSD normalisation: the mean of |F|^2 over bins is S
        self._root = np.sqrt(self.weight * 2.0 / (self.data.rate_hz * self.data.block)).astype(np.float32)
        bins = self.data.bins
        self._level_root = None if self.data.level is None else [
            (1.0 / np.sqrt(self.relative_psd(i, own))).astype(np.float32) for i, own in enumerate(self.data.level)
        ]  # fmt: skip
        self.ringing = ringing(self.data, self._root)
        self._root = np.repeat(self._root, 2, axis=1)
        unbroken = bins[-1] - bins[0] == bins.size - 1  # a slice is read four times faster
        self._bins = slice(int(bins[0]), int(bins[-1]) + 1) if unbroken else bins

    @property
    def weight(self) -> Array:
        """(places, bins)"""
        return self.noise.weight

    def spectrum(
        self, i: int, series: Array | Spectrum, scale: float = 1.0, out: Spectrum | None = None, first: int = 0
    ) -> Spectrum:
        """(blocks, 2 bins) float32 of scale times a series (n,) seen at place i, the bins of the band.

        first : number of the block that the series begins with.
        """
        from scipy.fft import rfft

        z, root = series.reshape(-1, self.data.block), self._root[i]
        if out is None:
            out = np.empty((len(z), root.size), np.float32)
        single = z.dtype == np.float32
        root = root * np.float32(scale) if single else root
        for a in range(0, len(z), BLOCKS_PER_FFT):
            part, made = z[a : a + BLOCKS_PER_FFT], out[a : a + BLOCKS_PER_FFT]
            part = part if single else (scale * part).astype(np.float32)  # it may be too small for that before
            np.multiply(self._in_band(np.asarray(rfft(part, axis=1))).view(np.float32), root, out=made)
            if self.ringing is not None:
                self.ringing.take_out(i, made)
            if self._level_root is not None:
                made.view(np.complex64)[...] *= self._level_root[i][first + a : first + a + len(made)]
        return out

    def _in_band(self, Z: NDArray[Any]) -> NDArray[Any]:
        """The bins of the band, (blocks, bins), of all: a view of them, if nothing is left out between."""
        return Z[:, self._bins] if isinstance(self._bins, slice) else np.take(Z, self._bins, axis=1)

    def relative_psd(self, i: int, level: Array) -> Array:
        """(blocks, bins) PSD of the inferred force at place i in blocks of a level (blocks,), over that of the record:
        the level of the force but for noise of sensors, which does not rise with it."""
        return np.asarray(level[:, None] + (1.0 - level[:, None]) * self.noise.share[i])

    def power(self, i: int, Z: Spectrum) -> Array:
        """(blocks,) power of a spectrum seen at place i (blocks, 2 bins), as it was before blocks were weighed by the
        level of the force."""
        if self._level_root is not None:
            Z = (Z.view(np.complex64) / self._level_root[i]).view(np.float32)
        return np.asarray(np.einsum("bk,bk->b", Z, Z), np.float64)

    def tangents_to_measured(self, tangents: Complexes) -> Complexes:
        """Tangents (terms, places, places, bins) as the determinant needs them: to what is measured."""
        if self.measured is None:
            return tangents
        return tangent_times(tangents, self.measured)

    def whiten(self, terms: list[Regressor]) -> WhitenedRegressors:
        index: dict[int, list[int]] = {}
        for k, term in enumerate(terms):
            for i in term.series:
                index.setdefault(i, []).append(k)

        def at(i: int) -> Spectrum:
            out = np.empty((len(index[i]), self.data.blocks, 2 * self.weight.shape[1]), np.float32)
            for row, k in zip(out, index[i], strict=True):
                self.spectrum(i, terms[k].series[i], terms[k].scale, row)
                if (shape := terms[k].shape) is not None:
                    row.view(np.complex64)[...] *= shape.astype(np.complex64)
            return out

        spectra = dict(zip(index, map_threads(at, index), strict=True))
        tangents = self.tangents_to_measured(np.array([regressor_response(t, self.s) for t in terms]))
        return WhitenedRegressors(
            names=tuple(t.name for t in terms),
            units=tuple(t.unit for t in terms),
            scales=np.array([t.scale for t in terms]),
            tangents=tangents,
            spectra=spectra,
            index={i: np.array(k) for i, k in index.items()},
            apart=np.array(
                [np.zeros((TIME_FOLDS, *t.tangent.shape)) if t.apart is None else t.apart * t.scale for t in terms]
            ),
        )
