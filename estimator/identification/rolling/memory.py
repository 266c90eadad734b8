"""Memories of a rolling fit: sums over blocks, with old blocks forgotten exponentially."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.law_columns import Columns, Stretch
from estimator.likelihood.motion.law_smoothing import MARGIN_ROWS
from estimator.likelihood.response.second_order import TangentNoise

MAX_STALE_SHARE = 1e-2  # of the memory that may have other self-energies than the last block


@dataclass(slots=True)
class Memory:
    """Sums over blocks of weights that decay exponentially.

    keep : factor on all weights per block.
    gram : (cells, k, k) Gram matrices, each divided by the level of its block.
    tangents : (k, 4) tangents of the columns, of `rows` rows.
    motion : (m,) sums for the tangent noise.
    n, n2 : sum of the weights and of the squared weights.
    rows : weighted number of rows.
    level : sum of the levels.
    self_energies : second-order terms, the mean over the blocks except for `fresh` ones; None: no law fluctuates.
    fresh : weight of the blocks since the self-energies were last taken.
    stale_share : share of the weight whose self-energies may differ from the present ones.
    """

    keep: float
    gram: Array
    tangents: Array
    motion: Array = field(default_factory=lambda: np.zeros(0))
    _: KW_ONLY
    n: float = 0.0
    n2: float = 0.0
    rows: float = 0.0
    level: float = 0.0
    self_energies: Complexes | None = None
    fresh: float = 0.0
    stale_share: float = 0.0

    def forget(self) -> None:
        """Let the weights decay by one block."""
        factor = self.keep
        self.gram *= factor
        self.tangents *= factor
        self.motion *= factor
        self.n *= factor
        self.n2 *= factor**2
        self.rows *= factor
        self.level *= factor
        self.fresh *= factor

    def add(self, gram: Array, tangents: Array, motion: Array, rows: int, square: float, level: float) -> None:
        """Add a block. square : mean square of its bin weights, whose mean is 1. level : that divided `gram`."""
        self.gram += gram
        self.level += level
        self.fresh += 1.0
        self.tangents += tangents
        self.motion += motion
        self.n += 1.0
        self.n2 += square
        self.rows += rows

    def take_self_energies(self, self_energies: Complexes | None) -> None:
        """Give the blocks since the last call these self-energies."""
        share = self.fresh / self.n if self.n > 0.0 else 1.0
        self.stale_share *= 1.0 - share
        if self_energies is None or self.self_energies is None or self.stale_share < MAX_STALE_SHARE:
            self.self_energies = self_energies
        else:
            self.self_energies = self.self_energies + share * (self_energies - self.self_energies)
        self.fresh = 0.0

    def copy_from(self, other: Memory) -> None:
        """Take all sums of another memory."""
        self.gram, self.tangents, self.motion = other.gram.copy(), other.tangents.copy(), other.motion.copy()
        self.n, self.n2, self.rows, self.level = other.n, other.n2, other.rows, other.level
        self.self_energies, self.fresh, self.stale_share = other.self_energies, other.fresh, other.stale_share

    def clear(self) -> None:
        """Forget all blocks."""
        for sums in (self.gram, self.tangents, self.motion):
            sums[:] = 0.0
        self.n = self.n2 = self.rows = self.level = self.fresh = self.stale_share = 0.0


class TangentNoiseSums:
    """Tangent noise of the laws at displacement sensors, from sums over blocks.

    The sums are those of the products of 1, x^2 and the tangents of the laws. size : how many; 0 without such a law.
    """

    def __init__(self, columns: Columns) -> None:
        self._columns = columns
        balance = columns.balance
        self._laws = {
            row: [
                k
                for k, c in enumerate(balance.columns)
                if c.kind == "law" and c.row == row and balance.laws[c.law].effect.kind == "force"
            ]
            for row, kind in enumerate(balance.kinds)
            if kind == "displacement"
        }
        self._laws = {row: laws for row, laws in self._laws.items() if laws}
        self.size = sum((2 + len(laws)) ** 2 for laws in self._laws.values())

    def of_block(self, stretch: Stretch) -> Array:
        """(size,) sums over the rows of a block."""
        out = []
        for row, laws in self._laws.items():
            inner = slice(MARGIN_ROWS, MARGIN_ROWS + stretch.rows)
            series = [np.ones(stretch.rows), stretch.x[row, inner] ** 2]
            for k in laws:
                along_x, _, finer = self._columns.tangent_series(k, stretch)
                series.append(along_x[::finer])
            z = np.array(series)
            out.append((z @ z.T).ravel())
        return np.concatenate(out) if out else np.zeros(0)

    def tangent_noise(self, sums: Array) -> TangentNoise:
        """The tangent noise from sums (size,) over blocks."""
        P, K = len(self._columns.balance.places), len(self._columns.balance.columns)
        covariance, bend, at = np.zeros((P, K, K)), np.zeros((P, K)), 0
        for row, laws in self._laws.items():
            n = 2 + len(laws)
            products = sums[at : at + n * n].reshape(n, n)
            at += n * n
            means = products[0] / products[0, 0]
            about = products / products[0, 0] - np.outer(means, means)
            covariance[row, np.array(laws)[:, None], laws] = about[2:, 2:]
            bend[row, laws] = about[1, 2:] / about[1, 1]
        return TangentNoise(covariance, bend)
