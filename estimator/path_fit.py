"""The spectral path likelihood around a working point, as small matrices (physics.md section 5).

At a working point the force that the model cannot explain is known as a series per place. Every further term adds
delta * column to it. With spectra weighted by W(f) = 1 / (1 + nu |A|^2) (white force S, sensor noise nu S), the
log-likelihood of increments delta is, in nats,

    L(delta) = sum_i [ -n_i log Q_i(delta) + sum log W ] + 2 sum log |det A(delta)|,  Q_i = (1, delta) G_i (1, delta)

with G_i the Gram matrix of [force, columns] of place i: all that is needed of the data. A term may act at several
places with one parameter. A(w) is the mean tangent of the whole model over the places, over -w^2; its determinant is
taken along a line that leaves all modes to the left: contour.py.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from .contour import turns
from .motion_blocks import FOLDS, MotionBlocks
from .noise_paths import NoisePaths
from .ringing import Ringing, ringing
from .side_by_side import each

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Spectrum = NDArray[np.float32]
TOGETHER = 32  # blocks at a time: more do not stay in the cache
CROSSED = 1.5 * np.pi  # a mode that crosses its line takes two pi off the turn of det A, one that leaves the band one
# Mean tangents are known to about a part in a hundred. Where columns of a law of many parameters cancel to a part in
# ten thousand of their power, what is left of the tangents is that error, and the determinant follows it anywhere.
TOLD = 1e-5


@dataclass(frozen=True, slots=True)
class Term:
    """One parameter's force per unit: series by place index, (n,) N per unit, and its mean tangent.

    tangent : (places, places, 2): mean derivative of the force at place i to x_l and to v_l. apart : (folds, places,
    places, 2) of those of each time fold less these; None for a term that is the same throughout.
    memory : by place, (places, bins) N/m per unit, more of the mean response of the force there to every x_l: of a
    force with memory or through the disc, or of a tangent that fluctuates (fluctuation.py).
    name : "bearing1.x.kL" and so on. scale : what the parameter is divided by in the computation.
    """

    name: str
    unit: str
    series: dict[int, NDArray[Any]]
    tangent: Array
    scale: float = 1.0
    memory: dict[int, Complexes] = field(default_factory=dict)
    apart: Array | None = None


def response(tangent: Array, s: Complexes) -> Complexes:
    """(..., bins) contribution to A at s (bins,) of a mean tangent (..., 2)."""
    return np.asarray(tangent[..., :1] / s**2 + tangent[..., 1:] / s)


def term_response(term: Term, s: Complexes) -> Complexes:
    """(places, places, bins) contribution to A at s (bins,) of one scaled unit of a term."""
    out = response(term.tangent, s)
    for i, more in term.memory.items():
        out[i] += more / s**2
    return out * term.scale


@dataclass(frozen=True, slots=True)
class Columns:
    """Terms turned into weighted spectra, by place: (terms there, blocks, 2 bins) float32."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    scales: Array
    tangents: Complexes  # (terms, places, places, bins), contribution to A per scaled unit
    spectra: dict[int, Spectrum]
    index: dict[int, NDArray[np.int64]]  # place -> number of the term of each row of spectra
    apart: Array  # (terms, folds, places, places, 2) mean tangents of time folds less those of all, per scaled unit


@dataclass(frozen=True, slots=True)
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
        if self.apart is None or self.s is None or folds.size == FOLDS:
            return self.tangents
        moved = np.average(self.apart[:, folds], axis=1, weights=blocks[folds])
        return self.tangents + response(moved, self.s)

    def keep(self, names: list[str] | tuple[str, ...]) -> Gram:
        """The same without the other terms."""
        at = [self.names.index(k) for k in names]
        rows = np.array([0] + [1 + k for k in at])
        apart = None if self.apart is None else self.apart[at]
        return Gram(self.G[:, :, rows[:, None], rows], self.n, self.log_weight, self.tangents[at], self.scales[at],
                    tuple(names), tuple(self.units[k] for k in at), apart, self.s)  # fmt: skip

    def combined(self, names: tuple[str, ...], weights: Array) -> Gram:
        """The same with the last q terms replaced by `names`, weights (len(names), q) sums of them, scaled units."""
        first = len(self.names) - weights.shape[1]
        M = block_diag(np.eye(1 + first), weights)
        G = np.einsum("ab,ifbc,dc->ifad", M, self.G, M, optimize=True)
        tangents = np.concatenate([self.tangents[:first], np.tensordot(weights, self.tangents[first:], 1)])
        scales = np.concatenate([self.scales[:first], np.ones(len(names))])
        units = self.units[:first] + ("1",) * len(names)
        apart = None if self.apart is None else np.tensordot(block_diag(np.eye(first), weights), self.apart, 1)
        return Gram(G, self.n, self.log_weight, tangents, scales, self.names[:first] + names, units, apart, self.s)


