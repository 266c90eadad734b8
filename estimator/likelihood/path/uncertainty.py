"""Covariance of the fitted parameters: from the curvature of the likelihood, or from the scatter of its slope.

At a maximum the inverse Hessian H^-1 is the covariance if the model is exactly true. If it is not, the covariance is
H^-1 J H^-1 with J from the scatter of the scores of parts of the record (the sandwich of Huber and White). The parts
are the blocks, whose scatter shows a wrong spectrum or level, and the time folds, whose scatter shows a drift. The
sandwich is noisy. It counts only for a parameter whose variance it raises by more than chance.
"""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.motion.motion_record import TIME_FOLDS
from estimator.likelihood.response.regressor_set import block_tangents
from estimator.likelihood.thresholds import LIMITS

from .path_fit import information_inverse
from .working_point import WorkingPoint


def joint_covariance(point: WorkingPoint) -> Array:
    """(k + places, k + places) covariance of the increments, scaled, and of log S of a fitted working point.

    The increments are those of ``point.fit``. The larger of inverse Hessian and sandwich is taken, parameter by
    parameter.
    """
    from scipy.special import chdtri

    bread = information_inverse(_joint_hessian(point))
    influence = _block_scores(point) @ bread  # of each block on each parameter
    expected = np.diag(bread)
    wider = np.ones(expected.size)
    if (blocks := len(influence)) >= LIMITS.min_blocks:
        squares = influence**2
        excess, chance = squares.sum(axis=0) - expected, squares.std(axis=0) * np.sqrt(blocks)
        wider = np.where(excess > LIMITS.min_excess_sd * chance, squares.sum(axis=0) / expected, wider)
    folds = np.array([sixth.sum(axis=0) for sixth in np.array_split(influence, TIME_FOLDS)])  # in time
    of_folds = (folds**2).sum(axis=0) / expected * TIME_FOLDS  # chi-squared, its mean left out
    limit = chdtri(TIME_FOLDS - 1, LIMITS.max_chance_p)
    wider = np.where(of_folds > limit, np.maximum(of_folds / (TIME_FOLDS - 1), wider), wider)
    return np.asarray(bread * np.sqrt(np.multiply.outer(wider, wider)))


def _joint_hessian(point: WorkingPoint) -> Array:
    """(k + places, k + places) minus the second derivative of the log-likelihood by increments and log S."""
    gram, fit = point.gram, point.fit
    G, n, blocks = gram.G.sum(axis=1), gram.n.sum(axis=1), float(point.data.blocks)
    b, k, P = np.concatenate([[1.0], fit.delta]), fit.delta.size, len(G)
    out = np.zeros((k + P, k + P))
    _, bend = point.jacobian.derivatives(gram.tangents, fit.delta)
    out[:k, :k] = 2 * (G[:, 1:, 1:] / fit.S[:, None, None]).sum(axis=0) - blocks * bend
    out[:k, k:] = -2 * (np.einsum("iab,b->ia", G, b)[:, 1:] / fit.S[:, None]).T
    out[k:, :k] = out[:k, k:].T
    out[k:, k:] = np.diag(n)
    return out


def _block_scores(point: WorkingPoint) -> Array:
    """(blocks, k + places) slope of the log-likelihood of each block by increments and log S."""
    gram, fit, data = point.gram, point.fit, point.data
    k, P = fit.delta.size, len(data.places)
    out = np.zeros((data.blocks, k + P))
    out[:, :k] = point.jacobian.derivatives(gram.tangents, fit.delta)[0]
    for i in range(P):
        Z, at = point.whitened.spectra[i], point.whitened.index[i]
        force = point.spectra[i] + np.tensordot(fit.delta[at].astype(np.float32), Z, 1)
        out[:, at] -= 2 * np.einsum("kbf,bf->bk", Z, force, dtype=np.float64) / fit.S[i]
        power = np.einsum("bf,bf->b", force, force, dtype=np.float64)
        out[:, k + i] = power / fit.S[i] - gram.n[i].sum() / data.blocks
    _add_block_tangents(point, out)
    return out


def _add_block_tangents(point: WorkingPoint, scores: Array) -> None:
    """Add the response of the mean tangent of each block, less that of the record, to the scores (blocks, k + places).

    The score of a law is its force times the residual force, less S times the response of its mean tangent. Both grow
    with the motion. With the tangent of the record the scores follow the level, and standard deviations are too large.
    """
    data, s, names = point.data, point.whitening.s, list(point.fit.names)
    if not data.x.size or data.measured_force:
        return
    inverse = np.linalg.inv(point.jacobian.A0) * point.jacobian.weight[:, None, None]
    if point.whitening.measured is not None:
        inverse = point.whitening.measured @ inverse
    laws = ((use, k) for use in point.placed if use.effect.kind == "force" for k in range(use.p.size))
    for use, k in ((use, k) for use, k in laws if use.name(k) in names):
        column = names.index(use.name(k))
        for i in use.at:
            response = np.array([(inverse[:, i, i] / s**n).real.sum() for n in (2, 1)])
            tangents = block_tangents(use, k, data, i)
            scores[:, column] += (tangents - tangents.mean(axis=0)) @ response * point.fit.scales[column]
