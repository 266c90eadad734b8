"""What a fluctuating tangent does to the Jacobian: the mean response of a law, dressed to second order.

The data's side of the score of a law is E[phi_j F] in the band. For Gaussian white F it equals (Novikov's theorem) S
times the mean of phi_j' G, with G the response of the linearised motion whose tangents fluctuate with the state. The
mean tangent times the mean response leaves out that the two are correlated. With tangents phi_j' = <phi_j'> + kappa_j
and K = sum beta_k kappa_k, to second order

    < phi_j' G > = (<phi_j'> - Sigma_j) <G>,    Sigma_j(f) = FT[ C_jK(tau) g(tau) ],   tau > 0,

C_jK the covariance of kappa_j with K a time tau before, g the impulse response, itself dressed by K. Over all
frequencies Sigma_j adds nothing (causality), but it moves the response to a law from low to high frequencies: for
Coulomb friction, whose tangent is a train of impulses, 5 % of it leaves a band of 8 kHz, and the friction would come
out 15 % too high.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .balance import Balance
from .columns import Columns
from .gram import valid_blocks
from .record import Record, stretches

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
SECONDS, DECAYS = 8.0, 1000.0  # of the record that the covariances are taken from: the longer of the two
ROUNDS = 10  # of the self-consistent response
STRONG = 1.0  # rms of the tangent stiffness over its mean, above which the second order is not used


@dataclass(frozen=True, slots=True)
class Mean:
    """The mean response at a place: m x'' + c x' + k x = F, effects included by their mean tangents. SI."""

    m: float
    c: float
    k: float


def self_energies(
    record: Record, columns: Columns, B: Floats, mean: list[Mean], f_hz: Floats, seconds: float = SECONDS
) -> Complexes:
    """(f, columns, columns) N/m, at f_hz, per pair of law columns at one place: Sigma_j is its sum over k times B_k.

    B : (places, columns) coefficients of the balance; mean : of each place.
    """
    balance = columns.balance
    out = np.zeros((f_hz.size, len(balance.columns), len(balance.columns)), complex)
    for row in range(len(balance.places)):
        laws = [
            k
            for k, c in enumerate(balance.columns)
            if c.kind == "law" and c.row == row and balance.laws[c.law].effect.kind == "force"
        ]
        if laws:
            C, dt = _covariances(record, columns, laws, mean[row], seconds)
            pairs = _self_consistent(C, dt, B[row, laws], mean[row], f_hz)
            out[:, np.array(laws)[:, None], laws] = pairs
    return out


@dataclass(frozen=True, slots=True)
class Flutter:
    """What the noise e of displacement sensors does in the laws, per unit of each law.

    covariance : (places, columns, columns) of the tangents at a place, (N/m)^2. bend : (places, columns) N/m^3, half
    the curvature of the tangent, from its regression on x^2; both 0 for other columns and sensors.
    """

    covariance: Floats
    bend: Floats


def flutter(record: Record, columns: Columns, seconds: float = SECONDS) -> Flutter | None:
    """What noise does in the laws; None where no sensor is one of displacement (integrated, that of others is small).

    The noise enters the force of a law as phi'(x) e + phi''(x) e^2 / 2. The mean tangent is seen through A; by what it
    fluctuates it adds white noise to the column of the law, which least squares would bend the law to shrink. The
    second part has the mean <e^2> phi'' / 2, which looks like a stiffness.
    """
    balance = columns.balance
    covariance = np.zeros((len(balance.places), len(balance.columns), len(balance.columns)))
    bend = np.zeros((len(balance.places), len(balance.columns)))
    usable = valid_blocks(record.motion.valid, record.grid)[::2]
    usable = usable[: max(2, int(seconds * record.rate_hz / record.grid.size))]
    for row, kind in enumerate(balance.kinds):
        laws = [
            k
            for k, c in enumerate(balance.columns)
            if c.kind == "law" and c.row == row and balance.laws[c.law].effect.kind == "force"
        ]
        if laws and kind == "displacement":
            series, factor = _series(record, columns, laws, usable)
            tangents = series[:, 0, :, ::factor].reshape(len(laws), -1)
            first = usable * record.grid.hop
            square = np.concatenate([record.motion.x[row, a : a + record.grid.size] for a in first]) ** 2
            square -= square.mean()
            covariance[row, np.array(laws)[:, None], laws] = np.cov(tangents).reshape(len(laws), len(laws))
            bend[row, laws] = tangents @ square / (square @ square)
    return Flutter(covariance, bend) if covariance.any() else None