@dataclass
class Weighing:
    """Turns series into weighted block spectra at a working point. s : (bins,) of the determinant. measured : (bins,
    places, places) from a response to the motion to one to what is measured: noise_paths.py."""

    data: MotionBlocks
    paths: NoisePaths
    s: Complexes
    measured: Complexes | None = None
    _root: Array = field(init=False)
    _bins: slice | NDArray[np.int64] = field(init=False)
    _even: list[Spectrum] | None = field(init=False)
    rings: Ringing | None = field(init=False)

    def __post_init__(self) -> None:
        # one-sided PSD normalisation: the mean of |F|^2 over bins is S
        self._root = np.sqrt(self.weight * 2.0 / (self.data.rate_hz * self.data.block)).astype(np.float32)
        bins = self.data.bins
        self._even = None if self.data.level is None else [
            (1.0 / np.sqrt(self.rise(i, own))).astype(np.float32) for i, own in enumerate(self.data.level)
        ]  # fmt: skip
        self.rings = ringing(self.data, self._root)
        unbroken = bins[-1] - bins[0] == bins.size - 1  # a slice is read four times faster
        self._bins = slice(int(bins[0]), int(bins[-1]) + 1) if unbroken else bins

    @property
    def weight(self) -> Array:
        """(places, bins)"""
        return self.paths.weight

    def spectrum(
        self, i: int, series: Array | Spectrum, scale: float = 1.0, out: Spectrum | None = None, first: int = 0
    ) -> Spectrum:
        """(blocks, 2 bins) float32 of scale times a series (n,) seen at place i, the bins of the band.

        first : number of the block that the series begins with.
        """
        from scipy.fft import rfft

        z, root = series.reshape(-1, self.data.block), self._root[i]
        if out is None:
            out = np.empty((len(z), 2 * root.size), np.float32)
        single = z.dtype == np.float32
        root = root * np.float32(scale) if single else root
        for a in range(0, len(z), TOGETHER):
            part = z[a : a + TOGETHER]
            part = part if single else (scale * part).astype(np.float32)  # it may be too small for that before
            np.multiply(rfft(part, axis=1)[:, self._bins], root, out=out[a : a + TOGETHER].view(np.complex64))
        if self.rings is not None:
            self.rings.take_out(i, out)
        if self._even is not None:
            out.view(np.complex64)[...] *= self._even[i][first : first + len(z)]
        return out

    def rise(self, i: int, level: Array) -> Array:
        """(blocks, bins) PSD of the inferred force at place i in blocks of a level (blocks,), over that of the record:
        the level of the force but for noise of sensors, which does not rise with it."""
        return np.asarray(level[:, None] + (1.0 - level[:, None]) * self.paths.noise[i])

    def power(self, i: int, Z: Spectrum) -> Array:
        """(blocks,) power of a spectrum seen at place i (blocks, 2 bins), as it was before blocks were weighed by the
        level of the force."""
        if self._even is not None:
            Z = (Z.view(np.complex64) / self._even[i]).view(np.float32)
        return np.asarray(np.einsum("bk,bk->b", Z, Z), np.float64)

    def seen(self, tangents: Complexes) -> Complexes:
        """Tangents (..., places, places, bins) as the determinant needs them: to what is measured."""
        if self.measured is None:
            return tangents
        return np.asarray(np.einsum("...ilf,flj->...ijf", tangents, self.measured))

    def columns(self, terms: list[Term]) -> Columns:
        index: dict[int, list[int]] = {}
        for k, term in enumerate(terms):
            for i in term.series:
                index.setdefault(i, []).append(k)

        def at(i: int) -> Spectrum:
            out = np.empty((len(index[i]), self.data.blocks, 2 * self.weight.shape[1]), np.float32)
            for row, k in zip(out, index[i], strict=True):
                self.spectrum(i, terms[k].series[i], terms[k].scale, row)
            return out

        spectra = dict(zip(index, each(at, index), strict=True))
        tangents = self.seen(np.array([term_response(t, self.s) for t in terms]))
        return Columns(
            tuple(t.name for t in terms), tuple(t.unit for t in terms), np.array([t.scale for t in terms]), tangents,
            spectra, {i: np.array(k) for i, k in index.items()},
            np.array([np.zeros((FOLDS, *t.tangent.shape)) if t.apart is None else t.apart * t.scale for t in terms]),
        )  # fmt: skip


