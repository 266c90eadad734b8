"""Likelihood of a few places with extra terms: the small problem behind every score, refit and held-out gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.motion_record import FOLDS

from .determinant import Jacobian
from .path_fit import MIN_INFORMATION_SHARE, Gram, PathFit, fit, log_likelihood
from .whitening import Columns, Spectrum
from .working_point import WorkingPoint


@dataclass(frozen=True, slots=True)
class Subproblem:
    """Gram and Jacobian of some places; `base` names the model's own terms, `extra` those on trial.

    caution : (base,) what keeps searched parameters of the model near, as in its own fit.
    """

    places: tuple[int, ...]
    gram: Gram
    jacobian: Jacobian
    blocks: Array
    base: tuple[str, ...]
    extra: tuple[str, ...]
    caution: Array

    def without_extra(self) -> Subproblem:
        return replace(self, gram=self.gram.keep(self.base), extra=())

    def only(self, extra: tuple[str, ...]) -> Subproblem:
        return replace(self, gram=self.gram.keep(self.base + extra), extra=extra)

    def combined(self, weights: Array) -> Subproblem:
        """With weights (k, extra) sums of the extra terms in their place."""
        names = tuple(f"sum.{k}" for k in range(len(weights)))
        return replace(self, gram=self.gram.combined(names, weights), extra=names)

    def fit(
        self, folds: NDArray[np.int64] | None = None, ridge: float = 0.0, steps: int = 30, start: Array | None = None
    ) -> PathFit:
        """Maximum likelihood; `ridge` is a prior information on the scaled extra terms. start : (terms,) scaled."""
        penalty = np.concatenate([self.caution, np.full(len(self.extra), ridge)])
        folds = np.arange(FOLDS) if folds is None else folds
        return fit(self.gram, self.jacobian, folds, self.blocks, start, penalty, steps, MIN_INFORMATION_SHARE)

    def likelihood(self, found: PathFit, folds: NDArray[np.int64]) -> float:
        return log_likelihood(self.gram, self.jacobian, found.delta, found.S, folds, self.blocks)


def component(point: WorkingPoint, places: tuple[int, ...]) -> tuple[int, ...]:
    """The places together with those that share a parameter of the model with them."""
    found = set(places)
    while True:
        grown = found.union(*(set(u.at) for u in point.placed if found & set(u.at)))
        if grown == found:
            return tuple(sorted(found))
        found = grown


def base_of(point: WorkingPoint, at: NDArray[np.int64]) -> list[int]:
    """Numbers of the model's terms that act at some places."""
    own = point.columns
    return [k for k in range(len(own.names)) if any(k in own.index[int(i)] for i in at if int(i) in own.index)]


def subproblem(point: WorkingPoint, places: tuple[int, ...], extra: Columns | None = None) -> Subproblem:
    """Cut the places out of the working point and add columns. Other places go on answering through the shaft, in the
    force (it is known) and in the Jacobian."""
    at = np.array(component(point, places))
    own = point.columns
    base = base_of(point, at)
    q = 0 if extra is None else len(extra.names)
    size = 1 + len(base) + q
    G = np.zeros((at.size, FOLDS, size, size))
    rows = np.array([0] + [1 + k for k in base])
    G[:, :, : rows.size, : rows.size] = point.gram.G[at][:, :, rows[:, None], rows]
    tangents, scales, apart = own.tangents[base], own.scales[base], own.apart[base]
    names, units = tuple(own.names[k] for k in base), tuple(own.units[k] for k in base)
    if extra is not None:
        for number, i in enumerate(at):
            _extend(point, int(i), extra, base, G[number])
        tangents = np.concatenate([tangents, extra.tangents])
        scales = np.concatenate([scales, extra.scales])
        apart = np.concatenate([apart, extra.apart])
    tangents = point.jacobian.tangents(tangents, at)
    new = () if extra is None else extra.names
    merged = Gram(
        G, point.gram.n[at], point.gram.log_weight[at], tangents, scales, names + new,
        units + (() if extra is None else extra.units), _among(apart, at), point.whitening.s,
    )  # fmt: skip
    inside = tuple(int(i) for i in at)
    return Subproblem(inside, merged, point.jacobian.at(at), point.data.fold_blocks, names, new, point.caution[base])


