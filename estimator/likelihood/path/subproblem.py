"""The path likelihood of a few places with trial regressors, for scores, refits and held-out gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.motion_record import TIME_FOLDS
from estimator.likelihood.thresholds import LIMITS
from estimator.likelihood.whitening.determinant import Jacobian
from estimator.likelihood.whitening.whitening import Spectrum, WhitenedRegressors

from .path_fit import Gram, PathFit, fit_increments, log_likelihood
from .working_point import WorkingPoint

FoldProducts = tuple[NDArray[np.int64], Array, Array]  # rows of G, products with them, products of new ones


@dataclass(frozen=True, slots=True, kw_only=True)
class Subproblem:
    """The path likelihood of some places.

    places : their numbers. gram : of the base and the trial regressors there. jacobian : of the places, the others
    eliminated. blocks : (folds,) number of blocks. base : names of the regressors of the model. extra : names of those
    on trial. prior_information : (base,) scaled, keeps searched parameters of the model near.
    """

    places: tuple[int, ...]
    gram: Gram
    jacobian: Jacobian
    blocks: Array
    base: tuple[str, ...]
    extra: tuple[str, ...]
    prior_information: Array

    def without_extra(self) -> Subproblem:
        """The problem without trial regressors."""
        return replace(self, gram=self.gram.keep(self.base), extra=())

    def only(self, extra: tuple[str, ...]) -> Subproblem:
        """The problem with these trial regressors only."""
        return replace(self, gram=self.gram.keep(self.base + extra), extra=extra)

    def combined(self, weights: Array) -> Subproblem:
        """The problem with sums of the trial regressors in their place. weights : (sums, extra)."""
        names = tuple(f"sum.{k}" for k in range(len(weights)))
        return replace(self, gram=self.gram.combined(names, weights), extra=names)

    def fit(self, folds: NDArray[np.int64] | None = None, ridge: float = 0.0, steps: int = 30) -> PathFit:
        """The maximum of the likelihood on some folds; None: all.

        ridge : prior information of the trial regressors, scaled.
        """
        penalty = np.concatenate([self.prior_information, np.full(len(self.extra), ridge)])
        folds = np.arange(TIME_FOLDS) if folds is None else folds
        return fit_increments(
            self.gram, self.jacobian, folds, self.blocks, ridge=penalty, steps=steps,
            min_information=LIMITS.min_information_share,
        )  # fmt: skip

    def likelihood(self, found: PathFit, folds: NDArray[np.int64]) -> float:
        """Log-likelihood of a fit on some folds, nats."""
        return log_likelihood(self.gram, self.jacobian, found.delta, found.S, folds, self.blocks)


def coupled_places(point: WorkingPoint, places: tuple[int, ...]) -> tuple[int, ...]:
    """The places and all that share a parameter of the model with them."""
    found = set(places)
    while True:
        grown = found.union(*(set(u.at) for u in point.placed if found & set(u.at)))
        if grown == found:
            return tuple(sorted(found))
        found = grown


def base_regressors(point: WorkingPoint, at: NDArray[np.int64]) -> list[int]:
    """Numbers of the regressors of the model that act at some places."""
    own = point.whitened
    return [k for k in range(len(own.names)) if any(k in own.index[int(i)] for i in at if int(i) in own.index)]


def subproblem(point: WorkingPoint, places: tuple[int, ...], extra: WhitenedRegressors | None = None) -> Subproblem:
    """The likelihood of some places of a working point, with trial regressors; None: without.

    Other places keep responding through the shaft, in the residual force and in the Jacobian.
    """
    at = np.array(coupled_places(point, places))
    whitened, base = point.whitened, base_regressors(point, at)
    rows = np.array([0] + [1 + k for k in base])
    names = tuple(whitened.names[k] for k in base)
    gram = Gram(
        G=np.ascontiguousarray(point.gram.G[at][:, :, rows[:, None], rows]), n=point.gram.n[at],
        log_weight=point.gram.log_weight[at], tangents=point.jacobian.tangents(whitened.tangents[base], at),
        scales=whitened.scales[base], names=names,
    )  # fmt: skip
    plain = Subproblem(
        places=tuple(at.tolist()), gram=gram, jacobian=point.jacobian.of_places(at), blocks=point.data.fold_blocks,
        base=names, extra=(), prior_information=point.prior_information[base],
    )  # fmt: skip
    if extra is None:
        return plain
    made = {}
    for i in plain.places:
        if (X := extra.spectra.get(i)) is not None:
            folds = [fold_products(point, i, base, f, X[:, point.data.fold == f]) for f in range(TIME_FOLDS)]
            made[i] = extra.index[i], folds
    return with_extra(point, plain, made, extra.names, extra.scales, extra.tangents)


def with_extra(
    point: WorkingPoint, plain: Subproblem, made: Mapping[int, tuple[NDArray[np.int64], Sequence[FoldProducts]]],
    names: tuple[str, ...], scales: Array, tangents: Complexes,
) -> Subproblem:  # fmt: skip
    """A problem without trial regressors, extended by some.

    made : by place, which of them act there, and their products, fold by fold. tangents : (extra, all places, all
    places, bins), scaled.
    """
    old, first = plain.gram, 1 + len(plain.base)
    size, at = first + len(names), np.array(plain.places)
    G = np.zeros((*old.G.shape[:2], size, size))
    G[:, :, :first, :first] = old.G
    for i, (own, folds) in made.items():
        for f, (rows, C, square) in enumerate(folds):
            part, new = G[plain.places.index(i), f], first + own
            part[rows[:, None], new] = C
            part[new[:, None], rows] = C.T
            part[new[:, None], new] = square
    joined = Gram(
        G=G, n=old.n, log_weight=old.log_weight,
        tangents=np.concatenate([old.tangents, point.jacobian.tangents(tangents, at)]),
        scales=np.concatenate([old.scales, scales]), names=old.names + names,
    )  # fmt: skip
    return replace(plain, gram=joined, extra=names)


def fold_products(point: WorkingPoint, i: int, base: list[int], f: int, X: Spectrum) -> FoldProducts:
    """Rows of G of the residual force and the base regressors at place i, and the products with spectra of fold f.

    X : (q, blocks, 2 bins). The products are (rows, q) with X and (q, q) of X with itself.
    """
    whitened, here = point.whitened, point.data.fold == f
    Z = X.reshape(len(X), -1)
    cross = np.concatenate([point.spectra[i][None, here], whitened.spectra[i][:, here]]).reshape(-1, Z.shape[1])
    rows = np.array([0] + [1 + base.index(int(k)) for k in whitened.index[i]])
    return rows, (cross @ Z.T).astype(np.float64), (Z @ Z.T).astype(np.float64)


def heldout_gain(problem: Subproblem, ridge: float = 0.0) -> Array:
    """(folds,) nats gained on each time fold by parameters fitted to the others."""
    plain = problem.without_extra()
    out = np.zeros(TIME_FOLDS)
    for f in range(TIME_FOLDS):
        rest = np.array([k for k in range(TIME_FOLDS) if k != f])
        here = np.array([f])
        there = plain.likelihood(plain.fit(rest), here)
        gain = problem.likelihood(problem.fit(rest, ridge), here) - there if np.isfinite(there) else 0.0
        out[f] = max(gain, -LIMITS.impossible_nats)
    return out
