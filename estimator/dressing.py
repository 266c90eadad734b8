"""The laws of a force balance dressed by what their tangents fluctuate (self_energy.py)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .balance import Balance
from .columns import Columns
from .contour import lasting, modes_of
from .features import MARGIN
from .gram import valid_blocks
from .likelihood import responses
from .record import Record, stretches
from .self_energy import SECONDS, Mean, covariance, dressed_response, self_energy, spectra

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Fluctuating:
    """How the tangents of the laws at a place fluctuate. laws : their columns. mean : response of the place.

    C : (laws, laws, 2, 2, lags) <kappa_ja(t + lag) kappa_kb(t)>, a and b: along x and v; dt : s, of a lag. bend :
    (laws,) N/m^3, half the curvature of the tangent, from its regression on x^2. x2 : m^2, mean square of x.
    """

    row: int
    laws: NDArray[np.intp]
    mean: Mean
    C: Floats
    dt: float
    bend: Floats
    x2: float


def fluctuating(
    record: Record, columns: Columns, B: Floats, tangents: Floats, f_hz: Floats, seconds: float = SECONDS
) -> list[Fluctuating] | None:
    """Of each place with laws, from `seconds` of the record or more.

    B : (places, columns) coefficients of the balance; tangents : (columns, 4) means; f_hz : the band. Without places
    that take part in a mode that lasts or grows (contour.py), as what decays is needed. None where the mean response
    of a place does not decay, or no law is there.
    """
    balance = columns.balance
    mean = mean_responses(balance, B, tangents)
    if all(law.effect.kind != "force" for law in balance.laws) or any(m.c <= 0 or m.k <= 0 for m in mean):
        return None
    modes, motion = modes_of(B @ responses(balance, tangents, f_hz), np.diag(B), f_hz)
    lasts = lasting(modes, motion, np.array([1.0 / m.decay for m in mean]))
    places = [(row, np.array(laws_at(balance, row), np.intp)) for row in np.flatnonzero(~lasts).tolist()]
    return [_of_place(record, columns, row, laws, mean[row], seconds) for row, laws in places if laws.size]


def laws_at(balance: Balance, row: int) -> list[int]:
    """The columns of laws at a place."""
    return [
        k
        for k, c in enumerate(balance.columns)
        if c.kind == "law" and c.row == row and balance.laws[c.law].effect.kind == "force"
    ]


def self_energies(found: list[Fluctuating], B: Floats, f_hz: Floats) -> Complexes:
    """(f, columns, columns) N/m, at f_hz, per pair of law columns at one place: Sigma_j is its sum over k times B_k."""
    out = np.zeros((f_hz.size, B.shape[1], B.shape[1]), complex)
    for z in found:
        out[:, z.laws[:, None], z.laws] = pair_energies(z.C, z.dt, B[z.row, z.laws], z.mean, f_hz)
    return out


def _of_place(
    record: Record, columns: Columns, row: int, laws: NDArray[np.intp], mean: Mean, seconds: float
) -> Fluctuating:
    usable = valid_blocks(record.motion.valid, record.grid)[::2]  # each row once
    usable = usable[: max(2, int(mean.seconds(seconds) * record.rate_hz / record.grid.size))]
    series, x, factor = _series(record, columns, row, laws, usable)
    dt = 1.0 / (factor * record.rate_hz)
    series -= series.mean(axis=(2, 3), keepdims=True)
    lags = mean.lags(dt, series.shape[3])
    Z = [spectra(z, lags) for z in series]
    C = np.array([[covariance(a, b, lags) for b in Z] for a in Z])
    x2 = float(np.mean(x**2))
    square = (x**2 - x2).ravel()
    bend = series[:, 0, :, ::factor].reshape(laws.size, -1) @ square / (square @ square)
    return Fluctuating(row, laws, mean, C, dt, bend, x2)


def pair_energies(C: Floats, dt: float, B: Floats, mean: Mean, f_hz: Floats) -> Complexes:
    """(f, laws, laws) self-energies of each law by each, from their covariances (laws, laws, 2, 2, lags)."""
    g = dressed_response(np.einsum("j,k,jkabt->abt", B, B, C), dt, mean)
    out = np.zeros((f_hz.size, B.size, B.size), complex)
    if g is not None:
        for j, k in np.ndindex(B.size, B.size):
            out[:, j, k] = self_energy(C[j, k], g, dt, f_hz)
    return out


def _series(
    record: Record, columns: Columns, row: int, laws: NDArray[np.intp], usable: NDArray[np.intp]
) -> tuple[Floats, Floats, int]:
    """(laws, 2, blocks, n) tangents along x and v, all on the finest grid that one of the laws needs, (blocks, rows) of
    x, and how many rows of the one there are to one of the other."""
    grid = record.grid
    parts, x = [], np.empty((usable.size, grid.size))
    for b, group in enumerate(stretches(usable, 1)):
        start = int(group[0]) * grid.hop
        stretch = record.stretch(start, start + grid.size)
        x[b] = stretch.x[row, MARGIN:-MARGIN]
        parts.append([columns.tangent_series(k, stretch) for k in laws.tolist()])
    factor = max(p[2] for p in parts[0])
    out = np.empty((laws.size, 2, len(parts), grid.size * factor))
    fine = np.arange(grid.size * factor) / factor
    for b, part in enumerate(parts):
        for j, (kx, kv, own) in enumerate(part):
            for a, z in enumerate((kx, kv)):
                out[j, a, b] = z if own == factor else np.interp(fine, np.arange(grid.size), z)
    return out, x, factor


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
