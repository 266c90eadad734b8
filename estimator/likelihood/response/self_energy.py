"""Second-order correction (self-energy) of the mean response of a law, from covariances of its fluctuating tangents.

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

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.thresholds import LIMITS

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


def tangent_covariance(Z: TangentSpectra, K: TangentSpectra, lags: int) -> Array:
    """(2, 2, lags) covariance <kappa_a(t + lag) K_b(t)>, a and b along x and v, from spectra by as many lags."""
    C = np.zeros((2, 2, lags))
    for a, b in np.ndindex(2, 2):
        if (z := Z[a]) is not None and (k := K[b]) is not None:
            cross = (z * k.conj()).mean(axis=0, dtype=np.complex128)
            C[a, b] = np.fft.irfft(cross, 2 * lags)[:lags] / (lags - np.arange(lags))
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
