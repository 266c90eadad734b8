"""The spectral path likelihood at a working point, as small Gram matrices.

At a working point the residual force is known as a series for each place. The increments delta of the parameters add
delta_k times regressor k to it. With spectra weighted by W = S / (S + N), where N is the sensor noise referred to
force, the log-likelihood of the increments is, in nats,

    L(delta) = sum_i [sum_f log W_i - n_i log(pi S_i) - Q_i(delta) / S_i] + 2 sum_f log |det A(delta)|

    Q_i(delta) = (1, delta) G_i (1, delta)^T        S_i = Q_i / n_i at the maximum

i counts places, f the bins of the band over all blocks. G_i is the Gram matrix of the whitened residual force and
regressors of place i, n_i its number of complex bins. A (places, places) is the linear response from acceleration to
residual force with the mean tangents of all laws: force = A * acceleration, in kg. The last term is the Jacobian from
force to motion. A regressor may act at several places with one parameter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from estimator.arrays import Array, Complexes
from estimator.errors import DivergedError
from estimator.likelihood.motion.motion_record import TIME_FOLDS
from estimator.likelihood.whitening.determinant import Jacobian
from estimator.likelihood.whitening.whitening import Spectrum, WhitenedRegressors, Whitening
from estimator.parallel import map_threads


@dataclass(frozen=True, slots=True, kw_only=True)
class Gram:
    """Products of the whitened residual force and k regressors: all that the likelihood needs of the data.

    G : (places, folds, 1 + k, 1 + k) N^2/Hz summed over bins; row 0 is the residual force. n : (places, folds) number
    of complex bins. log_weight : (places, folds) sum of log W. tangents : (k, places, places, bins) kg, contribution of
    each regressor to A per scaled unit. scales : (k,) parameter in SI units per scaled unit. names : (k,) of the
    parameters.
    """

    G: Array
    n: Array
    log_weight: Array
    tangents: Complexes
    scales: Array
    names: tuple[str, ...]

    def keep(self, names: list[str] | tuple[str, ...]) -> Gram:
        """The Gram matrices of the named regressors only, in this order."""
        at = [self.names.index(k) for k in names]
        rows = np.array([0] + [1 + k for k in at])
        return replace(
            self, G=self.G[:, :, rows[:, None], rows], tangents=self.tangents[at], scales=self.scales[at],
            names=tuple(names),
        )  # fmt: skip

    def combined(self, names: tuple[str, ...], weights: Array) -> Gram:
        """The Gram matrices with the last q regressors replaced by sums of them. weights : (names, q), scaled units."""
        first = len(self.names) - weights.shape[1]
        M = block_diag(np.eye(1 + first), weights)
        G = np.einsum("ab,ifbc,dc->ifad", M, self.G, M, optimize=True)
        tangents = np.concatenate([self.tangents[:first], np.tensordot(weights, self.tangents[first:], 1)])
        scales = np.concatenate([self.scales[:first], np.ones(len(names))])
        names = self.names[:first] + names
        return replace(self, G=G, tangents=tangents, scales=scales, names=names)


def gram_matrices(whitening: Whitening, force: dict[int, Spectrum], *whitened: WhitenedRegressors) -> Gram:
    """Gram matrices of the whitened residual force (by place) and of all regressors."""
    data = whitening.data
    P = len(data.places)
    total = sum(len(c.names) for c in whitened)
    G = np.zeros((P, TIME_FOLDS, 1 + total, 1 + total))
    n = np.zeros((P, TIME_FOLDS))
    kept = np.ones_like(whitening.weight) if whitening.leakage is None else whitening.leakage.kept
    log_weight = np.zeros((P, TIME_FOLDS))

    def at_place(i: int) -> None:
        rows = [0]
        stacks = [force[i][None]]
        offset = 1
        for c in whitened:
            if i in c.spectra:
                stacks.append(c.spectra[i])
                rows += list(offset + c.index[i])
            offset += len(c.names)
        at = np.array(rows)
        for f in range(TIME_FOLDS):
            here = np.flatnonzero(data.fold == f)
            Z = np.concatenate([s[:, here].reshape(len(s), -1) for s in stacks])
            G[i, f][at[:, None], at] = Z @ Z.T
            n[i, f] = here.size * kept[i].sum()
            log_weight[i, f] = here.size * (kept[i] @ np.log(whitening.weight[i]))
            if data.level is not None:
                log_weight[i, f] -= (np.log(whitening.relative_psd(i, data.level[i, here])) @ kept[i]).sum()

    map_threads(at_place, range(P))
    return Gram(
        G=G, n=n, log_weight=log_weight, tangents=np.concatenate([c.tangents for c in whitened]),
        scales=np.concatenate([c.scales for c in whitened]), names=tuple(k for c in whitened for k in c.names),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class PathFit:
    """The maximum of the path likelihood over the increments of k parameters.

    names : (k,) of the parameters. delta : (k,) increments, scaled units. covariance : (k, k) of delta. S : (places,)
    N^2/Hz. log_likelihood : nats. scales : (k,) parameter in SI units per scaled unit.
    """

    names: tuple[str, ...]
    delta: Array
    covariance: Array
    S: Array
    log_likelihood: float
    scales: Array

    def increments(self, names: list[str]) -> tuple[Array, Array]:
        """(n,) increments of parameters, and their covariance (n, n), SI units."""
        at = [self.names.index(name) for name in names]
        units = self.scales[at]
        return self.delta[at] * units, self.covariance[np.ix_(at, at)] * np.multiply.outer(units, units)

    def value(self, name: str) -> tuple[float, float]:
        """Increment and standard deviation of a parameter, SI units."""
        value, covariance = self.increments([name])
        return float(value[0]), float(np.sqrt(covariance[0, 0]))


def log_likelihood(
    gram: Gram, jacobian: Jacobian, delta: Array, S: Array, folds: NDArray[np.int64], blocks: Array
) -> float:
    """Nats on some folds at delta (k,), scaled, and S (places,) N^2/Hz. blocks : (folds,) number of each fold."""
    b = np.concatenate([[1.0], delta])
    G, n = gram.G[:, folds].sum(axis=1), gram.n[:, folds].sum(axis=1)
    Q = np.einsum("a,iab,b->i", b, G, b)
    out = -(Q / S + n * np.log(np.pi * S)).sum() + gram.log_weight[:, folds].sum()
    return float(out + blocks[folds].sum() * jacobian.value(gram.tangents, delta))


def fit_increments(
    gram: Gram,
    jacobian: Jacobian,
    folds: NDArray[np.int64],
    blocks: Array,
    start: Array | None = None,
    ridge: Array | None = None,
    steps: int = 30,
    min_information: float = 0.0,
) -> PathFit:
    """The maximum of L over the increments, by Newton steps that are halved until L rises.

    folds : those that are fitted. blocks : (folds,) number of blocks of each fold. start : (k,) scaled; None: 0.
    ridge : (k,) prior information, added to that of the data; None: 0. steps : at most. min_information : a sum of
    regressors with a smaller share of their information is not moved.
    """
    G, n = gram.G[:, folds].sum(axis=1), gram.n[:, folds].sum(axis=1)
    B = blocks[folds].sum()
    tangents = gram.tangents
    k = len(gram.names)
    delta = np.zeros(k) if start is None else start.copy()
    penalty = np.zeros(k) if ridge is None else ridge

    def objective(d: Array) -> float:
        b = np.concatenate([[1.0], d])
        Q = np.einsum("a,iab,b->i", b, G, b)
        if np.any(Q <= 0):
            return -np.inf
        return float(-(n * np.log(Q / n)).sum() + B * jacobian.value(tangents, d) - 0.5 * penalty @ d**2)

    best = objective(delta)
    H = np.eye(k)
    for _ in range(steps):
        gradient, at_fixed_S, H = slope_and_curvature(gram, jacobian, folds, blocks, delta)
        gradient, at_fixed_S, H = gradient - penalty * delta, at_fixed_S + np.diag(penalty), H + np.diag(penalty)
        step = _solve(H, gradient, min_information)
        if not _is_positive(H):
            step = max(step, _solve(at_fixed_S, gradient, min_information), key=lambda z: objective(delta + z))
        size, new = 1.0, -np.inf
        while size > 1e-3:
            new = objective(delta + size * step)
            if new > best - 1e-9:
                break
            size /= 2
        if not new > best - 1e-9:
            break
        delta = delta + size * step
        gained, best = new - best, new
        if gained < 1e-4:
            break
    b = np.concatenate([[1.0], delta])
    S = np.einsum("a,iab,b->i", b, G, b) / n
    value = best + 0.5 * float(penalty @ delta**2) - float((n * (1.0 + np.log(np.pi))).sum())
    value += float(gram.log_weight[:, folds].sum())
    return PathFit(
        names=gram.names, delta=delta, covariance=information_inverse(H), S=S, log_likelihood=value, scales=gram.scales
    )


def slope_and_curvature(
    gram: Gram, jacobian: Jacobian, folds: NDArray[np.int64], blocks: Array, delta: Array
) -> tuple[Array, Array, Array]:
    """Slope (k,) of L by the increments, and minus its second derivatives (k, k), at fixed S and with S that follows.

    Arguments as of `fit_increments`. S is that of the maximum at these increments.
    """
    G, n, B = gram.G[:, folds].sum(axis=1), gram.n[:, folds].sum(axis=1), blocks[folds].sum()
    b = np.concatenate([[1.0], delta])
    GB = np.einsum("iab,b->ia", G, b)
    S = (GB @ b) / n
    j1, j2 = jacobian.derivatives(gram.tangents, delta)
    slope = 2 * GB[:, 1:] / S[:, None]
    at_fixed_S = 2 * (G[:, 1:, 1:] / S[:, None, None]).sum(axis=0) - B * j2
    return B * j1 - slope.sum(axis=0), at_fixed_S, at_fixed_S - slope.T @ (slope / n[:, None])


def _is_positive(H: Array) -> bool:
    """Whether a curvature is positive along every direction: far from a maximum it need not be."""
    d = np.diag(H)
    return bool(np.all(d > 0.0)) and bool(np.linalg.eigvalsh(H / np.sqrt(np.multiply.outer(d, d)))[0] > 0.0)


def _solve(H: Array, g: Array, min_information: float = 0.0) -> Array:
    """H^-1 g, eigenvalues relative to the diagonal at least 1e-6; 0 along eigenvectors below `min_information`.

    Raises DivergedError where H is not finite.
    """
    d = 1 / np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-300))
    try:
        e, U = np.linalg.eigh(H * np.multiply.outer(d, d))
    except np.linalg.LinAlgError:
        raise DivergedError from None
    e = np.where(np.abs(e) < min_information, np.inf, np.maximum(np.abs(e), 1e-6))
    return np.asarray(d * (U @ ((U.T @ (d * g)) / e)))


def information_inverse(H: Array) -> Array:
    """H^-1 with eigenvalues, relative to the diagonal, of at least 1e-6."""
    d = 1 / np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-300))
    e, U = np.linalg.eigh(H * np.multiply.outer(d, d))
    e = np.maximum(e, 1e-6)
    return np.asarray(np.multiply.outer(d, d) * ((U / e) @ U.T))
