"""Fits of a location's residual force by groups of regressors, their significance and the power that they explain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.polynomial.hermite_e import hermevander
from scipy.linalg import block_diag
from scipy.special import chdtrc, factorial

from estimator.arrays import Array
from estimator.likelihood.path.path_fit import PathFit
from estimator.likelihood.path.subproblem import Subproblem
from estimator.likelihood.path.working_point import WorkingPoint

from .thresholds import LIMITS


def group_p_value(problem: Subproblem, fit: PathFit, names: tuple[str, ...], gained: float) -> float:
    """p-value of the log-likelihood (nats) that the named regressors gain."""
    return float(chdtrc(effective_dof(problem, fit, names), 2 * max(gained, 0.0)))


def fit_polynomial(
    problem: Subproblem, names: tuple[str, ...], knots: Array
) -> tuple[Subproblem, PathFit, tuple[str, ...]]:
    """The problem with hat functions bound to polynomials of degree 2 to 9, its fit, and the names of the polynomials.

    names : of the last extra regressors, hat functions of one state at the knots (k,). A weak smooth law that is lost
    in the noise of free hat functions is significant with few parameters.
    """
    weights = _polynomials(problem, names, knots)
    bound = problem.combined(weights)
    return bound, fit_with_ridge(bound), bound.extra[len(problem.extra) - len(names) :]


def as_hat_functions(
    problem: Subproblem, bound: Subproblem, fit: PathFit, names: tuple[str, ...], knots: Array
) -> PathFit:
    """The fit of a problem bound to polynomials, expressed in the free hat functions."""
    M = block_diag(np.eye(len(problem.base)), _polynomials(problem, names, knots))
    gram, covariance = problem.gram, M.T @ fit.covariance @ M
    return replace(fit, names=gram.names, delta=fit.delta @ M, covariance=covariance, scales=gram.scales)


def _polynomials(problem: Subproblem, names: tuple[str, ...], knots: Array) -> Array:
    """(earlier + 8, extra) weights: earlier extra regressors unchanged, then polynomials of the hat functions."""
    u = 3.7 * knots / knots[-1]  # about in rms
    curves = hermevander(u, LIMITS.polynomial_degree)[:, 2:].T
    sizes = np.sqrt(factorial(np.arange(2, LIMITS.polynomial_degree + 1)))
    own = curves / np.multiply.outer(sizes, problem.gram.scales[-len(names) :])
    return np.asarray(block_diag(np.eye(len(problem.extra) - len(names)), own))


def fit_with_ridge(problem: Subproblem) -> PathFit:
    """Fit with a weak prior on the extra regressors."""
    return problem.fit(ridge=ridge_information(problem), steps=6)


def ridge_information(problem: Subproblem) -> float:
    """Information of the weak prior: `ridge_share` of the mean information of an extra regressor."""
    G = problem.gram.G.sum(axis=1)
    n = problem.gram.n.sum(axis=1)
    S = G[:, 0, 0] / n
    own = 2 * np.einsum("ikk->ik", G / S[:, None, None]).sum(axis=0)[1 + len(problem.base) :]
    return LIMITS.ridge_share * float(np.mean(own)) if own.size else 0.0


def effective_dof(problem: Subproblem, fit: PathFit, names: tuple[str, ...]) -> float:
    """Degrees of freedom of the named regressors that the others do not span."""
    Q, _ = freed_gram(problem, fit)
    index = problem.extra
    whole = np.einsum("ifkk->k", problem.gram.G)[1 + len(problem.base) :]
    at = [index.index(n) for n in names if n in index]
    others = [k for k in range(len(index)) if k not in at]
    A = Q[np.ix_(at, at)]
    if others:
        B = Q[np.ix_(at, others)]
        A = A - B @ np.linalg.pinv(Q[np.ix_(others, others)], rcond=1e-6) @ B.T
    d = np.sqrt(np.maximum(whole[at], 1e-300))
    e = np.linalg.eigvalsh(A / np.multiply.outer(d, d))
    return float(max(1.0, np.sum(np.maximum(e, 0) / (np.maximum(e, 0) + LIMITS.ridge_share))))


def freed_gram(problem: Subproblem, fit: PathFit) -> tuple[Array, Array]:
    """Gram matrix (extra, extra) of the extra regressors, N^2/Hz, projected on the complement of the base;
    the covariance (extra, extra) of their coefficients."""
    G = problem.gram.G.sum(axis=(0, 1))
    b = len(problem.base)
    Gb, Ge, Gc = G[1 : 1 + b, 1 : 1 + b], G[1 + b :, 1 + b :], G[1 + b :, 1 : 1 + b]
    Q = Ge - Gc @ np.linalg.pinv(Gb, rcond=1e-9) @ Gc.T
    return Q, fit.covariance[b:, b:]


def extra_power(point: WorkingPoint, problem: Subproblem, fit: PathFit) -> tuple[float, float]:
    """Unbiased mean square of the force of the extra regressors of a problem, N^2, and its standard deviation.

    The model's own parameters take over the rest of that force.
    """
    Q, cov = freed_gram(problem, fit)
    if not len(Q):
        return 0.0, 0.0
    per_second = point.data.rate_hz / point.data.block / float(problem.blocks.sum())
    theta = fit.delta[len(problem.base) :]
    QC = Q @ cov
    P = float(theta @ Q @ theta - np.trace(QC)) * per_second
    variance = 2 * np.trace(QC @ QC) + 4 * theta @ QC @ Q @ theta
    return P, float(np.sqrt(max(variance, 0.0))) * per_second


def hidden_power(point: WorkingPoint, problem: Subproblem, fit: PathFit) -> float:
    """Upper 95 % limit of the power (N^2) of a group that was not found, by the normal approximation."""
    P, sd = extra_power(point, problem, fit)
    return max(P, 0.0) + 1.645 * sd
