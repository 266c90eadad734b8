"""Weighted means of a vector series and their covariance for correlated rows, as a recursion over blocks.

Each block contributes its row sum s (K,) and row count n. With weights w (exponential forgetting; 1 for a batch)

    mean = sum(w s) / sum(w n),     cov(mean) = sum(w^2 r r') / sum(w n)^2 . G/(G-1),   r = s - n mean

which holds for correlated rows as long as a block spans many correlation times (the method of batch means);
G = sum(w n)^2 / sum(w^2 n^2) is the effective number of blocks.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array


class BlockMoments:
    """Weighted sums over the blocks of a series of `size` columns. rows : weighted number of rows."""

    def __init__(self, size: int) -> None:
        self.rows = 0.0
        self._sum = np.zeros(size)
        self._outer = np.zeros((size, size))
        self._cross = np.zeros(size)
        self._squared = 0.0

    def add(self, total: Array, rows: int, forget: float = 1.0) -> None:
        """Take a block with row sum `total` (K,) over `rows` rows, after multiplying all older weights by `forget`."""
        old = forget * forget
        self.rows = forget * self.rows + rows
        self._sum = forget * self._sum + total
        self._outer = old * self._outer + np.multiply.outer(total, total)
        self._cross = old * self._cross + rows * total
        self._squared = old * self._squared + float(rows) ** 2

    @property
    def blocks(self) -> float:
        """Effective number of blocks."""
        return self.rows**2 / self._squared if self._squared > 0.0 else 0.0

    @property
    def mean(self) -> Array:
        """Weighted mean (K,); zeros before the first row."""
        return self._sum / self.rows if self.rows > 0.0 else np.zeros_like(self._sum)

    def covariance(self) -> Array:
        """Covariance of `mean` (K, K); needs two blocks, else infinite on the diagonal."""
        groups = self.blocks
        if groups < 1.5:
            return np.diag(np.full(self._sum.size, np.inf))
        mean = self.mean
        cross = np.multiply.outer(self._cross, mean)
        spread = self._outer - cross - cross.T + self._squared * np.multiply.outer(mean, mean)
        return np.asarray(spread / self.rows**2 * (groups / (groups - 1.0)))


def propagate(
    function: Callable[[NDArray[np.complex128]], NDArray[np.complex128]], moments: BlockMoments
) -> tuple[Array, Array]:
    """function(mean) (P,), and its covariance by the delta method with an exact complex-step derivative.

    function : (..., K) complex -> (..., P) complex, analytic; called once, for all K directions. The covariance is
    (P, P) float64, infinite for fewer than two blocks.
    """
    covariance = moments.covariance()
    mean = moments.mean.astype(complex)
    if not np.isfinite(covariance).all():
        value = function(mean).real
        return value, np.full((value.size, value.size), np.inf)
    scale = np.sqrt(np.abs(np.diag(covariance)))
    scale[scale == 0.0] = 1.0
    step = 1e-30
    moved = function(mean + np.diag(1j * step * scale))
    jacobian = moved.imag.T / step
    spread = covariance / np.multiply.outer(scale, scale)
    return moved[0].real, np.asarray(jacobian @ spread @ jacobian.T)
