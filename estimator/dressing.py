"""What a fluctuating tangent does to the Jacobian: the mean response of a law, dressed to second order.

The data's side of the score of a law is E[phi_j F] in the band. For Gaussian white F it equals (Novikov's theorem) S
times the mean of phi_j' G, with G the response of the linearised motion whose tangents fluctuate with the state. The
mean tangent times the mean response leaves out that the two are correlated. With tangents phi_j' = <phi_j'> + kappa_j
and K = sum beta_k kappa_k, to second order

    < phi_j' G > = (<phi_j'> - Sigma_j) <G>,    Sigma_j(f) = FT[ C_jK(tau) g(tau) ],   tau > 0,

C_jK the covariance of kappa_j with K a time tau before, g the impulse response. Over all frequencies Sigma_j adds
nothing (causality), but it moves the response to a law from low to high frequencies: for Coulomb friction, whose
tangent is a train of impulses, 5 % of it leaves a band of 8 kHz, and the friction would come out 15 % too high.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .balance import Balance
from .columns import Columns
from .gram import valid_blocks
from .record import Record, stretches

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
SECONDS = 8.0  # of the record that the covariances are taken from


def self_energies(
    record: Record, columns: Columns, linear: Floats, damping: Floats, f_hz: Floats, seconds: float = SECONDS
) -> Complexes:
    """(f, columns, columns) N/m, at f_hz, per pair of law columns at one place: Sigma_j is its sum over k times B_k.

    linear : (places, 3) m, kL, c; damping : (places,) of the mean response, with that of the effects, N s/m.
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
            out[:, np.array(laws)[:, None], laws] = _at_place(
                record, columns, laws, linear[row], damping[row], f_hz, seconds
            )
    return out


def _at_place(
    record: Record, columns: Columns, laws: list[int], linear: Floats, damping: float, f_hz: Floats, seconds: float
) -> Complexes:
    grid = record.grid
    m, kL, _ = linear
    usable = valid_blocks(record.motion.valid, grid)[::2]  # each row once
    usable = usable[: max(2, int(seconds * record.rate_hz / grid.size))]
    series, factor = _series(record, columns, laws, usable)  # (laws, 2, blocks, n)
    dt = 1.0 / (factor * record.rate_hz)
    series -= series.mean(axis=(2, 3), keepdims=True)
    length = min(series.shape[3], 1 << int(np.ceil(np.log2(14.0 * m / damping / dt))))
    pieces = series[..., : series.shape[3] // length * length].reshape(len(laws), 2, -1, length)
    Z = np.fft.rfft(pieces, 2 * length, axis=3)
    tau = np.arange(length) * dt
    decay, wd = damping / (2 * m), np.sqrt(max(kL / m - (damping / (2 * m)) ** 2, 1.0))
    taper = np.exp(-((tau / (0.8 * tau[-1])) ** 8)) * dt
    taper[0] *= 0.5
    gx = np.exp(-decay * tau) * np.sin(wd * tau) / (m * wd) * taper
    gv = np.exp(-decay * tau) * (np.cos(wd * tau) - decay / wd * np.sin(wd * tau)) / m * taper
    g = np.stack([gx, gv])
    f = np.fft.rfftfreq(2 * length, dt)
    keep = np.searchsorted(f, [f_hz[0], f_hz[-1]]) + np.array([-1, 1])
    part = slice(max(keep[0], 0), keep[1] + 1)
    iw = 2j * np.pi * f[part]
    out = np.empty((f_hz.size, len(laws), len(laws)), complex)
    for j in range(len(laws)):
        for k in range(len(laws)):
            sigma = np.zeros(iw.size, complex)
            for b in range(2):
                lagged = np.zeros(length)
                for a in range(2):
                    cross = np.mean(Z[j, a] * Z[k, b].conj(), axis=0)
                    C = np.fft.irfft(cross, 2 * length)[:length] / (length - np.arange(length))
                    lagged += C * g[a]
                sigma += np.fft.rfft(lagged, 2 * length)[part] * iw**b
            out[:, j, k] = np.interp(f_hz, f[part], sigma.real) + 1j * np.interp(f_hz, f[part], sigma.imag)
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


def dressed(pairs: Complexes, balance: Balance, B: Floats, f_hz: Floats) -> Complexes:
    """(f, columns) change of each column's response to the acceleration of its own place, 1/(m/s^2) of its unit."""
    w = 2 * np.pi * f_hz
    out = np.zeros((f_hz.size, len(balance.columns)), complex)
    for j, column in enumerate(balance.columns):
        if column.kind == "law":
            out[:, j] = np.einsum("fk,k->f", pairs[:, j], B[column.row]) / w**2
    return out
