"""Second-order correction of mean responses by the fluctuating tangents of the laws at a working point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.located_law import LocatedLaw, needs_finer_grid, tangent_series
from estimator.likelihood.motion.motion_record import MotionRecord, decimated_record, leading_blocks, oversampled
from estimator.likelihood.thresholds import LIMITS
from estimator.parallel import map_threads

from .modal_response import ModalResponse
from .self_energy import TangentSpectra, second_order_response, self_energy, tangent_covariance, tangent_spectra


@dataclass(frozen=True, slots=True, kw_only=True)
class Fluctuation:
    """Fluctuation of the tangents of all laws at one place.

    data : the part of the record that is used. place : index of the place. total : (2, n) sum of the tangents along x
    and v, less its mean. K : spectra of total. g : (2, lags) corrected impulse response of x and v. whole : (bins,)
    N/m, self-energy of all laws together.
    """

    data: MotionRecord
    place: int
    total: NDArray[np.float32]
    K: TangentSpectra
    g: Array
    whole: Complexes

    def of(self, tangents: NDArray[np.floating]) -> Complexes:
        """(bins,) N/m per unit, self-energy of a law with tangents (2, n) along x and v on `data`."""
        Z = _spectra(tangents, self.data, self.g.shape[1])
        return self_energy(
            tangent_covariance(Z, self.K, self.g.shape[1]), self.g, 1.0 / self.data.rate_hz, self.data.f_hz
        )

    def shorter(self, seconds: float) -> Fluctuation:
        """Fluctuation from the first `seconds` of the record."""
        data = leading_blocks(self.data, seconds)
        if data is self.data:
            return self
        blocks = self.total.reshape(2, self.data.blocks, -1)
        total = blocks[:, np.isin(self.data.start, data.start)].reshape(2, -1)
        return replace(self, data=data, total=total, K=_spectra(total, data, self.g.shape[1]))

    def coarse(self, rate_hz: float, mean: ModalResponse) -> Fluctuation:
        """Fluctuation at the rate of the record, for laws without jumps, or at a multiple that resolves kinks."""
        by = round(self.data.rate_hz / rate_hz)
        while by > 1 and self.data.rate_hz / by < LIMITS.samples_per_cycle * mean.hz:
            by //= 2
        if by == 1:
            return self
        data = decimated_record(self.data, by)
        g = np.ascontiguousarray(self.g[:, ::by])
        total = np.ascontiguousarray(self.total[:, ::by])
        return replace(self, data=data, total=total, K=_spectra(total, data, g.shape[1]), g=g)


def _spectra(tangents: NDArray[np.floating], data: MotionRecord, lags: int) -> TangentSpectra:
    return tangent_spectra(tangents.reshape(2, data.blocks, data.block), lags)


def fluctuations(
    data: MotionRecord, uses: Sequence[LocatedLaw], mean: Sequence[ModalResponse], lin: Array
) -> tuple[Fluctuation | None, ...]:
    """Fluctuation at every place; None without a law, or where the laws are too strong for the second order.

    A law that remembers has no tangent at an instant: it counts by its mean response only.

    uses : laws at the working point. mean : modal response of each place, with the mean tangents of memoryless laws.
    lin : (places, 3) m, kL, c.
    """
    own = [[u for u in uses if i in u.at and u.effect.kind == "force"] for i in range(len(mean))]
    used = [i for i, laws in enumerate(own) if laws and mean[i].sound]
    part = (
        leading_blocks(
            data, max(mean[i].seconds(LIMITS.min_covariance_s, LIMITS.covariance_decays) for i in used)
        ).in_one()
        if used
        else data
    )
    if any(needs_finer_grid(u.effect, u.p, data, i) for i in used for u in own[i]):
        part = oversampled(part)
    dt = 1.0 / part.rate_hz

    def at(i: int) -> Fluctuation | None:
        if i not in used:
            return None
        total = tangent_series(own[i][0], part, i, own[i][0].p)
        for u in own[i][1:]:
            total += tangent_series(u, part, i, u.p)
        total -= total.mean(axis=1, keepdims=True)
        lags = mean[i].lags(dt, part.block)
        K = _spectra(total, part, lags)
        C = tangent_covariance(K, K, lags)
        g = second_order_response(C, dt, mean[i])
        if g is None:
            return None
        return Fluctuation(data=part, place=i, total=total, K=K, g=g, whole=self_energy(C, g, dt, data.f_hz))

    return tuple(map_threads(at, range(len(mean))))
