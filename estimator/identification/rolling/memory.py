"""Memories of a rolling fit: sums over pieces of a record, with old pieces forgotten exponentially."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimator.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """Sums over some blocks that the likelihood needs.

    gram : (cells, places, 1 + k, 1 + k) products of the whitened residual force and the regressors, over the level.
    blocks : number of blocks. tangents : (k, places, places, 2) mean tangents of the regressors, scaled. mean_tangent :
    (places, places, 2) of all forces. kept : (bins,) share of each bin. level : (places,) power of the excitation over
    that of the anchor.
    """

    gram: Array
    blocks: float
    tangents: Array
    mean_tangent: Array
    kept: Array
    level: Array


@dataclass(slots=True, kw_only=True)
class Memory:
    """Weighted sums of pieces. The weight of a piece decays by `keep` per block.

    n, n2 : sum of the weights and of the squared weights of the blocks. pieces2, pieces4 : sums of the second and
    fourth powers of the weights of the pieces. spread : (k, k) sum of the squared weighted scores. level, level2 :
    (places,) sum of the levels and of their squares.
    """

    keep: float
    gram: Array = field(default_factory=lambda: np.zeros(()))
    tangents: Array = field(default_factory=lambda: np.zeros(()))
    mean_tangent: Array = field(default_factory=lambda: np.zeros(()))
    kept: Array = field(default_factory=lambda: np.zeros(()))
    level: Array = field(default_factory=lambda: np.zeros(()))
    level2: Array = field(default_factory=lambda: np.zeros(()))
    spread: Array = field(default_factory=lambda: np.zeros(()))
    n: float = 0.0
    n2: float = 0.0
    pieces2: float = 0.0
    pieces4: float = 0.0

    def forget(self, blocks: float) -> None:
        """Let the weights decay by some blocks."""
        factor = self.keep**blocks
        for name in ("gram", "tangents", "mean_tangent", "kept", "level", "level2", "n"):
            setattr(self, name, getattr(self, name) * factor)
        self.spread, self.n2, self.pieces2 = (z * factor**2 for z in (self.spread, self.n2, self.pieces2))
        self.pieces4 *= factor**4

    def add(self, piece: Piece, score: Array | None) -> None:
        """Add a piece. score : (k,) slope of its log-likelihood at the estimate; None: not known yet."""
        B = piece.blocks
        self.gram = self.gram + piece.gram
        for name in ("tangents", "mean_tangent", "kept", "level"):
            setattr(self, name, getattr(self, name) + B * getattr(piece, name))
        self.level2 = self.level2 + B * piece.level**2
        self.n += B
        self.n2 += B
        if score is not None:
            self.spread = self.spread + np.multiply.outer(score, score)
            self.pieces2 += 1.0
            self.pieces4 += 1.0

    def moved(self, delta: Array, ratio: Array) -> None:
        """Count the increments from another anchor, delta (k,) scaled units away, whose scaled units are `ratio` (k,)
        of the former ones."""
        if self.n == 0.0:
            return
        M = np.diag(np.append(1.0, ratio))
        M[0, 1:] = delta
        self.gram = M @ self.gram @ M.T
        self.tangents = self.tangents * ratio[:, None, None, None]
        if self.spread.ndim:
            self.spread = self.spread * np.multiply.outer(ratio, ratio)

    def reweighted(self, weight: Array, level: Array) -> None:
        """Change the weights of the cells by a factor (cells, places), and the levels by a factor (places,)."""
        if self.n > 0.0:
            self.gram = self.gram * weight[:, :, None, None]
            self.level, self.level2 = self.level * level, self.level2 * level**2

    def copy_from(self, other: Memory) -> None:
        """Take the sums of another memory; the rate of decay of the weights stays."""
        for name in self.__slots__:
            if name != "keep":
                setattr(self, name, getattr(other, name))
