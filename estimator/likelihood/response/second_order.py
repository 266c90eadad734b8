"""Second-order correction of the laws of a force balance, and tangent noise from displacement sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.force_balance import Balance
from estimator.likelihood.motion.law_columns import Columns
from estimator.likelihood.motion.stream_record import Record, stretches
from estimator.signals.band_limit import passband
from estimator.signals.blocks import valid_blocks

from .modal_response import ModalResponse, modal_responses
from .self_energy import (
    COVARIANCE_DECAYS,
    MIN_COVARIANCE_S,
    second_order_response,
    self_energy,
    tangent_covariance,
    tangent_spectra,
)


def self_energies(
    record: Record, columns: Columns, B: Array, tangents: Array, f_hz: Array, seconds: float = MIN_COVARIANCE_S
) -> Complexes | None:
    """(f, columns, columns) N/m, self-energy per pair of laws at one place: Sigma_j is its sum over k times B_k.

    B : (places, columns) coefficients of the balance. tangents : (columns, 4) mean tangents. 0 where free motion does
    not decay. None if a mean tangent is not positive, or without laws.
    """
    balance = columns.balance
    D = mean_tangents(balance, B, tangents)
    own = np.einsum("iik->ki", D)
    if all(law.effect.kind != "force" for law in balance.laws) or np.any(own <= 0.0) or np.any(np.diag(B) <= 0.0):
        return None
    mean = cap_responses(balance, B, D)
    out = np.zeros((f_hz.size, len(balance.columns), len(balance.columns)), complex)
    for row in [i for i, m in enumerate(mean) if m.sound]:
        laws = [
            k
            for k, c in enumerate(balance.columns)
            if c.kind == "law" and c.row == row and balance.laws[c.law].effect.kind == "force"
        ]
        if laws:
            C, dt = _covariances(record, columns, laws, mean[row], seconds)
            if not np.isfinite(C).all():
                raise columns.not_finite(laws[0])
            out[:, np.array(laws)[:, None], laws] = pair_energies(C, dt, B[row, laws], mean[row], f_hz)
    return out


@dataclass(frozen=True, slots=True)
class TangentNoise:
    """Effect of the noise of displacement sensors on the laws, per unit of each law; 0 for other columns and sensors.

    Sensor noise e enters the force of a law as phi'(x) e + phi''(x) e^2 / 2. The mean tangent is part of A. The
    fluctuation of the tangent adds white noise to the column of the law, which biases least squares (errors in
    variables). The second part has the mean <e^2> phi'' / 2, which acts as a stiffness.

    covariance : (places, columns, columns) (N/m)^2, of the tangents at a place. bend : (places, columns) N/m^3, half
    the curvature of the tangent, from its regression on x^2.
    """

    covariance: Array
    bend: Array


def without_noise(
    noise_of_tangents: TangentNoise, noise: Array, rate_hz: float, band: tuple[float, float]
) -> Callable[[Array, Array, Array], tuple[Array, Array]]:
    """A function (gram, count, mean) that removes tangent noise from Gram matrices (..., k, k) of `count` bins and from
    mean tangents (k, 4).

    noise : (places,) one-sided PSD of the sensors.
    """
    P, k = noise_of_tangents.bend.shape
    f = np.linspace(0.0, 0.5 * rate_hz, 2000)
    variance = noise * np.trapezoid(passband(f, rate_hz, band) ** 2, f)
    straight = np.eye(k)
    straight[:, 2 * P : 3 * P] -= (variance[:, None] * noise_of_tangents.bend).T
    per_bin = np.einsum("i,ikl->kl", noise, noise_of_tangents.covariance)

    def still(gram: Array, count: Array, mean: Array) -> tuple[Array, Array]:
        slope = mean.copy()
        slope[:, 0] -= variance @ noise_of_tangents.bend
        return straight @ (gram - count * per_bin) @ straight.T, slope

    return still


def _covariances(
    record: Record, columns: Columns, laws: list[int], mean: ModalResponse, seconds: float
) -> tuple[Array, float]:
    """(laws, laws, 2, 2, lags) <kappa_ja(t + lag) kappa_kb(t)>, a and b: along x and v; and the time step."""
    usable = valid_blocks(record.motion.valid, record.grid)[::2]  # each row once
    usable = usable[: max(2, int(mean.seconds(seconds, COVARIANCE_DECAYS) * record.rate_hz / record.grid.size))]
    series, factor = _series(record, columns, laws, usable)  # (laws, 2, blocks, n)
    dt = 1.0 / (factor * record.rate_hz)
    series -= series.mean(axis=(2, 3), keepdims=True)
    lags = mean.lags(dt, series.shape[3])
    Z = [tangent_spectra(z, lags) for z in series]
    return np.array([[tangent_covariance(a, b, lags) for b in Z] for a in Z]), dt


def pair_energies(C: Array, dt: float, B: Array, mean: ModalResponse, f_hz: Array) -> Complexes:
    """(f, laws, laws) self-energies of each law by each, from their covariances (laws, laws, 2, 2, lags)."""
    g = second_order_response(np.einsum("j,k,jkabt->abt", B, B, C), dt, mean)
    out = np.zeros((f_hz.size, B.size, B.size), complex)
    if g is not None:
        for j, k in np.ndindex(B.size, B.size):
            out[:, j, k] = self_energy(C[j, k], g, dt, f_hz)
    return out


def _series(record: Record, columns: Columns, laws: list[int], usable: NDArray[np.intp]) -> tuple[Array, int]:
    """(laws, 2, blocks, n) tangents along x and v, all on the finest grid that one of the laws needs."""
    grid = record.grid
    parts = []
    for group in stretches(usable, 1):
        start = int(group[0]) * grid.hop
        parts.append([columns.tangent_series(k, record.stretch(start, start + grid.size)) for k in laws])
    factor = max(p[2] for p in parts[0])
    out = np.empty((len(laws), 2, len(parts), grid.size * factor))
    fine = np.arange(grid.size * factor) / factor
    for b, part in enumerate(parts):
        for j, (kx, kv, own) in enumerate(part):
            for a, z in enumerate((kx, kv)):
                out[j, a, b] = z if own == factor else np.interp(fine, np.arange(grid.size), z)
    return out, factor


def mean_tangents(balance: Balance, B: Array, tangents: Array) -> Array:
    """(places, places, 2) mean tangents of displacement and velocity, N/m and N s/m, from the coefficients and the
    tangents of the columns (columns, 4); what B has of a chain's springs included."""
    P = len(balance.places)
    D = np.zeros((P, P, 2))
    for i in range(P):
        D[i, i] = B[i, 2 * P + i], B[i, P + i]
        law = np.array([c.kind == "law" and c.row == i for c in balance.columns])
        moved = B[i, law] @ tangents[law]
        D[i, i] += moved[:2]
        if (other := balance.other(i)) >= 0:
            D[i, other] += moved[2:]
    return D


def cap_responses(balance: Balance, B: Array, D: Array) -> tuple[ModalResponse, ...]:
    """Mean response of each place, D as `mean_tangents` gives it."""
    return modal_responses(np.diag(B), balance.by_itself(D), balance.places, balance.disc)


def second_order_change(pairs: Complexes, balance: Balance, B: Array, f_hz: Array) -> Complexes:
    """(f, columns) change of each column's response to the acceleration of its own place, 1/(m/s^2) of its unit."""
    w = 2 * np.pi * f_hz
    out = np.zeros((f_hz.size, len(balance.columns)), complex)
    for j, column in enumerate(balance.columns):
        if column.kind == "law":
            out[:, j] = pairs[:, j] @ B[column.row] / w**2
    return out
