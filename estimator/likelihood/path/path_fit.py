"""The spectral path likelihood around a working point, as small matrices (physics.md section 5).

At a working point the force that the model cannot explain is known as a series per place. Every further term adds
delta * column to it. With spectra weighted by W(f) = 1 / (1 + nu |A|^2) (white force S, sensor noise nu S), the
log-likelihood of increments delta is, in nats,

    L(delta) = sum_i [ -n_i log Q_i(delta) + sum log W ] + 2 sum log |det A(delta)|,  Q_i = (1, delta) G_i (1, delta)

with G_i the Gram matrix of [force, columns] of place i: all that is needed of the data. A term may act at several
places with one parameter. A(w) is the mean tangent of the whole model over the places, over -w^2: determinant.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.motion_record import TIME_FOLDS
from estimator.likelihood.response.regressor_set import tangent_response
from estimator.parallel import map_threads

from .determinant import Jacobian
from .whitening import Spectrum, WhitenedRegressors, Whitening

# Mean tangents are known to about a part in a hundred. Where columns of a law of many parameters cancel to a part in
# ten thousand of their power, what is left of the tangents is that error, and the determinant follows it anywhere.
MIN_INFORMATION_SHARE = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class Gram:
    """G by place and fold, (places, folds, 1 + terms, 1 + terms), row 0 the force; n : (places, folds) complex bins."""

    G: Array
    n: Array
    log_weight: Array  # (places, folds) sum of log W
    tangents: Complexes
    scales: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    apart: Array | None = None  # as in Columns
    s: Complexes | None = None  # (bins,) that tangents are given at

    def tangents_in(self, folds: NDArray[np.int64], blocks: Array) -> Complexes:
        """(terms, places, places, bins) contributions to A in some folds, of (folds,) blocks each.

        A law that motion makes strong has another mean tangent where the motion is another: friction under a force that
        grows by 2.1 lost 700 nats on a fold by the tangent of the record, and gains 50 to 180 on each by its own.
        """
        if self.apart is None or self.s is None or folds.size == TIME_FOLDS:
            return self.tangents
        moved = np.average(self.apart[:, folds], axis=1, weights=blocks[folds])
        return self.tangents + tangent_response(moved, self.s)

    def keep(self, names: list[str] | tuple[str, ...]) -> Gram:
        """The same without the other terms."""
        at = [self.names.index(k) for k in names]
        rows = np.array([0] + [1 + k for k in at])
        apart = None if self.apart is None else self.apart[at]
        return Gram(
            G=self.G[:, :, rows[:, None], rows],
            n=self.n,
            log_weight=self.log_weight,
            tangents=self.tangents[at],
            scales=self.scales[at],
            names=tuple(names),
            units=tuple(self.units[k] for k in at),
            apart=apart,
            s=self.s,
        )

    def combined(self, names: tuple[str, ...], weights: Array) -> Gram:
        """The same with the last q terms replaced by `names`, weights (len(names), q) sums of them, scaled units."""
        first = len(self.names) - weights.shape[1]
        M = block_diag(np.eye(1 + first), weights)
        G = np.einsum("ab,ifbc,dc->ifad", M, self.G, M, optimize=True)
        tangents = np.concatenate([self.tangents[:first], np.tensordot(weights, self.tangents[first:], 1)])
        scales = np.concatenate([self.scales[:first], np.ones(len(names))])
        units = self.units[:first] + ("1",) * len(names)
        apart = None if self.apart is None else np.tensordot(block_diag(np.eye(first), weights), self.apart, 1)
        return Gram(
            G=G,
            n=self.n,
            log_weight=self.log_weight,
            tangents=tangents,
            scales=scales,
            names=self.names[:first] + names,
            units=units,
            apart=apart,
            s=self.s,
        )


def gram_matrices(whitening: Whitening, force: dict[int, Spectrum], *columns: WhitenedRegressors) -> Gram:
    """Gram matrices of the force and all columns, by place and time fold."""
    data = whitening.data
    P = len(data.places)
    total = sum(len(c.names) for c in columns)
    G = np.zeros((P, TIME_FOLDS, 1 + total, 1 + total))
    n = np.zeros((P, TIME_FOLDS))
    kept = np.ones_like(whitening.weight) if whitening.ringing is None else whitening.ringing.kept
    log_weight = np.zeros((P, TIME_FOLDS))

    def at_place(i: int) -> None:
        rows = [0]
        stacks = [force[i][None]]
        offset = 1
        for c in columns:
            if i in c.spectra:
                stacks.append(c.spectra[i])
                rows += list(offset + c.index[i])
            offset += len(c.names)
        at = np.array(rows)
        for f in range(TIME_FOLDS):
            here = np.flatnonzero(data.fold == f)
            span = slice(int(here[0]), int(here[-1]) + 1)
            Z = np.concatenate([s[:, span].reshape(len(s), -1) for s in stacks])
            G[i, f][at[:, None], at] = Z @ Z.T
            n[i, f] = here.size * kept[i].sum()
            log_weight[i, f] = here.size * (kept[i] @ np.log(whitening.weight[i]))
            if data.level is not None:
                log_weight[i, f] -= (np.log(whitening.relative_psd(i, data.level[i, here])) @ kept[i]).sum()

    map_threads(at_place, range(P))
    return Gram(
        G=G,
        n=n,
        log_weight=log_weight,
        tangents=np.concatenate([c.tangents for c in columns]),
        scales=np.concatenate([c.scales for c in columns]),
        names=tuple(k for c in columns for k in c.names),
        units=tuple(u for c in columns for u in c.units),
        apart=np.concatenate([c.apart for c in columns]),
        s=whitening.s,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PathFit:
    """Increments delta (terms,) in scaled units, their covariance, S by place, and the log-likelihood, nats."""

    names: tuple[str, ...]
    delta: Array
    covariance: Array
    S: Array
    log_likelihood: float
    scales: Array

    def value(self, name: str) -> tuple[float, float]:
        """Increment and standard deviation of a parameter, SI."""
        k = self.names.index(name)
        return float(self.delta[k] * self.scales[k]), float(np.sqrt(self.covariance[k, k]) * self.scales[k])


def log_likelihood(
    gram: Gram, jacobian: Jacobian, delta: Array, S: Array, folds: NDArray[np.int64], blocks: Array
) -> float:
    """Nats on some folds, at given delta and S (places,); blocks : (folds,) number of blocks of each fold."""
    b = np.concatenate([[1.0], delta])
    G, n = gram.G[:, folds].sum(axis=1), gram.n[:, folds].sum(axis=1)
    Q = np.einsum("a,iab,b->i", b, G, b)
    out = -(Q / S + n * np.log(np.pi * S)).sum() + gram.log_weight[:, folds].sum()
    return float(out + blocks[folds].sum() * jacobian.value(gram.tangents_in(folds, blocks), delta))


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
    """Maximise L over all terms by Newton's method with halving; ridge : (terms,) added to the information.

    min_information : nothing moves along sums of terms that have less than this share of the information of the terms.
    """
    G, n = gram.G[:, folds].sum(axis=1), gram.n[:, folds].sum(axis=1)
    B = blocks[folds].sum()
    tangents = gram.tangents_in(folds, blocks)
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
        b = np.concatenate([[1.0], delta])
        GB = np.einsum("iab,b->ia", G, b)
        S = (GB @ b) / n
        j1, j2 = jacobian.derivatives(tangents, delta)
        gradient = -2 * (GB[:, 1:] / S[:, None]).sum(axis=0) + B * j1 - penalty * delta
        H = 2 * (G[:, 1:, 1:] / S[:, None, None]).sum(axis=0) - B * j2 + np.diag(penalty)
        step = _solve(H, gradient, min_information)
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
    value = log_likelihood(gram, jacobian, delta, S, folds, blocks)
    return PathFit(names=gram.names, delta=delta, covariance=_inverse(H), S=S, log_likelihood=value, scales=gram.scales)


def _solve(H: Array, g: Array, min_information: float = 0.0) -> Array:
    """H^-1 g with eigenvalues kept away from zero (relative to the diagonal); those under it count as infinite."""
    d = 1 / np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-300))
    e, U = np.linalg.eigh(H * np.multiply.outer(d, d))
    e = np.where(np.abs(e) < min_information, np.inf, np.maximum(np.abs(e), 1e-6))
    return np.asarray(d * (U @ ((U.T @ (d * g)) / e)))


def _inverse(H: Array) -> Array:
    d = 1 / np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-300))
    e, U = np.linalg.eigh(H * np.multiply.outer(d, d))
    e = np.maximum(e, 1e-6)
    return np.asarray(np.multiply.outer(d, d) * ((U / e) @ U.T))