def extended(
    point: WorkingPoint, plain: Subproblem, i: int, made: Sequence[tuple[NDArray[np.int64], Array, Array]],
    names: tuple[str, ...], scales: Array, tangents: Complexes, apart: Array,
) -> Subproblem:  # fmt: skip
    """A problem without extra terms with those of place i whose `products` are given, fold by fold.

    tangents : (terms, all places, all places, bins), apart : (terms, folds, all places, all places, 2), scaled.
    """
    old, first = plain.gram, 1 + len(plain.base)
    size, at = first + len(names), np.array(plain.places)
    G = np.zeros((*old.G.shape[:2], size, size))
    G[:, :, :first, :first] = old.G
    for f, one in enumerate(made):
        fill(G[plain.places.index(i), f], np.arange(first, size), *one)
    joined = Gram(
        G, old.n, old.log_weight, np.concatenate([old.tangents, point.jacobian.tangents(tangents, at)]),
        np.concatenate([old.scales, scales]), old.names + names, old.units + ("N",) * len(names),
        np.concatenate([old.apart, _among(apart, at)]), old.s,
    )  # fmt: skip
    return replace(plain, gram=joined, extra=names)


def _among(apart: Array, at: NDArray[np.int64]) -> Array:
    """Mean tangents of time folds, (terms, folds, places, places, 2), of some places."""
    return np.asarray(apart[:, :, at[:, None], at])


def _extend(point: WorkingPoint, i: int, extra: Columns, base: list[int], G: Array) -> None:
    """Fill the rows of the extra columns of one place into G (folds, 1 + terms, 1 + terms)."""
    if i not in extra.spectra:
        return
    X = extra.spectra[i]
    at_extra = 1 + len(base) + extra.index[i]
    for f in range(FOLDS):
        fill(G[f], at_extra, *products(point, i, base, f, X[:, fold_span(point, f)]))


def fold_span(point: WorkingPoint, f: int) -> slice:
    """The blocks of a fold."""
    here = np.flatnonzero(point.data.fold == f)
    return slice(int(here[0]), int(here[-1]) + 1)


def products(
    point: WorkingPoint, i: int, base: list[int], f: int, X: Spectrum
) -> tuple[NDArray[np.int64], Array, Array]:  # fmt: skip
    """Rows of G that the force and the base terms have at place i, their products with X (q, blocks, 2 bins) of fold f,
    (rows, q), and those of X with itself."""
    own, span = point.columns, fold_span(point, f)
    Z = X.reshape(len(X), -1)
    cross = np.concatenate([point.spectra[i][None, span], own.spectra[i][:, span]]).reshape(-1, Z.shape[1])
    rows = np.array([0] + [1 + base.index(int(k)) for k in own.index[i]])
    return rows, (cross @ Z.T).astype(np.float64), (Z @ Z.T).astype(np.float64)


def fill(G: Array, at: NDArray[np.int64], rows: NDArray[np.int64], C: Array, square: Array) -> None:
    """Put products into G, where the new terms are at `at`."""
    G[rows[:, None], at] = C
    G[at[:, None], rows] = C.T
    G[at[:, None], at] = square


def gain(problem: Subproblem, ridge: float = 0.0, steps: int = 30) -> tuple[float, PathFit]:
    """Log-likelihood gained by the extra terms over the refitted base, nats, on the whole record."""
    everything = np.arange(FOLDS)
    full = problem.fit(ridge=ridge, steps=steps)
    plain = problem.without_extra()
    base = plain.fit(steps=steps)
    return problem.likelihood(full, everything) - plain.likelihood(base, everything), full


def heldout_gain(problem: Subproblem, ridge: float = 0.0) -> Array:
    """(folds,) nats gained on each time fold by parameters fitted to the others."""
    plain = problem.without_extra()
    out = np.zeros(FOLDS)
    for f in range(FOLDS):
        rest = np.array([k for k in range(FOLDS) if k != f])
        here = np.array([f])
        out[f] = problem.likelihood(problem.fit(rest, ridge), here) - plain.likelihood(plain.fit(rest), here)
    return out
