"""The part of the score of a fold that comes from its own mean tangent.

Over the whole record the data side of the score of a law, E[phi F], is balanced by S times the mean tangent times the
response. In a fold the balance holds with the mean tangent of that fold: with more motion the tangent is larger. With
the tangent of the record the scores would scatter more than they do, and the intervals would be too wide.
"""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.motion.stream_record import Bank

from .gram_likelihood import Likelihood, Local


def fold_tangent_scores(likelihood: Likelihood, local: Local, bank: Bank) -> Array:
    """(folds, p) part of the scores by beta that the mean tangents of the folds cause.

    A fold with another level of the excitation counts with its tangent at its level.
    """
    evidence, point = likelihood.evidence, local.point
    balance, nodes = evidence.balance, evidence.nodes
    B = balance.coefficients(point.beta)
    A = B @ likelihood.R
    line = likelihood.line(B, A)
    inside = point.S + (np.abs(A) ** 2 * likelihood.noise_shape[:, None, :]) @ point.noise
    kappa = inside / local.spread[nodes.cell] * nodes.weight[:, None]
    weighted = np.linalg.inv(line.A) * kappa[:, None, :]
    s = line.shift + 2j * np.pi * nodes.f_hz
    # (places, places) : the gradient by a coefficient at row j of a force that answers with 1 to x, to v, of place i
    to_x = np.einsum("f,fij->ij", 1 / s**2, weighted).real
    to_v = np.einsum("f,fij->ij", 1 / s, weighted).real
    tangents, weights = bank.fold_tangents, bank.blocks[:, None, None]
    if bank.rest is not None:
        weights = weights * bank.rest[[c.row for c in balance.columns]].T[:, :, None]
    apart = (tangents - np.sum(weights * tangents, axis=0) / np.sum(weights, axis=0)) * weights
    out = np.zeros((bank.blocks.size, likelihood.row.size))
    for e, (row, column) in enumerate(zip(likelihood.row, likelihood.column, strict=True)):
        if balance.columns[column].kind != "law":
            continue
        own = balance.columns[column].row
        other = balance.other(own)
        out[:, e] = apart[:, column, 0] * to_x[own, row] + apart[:, column, 1] * to_v[own, row]
        if other >= 0:
            out[:, e] += apart[:, column, 2] * to_x[other, row] + apart[:, column, 3] * to_v[other, row]
    return np.asarray(out @ likelihood.T.T)