def _covariances(record: Record, columns: Columns, laws: list[int], mean: Mean, seconds: float) -> tuple[Floats, float]:
    """(laws, laws, 2, 2, lags) <kappa_ja(t + lag) kappa_kb(t)>, a and b: along x and v; and the time step."""
    usable = valid_blocks(record.motion.valid, record.grid)[::2]  # each row once
    seconds = max(seconds, DECAYS * 2 * mean.m / mean.c)
    usable = usable[: max(2, int(seconds * record.rate_hz / record.grid.size))]
    series, factor = _series(record, columns, laws, usable)  # (laws, 2, blocks, n)
    dt = 1.0 / (factor * record.rate_hz)
    series -= series.mean(axis=(2, 3), keepdims=True)
    lags = min(series.shape[3], 1 << int(np.ceil(np.log2(14.0 * mean.m / mean.c / dt))))
    pieces = series[..., : series.shape[3] // lags * lags].reshape(len(laws), 2, -1, lags)
    Z = np.fft.rfft(pieces, 2 * lags, axis=3)
    C = np.empty((len(laws), len(laws), 2, 2, lags))
    for j, k, a, b in np.ndindex(C.shape[:4]):
        if Z[j, a].any() and Z[k, b].any():
            cross = np.einsum("bf,bf->f", Z[j, a], Z[k, b].conj()) / Z.shape[2]
            C[j, k, a, b] = np.fft.irfft(cross, 2 * lags)[:lags] / (lags - np.arange(lags))
        else:
            C[j, k, a, b] = 0.0
    return C, dt


def _self_consistent(C: Floats, dt: float, B: Floats, mean: Mean, f_hz: Floats) -> Complexes:
    """(f, laws, laws) self-energies, with the response in them dressed by their own sum (causal at any strength)."""
    lags = C.shape[4]
    tau, f = np.arange(lags) * dt, np.fft.rfftfreq(2 * lags, dt)
    iw = 2j * np.pi * f
    weight = np.exp(-((tau / (0.8 * tau[-1])) ** 8)) * dt
    weight[0] *= 0.5
    D = mean.k + iw * mean.c + iw**2 * mean.m
    decay = mean.c / (2 * mean.m)
    wd = np.sqrt(max(mean.k / mean.m - decay**2, 1.0))
    bare = np.exp(-decay * tau) * np.sin(wd * tau) / (mean.m * wd)
    bare_v = np.exp(-decay * tau) * (np.cos(wd * tau) - decay / wd * np.sin(wd * tau)) / mean.m

    def transform(K: Floats, g: Floats) -> Complexes:
        lagged = np.einsum("abt,at->bt", K, g * weight)
        both = np.fft.rfft(lagged, 2 * lags, axis=1)
        return np.asarray(both[0] + iw * both[1])

    total = np.einsum("j,k,jkabt->abt", B, B, C)
    if total[0, 0, 0] > (STRONG * mean.k) ** 2:
        return np.zeros((f_hz.size, B.size, B.size), complex)
    sigma, g = np.zeros(f.size, complex), np.stack([bare, bare_v])
    for _ in range(ROUNDS):
        sigma = 0.5 * (sigma + transform(total, g))
        change = 1.0 / (D - sigma) - 1.0 / D
        g = np.stack([bare, bare_v]) + np.fft.irfft(np.stack([change, iw * change]), axis=1)[:, :lags] / dt
    keep = np.searchsorted(f, [f_hz[0], f_hz[-1]]) + np.array([-1, 1])
    part = slice(max(keep[0], 0), keep[1] + 1)
    out = np.empty((f_hz.size, B.size, B.size), complex)
    for j, k in np.ndindex(B.size, B.size):
        z = transform(C[j, k], g)[part]
        out[:, j, k] = np.interp(f_hz, f[part], z.real) + 1j * np.interp(f_hz, f[part], z.imag)
    return out


def _series(record: Record, columns: Columns, laws: list[int], usable: NDArray[np.intp]) -> tuple[Floats, int]:
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


def mean_responses(balance: Balance, B: Floats, tangents: Floats) -> list[Mean]:
    """Of each place, from the coefficients and the mean tangents (columns, 4); the shaft's springs are left out."""
    P = len(balance.places)
    out = []
    for i in range(P):
        law = np.array([c.kind == "law" and c.row == i for c in balance.columns])
        k, c = (float(B[i, n * P + i] + B[i, law] @ tangents[law, a]) for n, a in ((2, 0), (1, 1)))
        out.append(Mean(float(B[i, i]), c, k))
    return out


def dressed(pairs: Complexes, balance: Balance, B: Floats, f_hz: Floats) -> Complexes:
    """(f, columns) change of each column's response to the acceleration of its own place, 1/(m/s^2) of its unit."""
    w = 2 * np.pi * f_hz
    out = np.zeros((f_hz.size, len(balance.columns)), complex)
    for j, column in enumerate(balance.columns):
        if column.kind == "law":
            out[:, j] = np.einsum("fk,k->f", pairs[:, j], B[column.row]) / w**2
    return out