def gram(weighing: Weighing, force: dict[int, Spectrum], *columns: Columns) -> Gram:
    """Gram matrices of the force and all columns, by place and time fold."""
    data = weighing.data
    P = len(data.places)
    total = sum(len(c.names) for c in columns)
    G = np.zeros((P, FOLDS, 1 + total, 1 + total))
    n = np.zeros((P, FOLDS))
    kept = np.ones_like(weighing.weight) if weighing.rings is None else weighing.rings.kept
    log_weight = np.zeros((P, FOLDS))

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
        for f in range(FOLDS):
            here = np.flatnonzero(data.fold == f)
            span = slice(int(here[0]), int(here[-1]) + 1)
            Z = np.concatenate([s[:, span].reshape(len(s), -1) for s in stacks])
            G[i, f][at[:, None], at] = Z @ Z.T
            n[i, f] = here.size * kept[i].sum()
            log_weight[i, f] = here.size * (kept[i] @ np.log(weighing.weight[i]))
            if data.level is not None:
                log_weight[i, f] -= (np.log(weighing.rise(i, data.level[i, here])) @ kept[i]).sum()

    each(at_place, range(P))
    return Gram(
        G, n, log_weight, np.concatenate([c.tangents for c in columns]), np.concatenate([c.scales for c in columns]),
        tuple(k for c in columns for k in c.names), tuple(u for c in columns for u in c.units),
        np.concatenate([c.apart for c in columns]), weighing.s,
    )  # fmt: skip


