"""The estimate of a rolling fit: the maximum of the path likelihood of its memories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.path.path_fit import Gram, PathFit, fit_increments, information_inverse, slope_and_curvature
from estimator.likelihood.whitening.determinant import Jacobian

from .anchor import Anchor, anchor_at
from .memory import Memory
from .piece import excess_power, piece_sums, renewed_noise
from .thresholds import LIMITS

THE_FOLD = np.zeros(1, np.int64)  # the only fold of a memory


def problem_of(anchor: Anchor, memory: Memory, names: int) -> tuple[Gram, Jacobian, Array]:
    """The likelihood of a memory in the first `names` parameters: Gram matrices of one fold, determinant, and weighted
    number of blocks (1,)."""
    K = names
    tangents, share = memory.tangents[:K] / memory.n, memory.kept / memory.n
    jacobian, responses = anchor.problem(memory.mean_tangent / memory.n, tangents, share)
    P = len(anchor.data.places)
    n = np.full((P, 1), memory.kept.sum())
    gram = Gram(
        G=memory.gram.sum(axis=0)[:, None, : 1 + K, : 1 + K], n=n, log_weight=np.zeros((P, 1)), tangents=responses,
        scales=anchor.scales[:K], names=anchor.names[:K],
    )  # fmt: skip
    return gram, jacobian, np.array([memory.n])


def _with_values(use: LocatedLaw, values: Mapping[str, float]) -> LocatedLaw:
    """The law at values by full name; those that it is not linear in stay within their limits."""
    p = [values[use.name(k)] for k in range(use.p.size)]
    limits = [(-np.inf, np.inf) if q.linear else (q.low, q.high) for q in use.effect.parameters]
    return use.with_values(np.array([np.clip(z, *own) for z, own in zip(p, limits, strict=True)]))


class Follower:
    """Memories and estimate of a rolling fit.

    anchor : that the increments `delta` (k,), scaled, are counted from. slow, fast, watched : memories; the last one
    holds the candidates too. fit : the last maximum on the slow memory; None before the first one.
    """

    def __init__(self, anchor: Anchor, time_constant_s: float) -> None:
        block_s = anchor.data.block / anchor.data.rate_hz
        fast = max(LIMITS.fast_time_constant_rel * time_constant_s, LIMITS.min_fast_blocks * block_s)
        slow, quick = (float(np.exp(-block_s / t)) for t in (time_constant_s, fast))
        self.anchor, self.delta = anchor, np.zeros(anchor.own)
        self.slow, self.fast = Memory(keep=slow), Memory(keep=quick)
        self.watched = Memory(keep=max(slow, float(np.exp(-1.0 / LIMITS.min_watched_blocks))))
        self.shared = 0.0  # sum of the products of the weights of `slow` and `fast`
        self.fit: PathFit | None = None
        self._slope = np.zeros(0), np.zeros(0)  # of the determinant of a block, by increments and by mean tangents
        self._changes_in_a_row, self._solutions = 0, 0
        self._anchored_level = np.ones(len(anchor.data.places))
        self._noise: tuple[Array, Array] | None = None  # nu and S other than those of the anchor
        self._excess: list[tuple[float, float]] | None = None  # at the last maximum, once it is asked for

    def forget(self, blocks: float) -> None:
        """Let all memories decay."""
        for memory in (self.slow, self.fast, self.watched):
            memory.forget(blocks)
        self.shared *= (self.slow.keep * self.fast.keep) ** blocks

    def take(self, data: MotionRecord, watched: bool) -> None:
        """Add a record. watched : whether with the candidates. Raises NotFiniteError before any memory has changed."""
        piece = piece_sums(self.anchor, data, self.delta, watched)
        if watched:
            self.watched.add(piece, None)
            K = self.anchor.own
            piece = replace(piece, gram=piece.gram[:, :, : 1 + K, : 1 + K], tangents=piece.tangents[:K])
        score = None if self.fit is None else self._score(piece.gram, piece.blocks, piece.tangents, self.fit.S)
        self.slow.add(piece, score)
        self.fast.add(piece, score)
        self.shared += piece.blocks

    def _score(self, gram: Array, blocks: float, tangents: Array, S: Array) -> Array:
        """(k,) slope of the log-likelihood of some blocks at the estimate.

        gram : their sum. tangents : their mean. S : (places,) N^2/Hz.
        """
        b, (own, by_tangent) = np.append(1.0, self.delta), self._slope
        of_force = np.einsum("iab,b,i->a", gram.sum(axis=0), b, 2.0 / S)[1:]
        moved = tangents - self.slow.tangents / self.slow.n
        return np.asarray(blocks * (own + np.einsum("kijc,ijc->k", moved, by_tangent)) - of_force)

    def solve(self) -> None:
        """Renew the estimate from the slow memory, and that memory if the recent data contradict it."""
        self._renew()
        if self._solutions % LIMITS.solutions_per_check == 0:
            self._changes_in_a_row = self._changes_in_a_row + 1 if self._has_changed() else 0
            if self._changes_in_a_row >= 2:
                self._replace()
        self._solutions += 1

    def _renew(self) -> None:
        """Set the estimate to the maximum on the slow memory, by one Newton step, or by several if the step is long."""
        anchor = self.anchor
        gram, jacobian, blocks = problem_of(anchor, self.slow, anchor.own)
        steps = LIMITS.max_steps if self.fit is None else 1
        fit = fit_increments(gram, jacobian, THE_FOLD, blocks, self.delta, anchor.prior, steps)
        far = np.abs(fit.delta - self.delta) > LIMITS.max_newton_sd * np.sqrt(np.diag(fit.covariance))
        if steps == 1 and far.any():
            fit = fit_increments(gram, jacobian, THE_FOLD, blocks, fit.delta, anchor.prior, LIMITS.max_steps)
        if anchor.prior.any():  # the covariance is without prior information
            H = slope_and_curvature(gram, jacobian, THE_FOLD, blocks, fit.delta)[2]
            fit = replace(fit, covariance=information_inverse(H))
        self.fit, self.delta, self._excess = fit, fit.delta, None
        self._slope = self._slopes(gram, jacobian)

    def _slopes(self, gram: Gram, jacobian: Jacobian) -> tuple[Array, Array]:
        """Slopes of the determinant of a block by the increments (k,) and by the mean tangents (places, places, 2)."""
        slope, by_matrix = jacobian.slopes(gram.tangents, self.delta)
        P = len(by_matrix)
        by_x, by_v = (self.anchor.response(np.broadcast_to(one, (P, P, 2))) for one in np.eye(2))
        return slope, np.stack([(by_matrix * one).real.sum(axis=2) for one in (by_x, by_v)], axis=-1)

    def covariance(self) -> Array:
        """(k, k) of the increments, scaled: inverse Hessian, wider where the scores of the pieces scatter more."""
        fit, slow = self._maximum(), self.slow
        bread = fit.covariance
        out = bread * (slow.n2 / slow.n)
        count = slow.pieces2**2 / slow.pieces4 if slow.pieces4 > 0.0 else 0.0
        if count < LIMITS.min_pieces:
            return np.asarray(out)
        ratio = np.einsum("ab,bc,ca->a", bread, slow.spread, bread) / np.diag(out)
        wider = np.where(ratio - 1.0 > LIMITS.min_excess_sd * np.sqrt(2.0 / count), ratio, 1.0)
        return np.asarray(out * np.sqrt(np.multiply.outer(wider, wider)))

    def excitation(self) -> Array:
        """(places,) N^2/Hz, PSD of the excitation at the level of the anchor."""
        return self._maximum().S

    def excess_power(self) -> list[tuple[float, float]]:
        """Relative excess of the power of the residual force over the model in the most significant cell, and the
        frequency of the cell, Hz, by place; 0 where no cell is significant."""
        if self._excess is None:
            self._excess = excess_power(self.anchor, self.slow, self.delta)
        return self._excess

    def _maximum(self) -> PathFit:
        """The last maximum. Raises RuntimeError before the first one."""
        if self.fit is None:
            raise RuntimeError("no estimate yet")
        return self.fit

    def level(self) -> tuple[Array, Array]:
        """(places,) recent power of the excitation over that of the anchor, and its standard deviation."""
        m = self.fast
        mean = m.level / m.n
        scatter = np.maximum(m.level2 / m.n - mean**2, 0.0)
        least = mean**2 / (m.kept.sum() / m.n)  # of white noise
        return mean, np.sqrt(np.maximum(scatter, least) * m.n2) / m.n

    def _has_changed(self) -> bool:
        """Whether the fast memory contradicts the slow one, by a score test."""
        f, s, fit = self.fast, self.slow, self._maximum()
        b, gram = np.append(1.0, self.delta), f.gram.sum(axis=0)
        S = np.einsum("a,iab,b->i", b, gram, b) / f.kept.sum()
        step = fit.covariance @ self._score(f.gram, f.n, f.tangents / f.n, S) * s.n / f.n
        spread = f.n2 / f.n**2 + s.n2 / s.n**2 - 2 * self.shared / (f.n * s.n)  # the memories share recent blocks
        variance = np.diag(fit.covariance) * s.n * max(spread, 1e-9)
        return bool(np.any(np.abs(step) > LIMITS.min_change_sd * np.sqrt(variance)))

    def _replace(self) -> None:
        """Replace the slow memory by the fast one, and clear that of the candidates, which has no recent one."""
        self.slow.copy_from(self.fast)
        self.shared, self._changes_in_a_row = self.fast.n2, 0
        self.watched = Memory(keep=self.watched.keep)
        self.fit = None
        self._renew()

    def wants_anchor(self) -> bool:
        """Whether the values, the mean tangents of the laws or the sensor noise have moved far from the anchor."""
        if self.fit is None:
            return False
        if self._solutions % LIMITS.solutions_per_check == 1:
            self._noise = renewed_noise(self.anchor, self.slow, self.delta)
        far = np.abs(self.delta) > LIMITS.max_anchor_sd * np.sqrt(np.diag(self.covariance()))
        far |= np.abs(self.delta) * np.sqrt(self.anchor.prior) > LIMITS.max_searched_step
        ratio = np.abs(np.log(self.fast.level / self.fast.n / self._anchored_level))
        return bool(self._noise or far.any() or (self.anchor.placed and (ratio > np.log(LIMITS.min_level_ratio)).any()))

    def renew_anchor(self, data: MotionRecord) -> None:
        """Count the increments from the present values. data : the last seconds. Raises NotFiniteError."""
        old, values = self.anchor, self.values()
        places = old.data.places
        kL, c = (np.array([values[f"{p}.{key}"] for p in places]) for key in ("kL", "c"))
        mass = np.array([values.get(f"{p}.m", m) for p, m in zip(places, old.data.mass, strict=True)])
        placed = [_with_values(use, values) for use in old.placed]
        data = data.with_mass(mass) if data.free_inertia else data
        nu, S = self._noise or (old.nu, old.S)
        self._noise = None
        new = anchor_at(data, kL, c, nu, S, placed, old.watched, old)
        if new.names != old.names:
            return
        weight = [np.add.reduceat(a.whitening.weight * a.kept, a.cells, axis=1).T for a in (new, old)]
        for memory in (self.slow, self.fast, self.watched):
            memory.reweighted(weight[0] / weight[1], old.S / S)
        ratio = new.scales / old.scales
        self.slow.moved(self.delta, ratio[: new.own])
        self.fast.moved(self.delta, ratio[: new.own])
        self.watched.moved(np.append(self.delta, np.zeros(ratio.size - new.own)), ratio)
        self._anchored_level = self.fast.level / self.fast.n
        self.anchor, self.delta = new, np.zeros(new.own)
        self.solve()

    def values(self) -> dict[str, float]:
        """The value of every parameter of the model by full name, SI."""
        out = self.anchor.value_of
        for name, step in zip(self.anchor.names, self.delta * self.anchor.scales[: self.anchor.own], strict=False):
            out[name] = out.get(name, 0.0) + float(step)
        return out
