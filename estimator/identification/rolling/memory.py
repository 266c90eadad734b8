"""What a rolling fit remembers: sums over blocks that forget exponentially."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.law_columns import Columns, Stretch
from estimator.likelihood.motion.law_smoothing import MARGIN_ROWS
from estimator.likelihood.response.second_order import TangentNoise

MAX_STALE_SHARE = 1e-2  # share of other self-energies that is let go


@dataclass(slots=True)
class Memory:
    """n : blocks; n2 : sum of squared weights; tangents : of `rows` rows; motion : what FlutterSums wants to know.

    level : sum of what the blocks of `gram` were weighed by (level.py). pairs : self-energies (second_order.py),
    the mean over its blocks but for `fresh` ones. apart : share of it that may differ from those of the last block.
    """

    keep: float  # what is left after one block
    gram: Array
    tangents: Array
    motion: Array = field(default_factory=lambda: np.zeros(0))
    n: float = 0.0
    n2: float = 0.0
    rows: float = 0.0
    level: float = 0.0
    pairs: Complexes | None = None
    fresh: float = 0.0
    apart: float = 0.0

    def forget(self) -> None:
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
        """square : mean square of the weights of the bins, whose mean is 1. level : that `gram` was divided by."""
        self.gram += gram
        self.level += level
        self.fresh += 1.0
        self.tangents += tangents
        self.motion += motion
        self.n += 1.0
        self.n2 += square
        self.rows += rows

    def dress(self, pairs: Complexes | None) -> None:
        """Let the blocks since the last call have these self-energies."""
        share = self.fresh / self.n if self.n > 0.0 else 1.0
        self.apart *= 1.0 - share
        if pairs is None or self.pairs is None or self.apart < MAX_STALE_SHARE:
            self.pairs = pairs
        else:
            self.pairs = self.pairs + share * (pairs - self.pairs)
        self.fresh = 0.0

    def copy_from(self, other: Memory) -> None:
        self.gram, self.tangents, self.motion = other.gram.copy(), other.tangents.copy(), other.motion.copy()
        self.n, self.n2, self.rows, self.level = other.n, other.n2, other.rows, other.level
        self.pairs, self.fresh, self.apart = other.pairs, other.fresh, other.apart

    def clear(self) -> None:
        for sums in (self.gram, self.tangents, self.motion):
            sums[:] = 0.0
        self.n = self.n2 = self.rows = self.level = self.fresh = self.apart = 0.0


class TangentNoiseSums:
    """dressing.flutter from sums over blocks: of the tangents of the laws where the sensor is one of displacement, of
    the square of that, and of all their products. `size` is 0 where no such law is."""

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

    def of(self, stretch: Stretch) -> Array:
        """(size,) of one block: the products of 1, x^2 and the tangents, summed over its rows."""
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

    def flutter(self, sums: Array) -> TangentNoise:
        """From the sums over all blocks."""
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