class Jacobian:
    """2 sum_f log |det A(f)| per block and its derivatives, about the working point's A0 (bins, places, places).

    offset : to be taken from it for the line that A0 is given along: contour.py. kept : (bins,) share of each that the
    likelihood has of its bin.
    dressing : (bins, places), what of A0 comes from fluctuating tangents (self_energy.py). It is quadratic in the
    amplitudes of the laws, and a column of one of them has the half of its derivative: the value whose derivatives
    the columns have is 2 log |det A| - Re tr(A^-1 dressing), stationary in A. Models are compared by it.
    """

    def __init__(
        self, A0: Complexes, offset: float = 0.0, dressing: Complexes | None = None, kept: Array | None = None
    ) -> None:
        self.A0, self.offset, self.kept = A0, offset, np.ones(len(A0)) if kept is None else kept
        self.dressing = np.zeros(self.A0.shape[:2], complex) if dressing is None else dressing
        self._begun()

    def _begun(self) -> None:
        self.turned, self.half = turns(np.linalg.det(self.A0)), 0.0
        if self.dressing.any():
            own = np.einsum("fii->fi", np.linalg.inv(self.A0)) * self.dressing
            self.half = float(self.kept @ own.real.sum(axis=1))

    def at(self, places: NDArray[np.int64]) -> Jacobian:
        """The same of some places, the others as they are: what they answer through the shaft stays in A0."""
        out = copy(self)
        answer = self.answer(places)
        out.A0, out.dressing = self.A0[:, places[:, None], places], self.dressing[:, places]
        if answer is not None:
            others, follow = answer
            out.A0 = out.A0 - self.A0[:, places[:, None], others] @ follow
        share = places.size / self.A0.shape[1]
        out.offset = self.offset * share
        if answer is not None:  # all places together have what the whole has
            whole, own = (2 * float(self.kept @ np.log(np.abs(np.linalg.det(A)))) for A in (self.A0, out.A0))
            out.offset += own - whole * share
        out._begun()
        return out

    def answer(self, places: NDArray[np.int64]) -> tuple[NDArray[np.int64], Complexes] | None:
        """The places that the shaft couples to these, and their motion per motion of these, less its sign,
        (bins, others, places); None where there are none."""
        others = np.setdiff1d(np.arange(self.A0.shape[1], dtype=np.int64), places)
        others = others[np.any(self.A0[:, others[:, None], places] != 0, axis=(0, 2))]
        if not others.size:
            return None
        follow = np.linalg.solve(self.A0[:, others[:, None], others], self.A0[:, others[:, None], places])
        return others.astype(np.int64), np.asarray(follow, dtype=np.complex128)

    def tangents(self, tangents: Complexes, places: NDArray[np.int64]) -> Complexes:
        """What tangents (terms, all places, all places, bins) of forces at some places add to A0 `at` them."""
        own = tangents[:, places][:, :, places]
        answer = self.answer(places)
        if answer is None:
            return own
        others, follow = answer
        return np.asarray(own - np.einsum("tikf,fkj->tijf", tangents[:, places][:, :, others], follow))

    def of(self, tangents: Complexes, delta: Array) -> Complexes:
        """A at increments delta, (bins, places, places)."""
        return np.asarray(self.A0 + np.moveaxis(np.tensordot(delta, tangents, 1), 2, 0))

    def value(self, tangents: Complexes, delta: Array) -> float:
        """-inf where a mode has crossed the line: what the sum gives there is that of its mirror image."""
        determinant = np.linalg.det(self.of(tangents, delta))
        if turns(determinant) < self.turned - CROSSED:
            return -np.inf
        return float(2 * self.kept @ np.log(np.abs(determinant))) - self.offset - self.half

    def derivatives(self, tangents: Complexes, delta: Array) -> tuple[Array, Array]:
        """Gradient (k,) and second derivative (k, k) to the increments."""
        inverse = np.linalg.inv(self.of(tangents, delta))
        k, P = len(tangents), tangents.shape[1]
        acting = [np.flatnonzero(np.any(t != 0, axis=(1, 2))) for t in tangents]
        R = np.zeros((k, len(self.A0), P, P), complex)
        for j, t in enumerate(tangents):
            for i in acting[j]:  # A^-1 A_j, row i of A_j only
                R[j] += inverse[:, :, i][:, :, None] * t[i].T[:, None, :]
        gradient = 2 * np.einsum("jfpp,f->j", R, self.kept).real
        left = (R * self.kept[:, None, None]).reshape(k, -1)
        right = np.swapaxes(R, 2, 3).reshape(k, -1)
        return np.asarray(gradient), np.asarray(-2 * (left @ right.T).real)


@dataclass(frozen=True, slots=True)
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


def fit(
    gram: Gram,
    jacobian: Jacobian,
    folds: NDArray[np.int64],
    blocks: Array,
    start: Array | None = None,
    ridge: Array | None = None,
    steps: int = 30,
    told: float = 0.0,
) -> PathFit:
    """Maximise L over all terms by Newton's method with halving; ridge : (terms,) added to the information.

    told : nothing moves along sums of terms that have less than this share of the information of the terms.
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
        step = _solve(H, gradient, told)
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
    return PathFit(gram.names, delta, _inverse(H), S, value, gram.scales)


def _solve(H: Array, g: Array, told: float = 0.0) -> Array:
    """H^-1 g with eigenvalues kept away from zero (relative to the diagonal); those under `told` count as infinite."""
    d = 1 / np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-300))
    e, U = np.linalg.eigh(H * np.multiply.outer(d, d))
    e = np.where(np.abs(e) < told, np.inf, np.maximum(np.abs(e), 1e-6))
    return np.asarray(d * (U @ ((U.T @ (d * g)) / e)))


def _inverse(H: Array) -> Array:
    d = 1 / np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-300))
    e, U = np.linalg.eigh(H * np.multiply.outer(d, d))
    e = np.maximum(e, 1e-6)
    return np.asarray(np.multiply.outer(d, d) * ((U / e) @ U.T))
