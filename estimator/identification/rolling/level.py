"""Level of the excitation in a block of a rolling fit, by which the Gram matrices of the block are divided.

The level of a block, common to all places, is a parameter of its own, profiled out. With F = A a the score of anything
in A is then that of u = F / |F|, which does not depend on the level: estimates and missing force are those of a
stationary excitation. This costs one part in the number of bins of the information.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.likelihood.path.gram_likelihood import Point

from .memory import Memory

MIN_LEVEL_RATIO = 1.1  # of the power, from which the level has changed: 5 % in rms


@dataclass(frozen=True, slots=True)
class ExcitationLevel:
    """The excitation that counts as level 1.

    usual : (places,) sum of |F|^2 over the bins of a block, N^2/Hz.
    bins : number of bins in that sum.
    known : whether the force is measured; then every block has level 1, as the residual is sensor noise.
    """

    usual: Array
    bins: int
    known: bool

    @classmethod
    def of_first(cls, power: Array, per_cell: NDArray[np.intp], known: bool) -> ExcitationLevel:
        """Level 1 is that of the first seconds. power : (cells, places) their mean |F|^2. per_cell : bins per cell."""
        return cls(np.asarray(per_cell @ power), int(per_cell.sum()), known)

    def of(self, B: Array, gram: Array) -> float:
        """Level of a block, in power. B : (places, k) coefficients. gram : (cells, k, k) of the block."""
        if self.known:
            return 1.0
        power = np.sum((B @ gram.sum(axis=0)) * B, axis=1)
        return max(float(np.mean(power / self.usual)), 1e-12)

    def shown(self, point: Point, covariance: Array, long: Memory, recent: Memory) -> tuple[Point, Array]:
        """The point and covariance of the long memory, with the S of the recent one.

        The long memory has the common scatter of S divided out, so that scatter is that of the recent memory.
        """
        if self.known:
            return point, covariance
        p, P = point.beta.size, point.S.size
        out, S = covariance.copy(), slice(p, p + P)
        spread = recent.n2 / recent.n**2 - long.n2 / long.n**2
        out[S, S] += spread / (0.5 * self.bins * P)  # of log S: blocks overlap by half
        return replace(point, S=np.asarray(point.S * (recent.level / recent.n))), out


class LevelHistory:
    """Mean level of the last `blocks` blocks, and whether it has changed since the corrections were last renewed.

    A renewal takes up to a second, so a small change waits: soon after a renewal a change has to be large.
    """

    def __init__(self, blocks: int) -> None:
        self._last = deque[float](maxlen=blocks)
        self._at, self._waited = 1.0, 0

    def __len__(self) -> int:
        return len(self._last)

    def add(self, level: float) -> None:
        """Take the level of the next block."""
        self._last.append(level)
        self._waited += 1

    def has_changed(self) -> bool:
        """Whether the mean level differs enough from that of the last renewal."""
        share = min(1.0, self._waited / len(self._last))
        return bool(abs(np.log(np.mean(self._last) / self._at)) * share > np.log(MIN_LEVEL_RATIO))

    def renew(self) -> float:
        """Ratio of the mean level to that of the last renewal, in power, which it replaces."""
        before, self._at, self._waited = self._at, float(np.mean(self._last)), 0
        return self._at / before
