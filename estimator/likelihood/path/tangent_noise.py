"""Noise of displacement sensors in nonlinear laws, taken out of the Gram matrices (errors in variables).

A law along x + e gives phi(x) + T e + e^2 phi''/2, with T its tangent. The mean tangent is in the response A, which
refers sensor noise to force. The rest of the tangent fluctuates: its product with e is white noise of PSD cov(T) N in
the residual force and in the regressors. The last term has the mean <e^2> b x, with b the slope of T over x^2.
Velocities and accelerations are denoised instead (motion/denoise.py); their noise is negligible above the resonance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.motion.denoise import MAX_NOISE_POWER_SHARE
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.likelihood.response.regressor_set import unit_tangents
from estimator.likelihood.whitening.whitening import Whitening

from .path_fit import Gram


def without_tangent_noise(
    gram: Gram, whitening: Whitening, uses: Sequence[LocatedLaw], N: Array, weights: Array | None = None
) -> Gram:
    """The Gram matrices without the noise of displacement sensors in the laws. N : (places,) its one-sided PSD.

    weights : (places, folds) sum of the weights over all bins and blocks of a fold; None: those of the time folds.
    """
    data = whitening.data
    if weights is None:
        weights = np.multiply.outer(whitening.weight.sum(axis=1), data.fold_blocks)
    variance = N * (data.band[1] - data.band[0])
    noisy = [
        i for i, kind in enumerate(data.kinds)
        if kind == "displacement" and variance[i] > MAX_NOISE_POWER_SHARE * data.rms[0, i] ** 2
    ]  # fmt: skip
    out = gram
    for i in noisy:
        rows, tangents = _row_tangents(gram, whitening, uses, i)
        if rows and f"{data.places[i]}.kL" in gram.names:
            out = _corrected(out, whitening, i, rows, tangents, N[i] * weights[i], variance[i])
    return out


def _row_tangents(gram: Gram, whitening: Whitening, uses: Sequence[LocatedLaw], i: int) -> tuple[list[int], Array]:
    """Rows of the Gram matrix of place i that laws act in, the residual force first, and their tangents (rows, n) along
    x; scaled."""
    data, rows, series = whitening.data, [0], []
    total = np.zeros(data.x.shape[1])
    for use in (u for u in uses if i in u.at and u.effect.kind == "force"):
        for k, q in enumerate(use.effect.parameters):
            if use.name(k) in gram.names:
                column = gram.names.index(use.name(k))
                own = unit_tangents(use, k, data, i)[0].astype(np.float64)
                total += use.p[k] * own if q.linear else 0.0
                rows.append(1 + column)
                series.append(own * gram.scales[column])
    return (rows, np.array([total, *series])) if series else ([], np.zeros((0, 0)))


def _corrected(
    gram: Gram, whitening: Whitening, i: int, rows: list[int], tangents: Array, noise: Array, variance: float
) -> Gram:
    """The Gram matrices with the noise at place i taken out.

    noise : (folds,) PSD of the noise times the sum of the weights. variance : m^2, of the noise in the band.
    """
    data, at = whitening.data, np.array(rows)
    own, square = tangents - tangents.mean(axis=1, keepdims=True), data.displacement(i).astype(np.float64) ** 2
    square -= square.mean()
    slope = own @ square / (square @ square)
    kL = 1 + gram.names.index(f"{data.places[i]}.kL")
    straight = np.eye(len(gram.names) + 1)
    straight[at, kL] -= variance * slope / gram.scales[kL - 1]
    G = gram.G.copy()
    added = np.zeros_like(straight)
    added[at[:, None], at] = (own @ own.T) / own.shape[1]
    G[i] = straight @ (G[i] - noise[:, None, None] * added) @ straight.T
    tangents_of = gram.tangents.copy()
    for row, b in zip(rows[1:], slope[1:], strict=True):
        tangents_of[row - 1] -= variance * b / gram.scales[kL - 1] * gram.tangents[kL - 1]
    return replace(gram, G=G, tangents=tangents_of)
