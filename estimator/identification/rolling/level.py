"""How strong the unknown force is in a block of a rolling fit: what its Gram matrices are divided by.

The level of a block, common to all places, is a parameter of its own, profiled out. With F = A a the score of anything
in A is then that of u = F / |F|, which the level leaves alone: estimates and missing force are those of an even force
(why an uneven one misleads: excitation_level.py), for one part in the number of bins of what the data tell.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.likelihood.path.gram_likelihood import Point

from .memory import Memory

MIN_LEVEL_RATIO = 1.1  # of the power of the force, from which it has moved: a twentieth in rms


@dataclass(frozen=True, slots=True)
class ExcitationLevel:
    """usual : (places,) sum over the bins of a block of |F|^2, N^2/Hz, that counts as level 1. bins : that are summed.
    known : the force is measured, and what is left of it is noise, not weighed."""

    usual: Array
    bins: int
    known: bool

    @classmethod
    def of_first(cls, power: Array, per_cell: NDArray[np.intp], known: bool) -> ExcitationLevel:
        """power : (cells, places) mean |F|^2 of the first seconds."""
        return cls(np.asarray(per_cell @ power), int(per_cell.sum()), known)

    def of(self, B: Array, gram: Array) -> float:
        """Of a block. B (places, k): coefficients of the columns; gram (cells, k, k): of the block."""
        if self.known:
            return 1.0
        power = np.sum((B @ gram.sum(axis=0)) * B, axis=1)
        return max(float(np.mean(power / self.usual)), 1e-12)

    def shown(self, point: Point, covariance: Array, long: Memory, recent: Memory) -> tuple[Point, Array]:
        """The point and its covariance, of the long memory, with the S that the force has of late: what all places have
        in common of the scatter of S is not that of the long memory, where it is divided out, but of the recent one."""
        if self.known:
            return point, covariance
        p, P = point.beta.size, point.S.size
        out, S = covariance.copy(), slice(p, p + P)
        spread = recent.n2 / recent.n**2 - long.n2 / long.n**2
        out[S, S] += spread / (0.5 * self.bins * P)  # of log S: blocks overlap by half
        return replace(point, S=np.asarray(point.S * (recent.level / recent.n))), out


class LevelHistory:
    """Whether the level of the last `blocks` blocks has moved since somebody last followed it.

    To follow takes a second of a core for some models, so that a small move waits: the sooner after the last time, the
    larger it has to be.
    """

    def __init__(self, blocks: int) -> None:
        self._last = deque[float](maxlen=blocks)
        self._at, self._waited = 1.0, 0

    def __len__(self) -> int:
        return len(self._last)

    def add(self, level: float) -> None:
        self._last.append(level)
        self._waited += 1

    def moved(self) -> bool:
        share = min(1.0, self._waited / len(self._last))
        return bool(abs(np.log(np.mean(self._last) / self._at)) * share > np.log(MIN_LEVEL_RATIO))

    def follow(self) -> float:
        """By how much the level has moved, in power."""
        before, self._at, self._waited = self._at, float(np.mean(self._last)), 0
        return self._at / before
