"""Second-order correction of mean responses by the fluctuating tangents of the laws at a working point.

What a fluctuating tangent does to the mean response of a law, to second order, from covariances of tangents.

The data's side of the score of a law is E[phi_j F] in the band. For Gaussian white F it equals (Novikov's theorem) S
times the mean of phi_j' G, with G the response of the linearised motion whose tangents fluctuate with the state. The
mean tangent times the mean response leaves out that the two are correlated. With tangents phi_j' = <phi_j'> + kappa_j
and K = sum beta_k kappa_k, to second order

    < phi_j' G > = (<phi_j'> - Sigma_j) <G>,    Sigma_j(f) = FT[ C_jK(tau) g(tau) ],   tau > 0,

C_jK the covariance of kappa_j with K a time tau before, g the impulse response, itself corrected by K. Over all
frequencies Sigma_j adds nothing (causality), but it moves the response of a law from low to high frequencies. The
largest effect is that of Coulomb friction, whose tangent is a train of impulses.

References
----------
Novikov, Functionals and the random-force method in turbulence theory, JETP 20, 1965. Furutsu, J. Res. NBS 67D, 1963.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.located_law import LocatedLaw, needs_finer_grid, tangent_series
from estimator.likelihood.motion.motion_record import MotionRecord, decimated_record, leading_blocks, oversampled
from estimator.likelihood.thresholds import LIMITS
from estimator.parallel import map_threads

from .modal_response import ModalResponse

TangentSpectra = tuple[NDArray[np.complex64] | None, ...]


def tangent_spectra(tangents: NDArray[np.floating], lags: int) -> TangentSpectra:
    """Spectra (pieces, lags + 1) of tangents along x and v, (2, blocks, n), in pieces of `lags`; None if 0."""
    from scipy.fft import rfft

    n = tangents.shape[2] // lags * lags
    pieces = tangents[..., :n].reshape(2, -1, lags)
    return tuple(
        np.asarray(rfft((z - z.mean()).astype(np.float32, copy=False), 2 * lags, axis=1)) if z.any() else None
        for z in pieces
    )


@njit(cache=True, nogil=True)
def _cross(Z, K):  # type: ignore[no-untyped-def]
    """(f,) mean over the pieces of Z conj(K), both (pieces, f)."""
    out, each = np.zeros(Z.shape[1], np.complex128), 1.0 / Z.shape[0]
    for p in range(Z.shape[0]):
        for f in range(out.size):
            out[f] += each * Z[p, f] * K[p, f].conjugate()
    return out


def tangent_covariance(Z: TangentSpectra, K: TangentSpectra, lags: int) -> Array:
    """(2, 2, lags) covariance <kappa_a(t + lag) K_b(t)>, a and b along x and v, from spectra by as many lags."""
    C = np.zeros((2, 2, lags))
    for a, b in np.ndindex(2, 2):
        if (z := Z[a]) is not None and (k := K[b]) is not None:
            C[a, b] = np.fft.irfft(_cross(z, k), 2 * lags)[:lags] / (lags - np.arange(lags))
    return C


def second_order_response(total: Array, dt: float, mean: ModalResponse) -> Array | None:
    """(2, lags) impulse response of x and v, corrected by its own self-energy (causal at any strength of K).

    total : (2, 2, lags) covariance of K. None if K is too strong for the second order, or if free motion does not decay
    within the lags.
    """
    lags = total.shape[2]
    if not mean.sound or mean.unfinished(lags * dt) > LIMITS.max_power_after_lags:
        return None
    if (
        total[0, 0, 0]
        > min(LIMITS.max_stiffness_sd_rel * mean.stiffness, LIMITS.max_stiffness_sd_over_width * mean.width) ** 2
    ):
        return None
    w: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(2 * lags, dt), np.float64)
    G, bare, iw = mean.at(w), mean.after(np.arange(lags, dtype=np.float64) * dt), 1j * w
    sigma, g = np.zeros(iw.size, complex), bare
    for _ in range(LIMITS.response_rounds):
        sigma = 0.5 * (sigma + _transform(total, g, dt))
        change = sigma * G**2 / (1.0 - sigma * G)
        g = bare + np.fft.irfft(np.stack([change, iw * change]), axis=1)[:, :lags] / dt
    return g


def _transform(C: Array, g: Array, dt: float) -> Complexes:
    """(lags + 1,) Fourier transform of C g, x and v together, on its own grid of frequencies."""
    lags = C.shape[2]
    tau, iw = np.arange(lags) * dt, 2j * np.pi * np.fft.rfftfreq(2 * lags, dt)
    weight = np.exp(-((tau / (0.8 * tau[-1])) ** 8)) * dt
    weight[0] *= 0.5
    both = np.fft.rfft(np.einsum("abt,at->bt", C, g * weight), 2 * lags, axis=1)
    return np.asarray(both[0] + iw * both[1])


def self_energy(C: Array, g: Array, dt: float, f_hz: Array) -> Complexes:
    """(f,) N/m per unit of the law, self-energy from C = C_jK (2, 2, lags) and the corrected response g (2, lags)."""
    f = np.fft.rfftfreq(2 * C.shape[2], dt)
    z = _transform(C, g, dt)
    return np.asarray(np.interp(f_hz, f, z.real) + 1j * np.interp(f_hz, f, z.imag))


@dataclass(frozen=True, slots=True, kw_only=True)
class Fluctuation:
    """Fluctuation of the tangents of all laws at one place.

    data : the part of the record that is used. place : index of the place. total : (2, n) sum of the tangents along x
    and v, less its mean. K : spectra of total. g : (2, lags) corrected impulse response of x and v. whole : (bins,)
    N/m, self-energy of all laws together. only : the law if there is one only; None otherwise.
    """

    data: MotionRecord
    place: int
    total: NDArray[np.float32]
    K: TangentSpectra
    g: Array
    whole: Complexes
    only: LocatedLaw | None = None

    def per_unit(self, placed: LocatedLaw, k: int) -> Complexes | None:
        """(bins,) N/m, self-energy per unit of parameter k if that is the only amplitude of the only law; else None."""
        amplitudes = [j for j, q in enumerate(placed.effect.parameters) if q.linear]
        return self.whole / placed.p[k] if placed is self.only and amplitudes == [k] and placed.p[k] else None

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
        return Fluctuation(
            data=data, place=self.place, total=total, K=_spectra(total, data, g.shape[1]), g=g, whole=self.whole,
            only=self.only,
        )  # fmt: skip


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
        only = own[i][0] if len(own[i]) == 1 else None
        if g is None:
            return None
        return Fluctuation(data=part, place=i, total=total, K=K, g=g, whole=self_energy(C, g, dt, data.f_hz), only=only)

    return tuple(map_threads(at, range(len(mean))))
