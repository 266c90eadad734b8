"""An effect put at places of a record: its force, its mean tangent, its tangent along the path."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from . import linear_memory, shaft_law
from .arrays import Array, Series
from .calm import as_seen
from .effect import Effect
from .errors import NotFiniteError
from .features import FINER, MARGIN, State, decimated, depends, folds, jumps, law_force
from .hidden_states import along
from .motion_blocks import FOLDS, MotionBlocks

PIECE = 1 << 15  # rows of a record at a time: what a law needs of them stays in the cache
LARGEST = 1e12  # N: no bearing bears it, and what a step makes of more has no square in single precision
Evaluated = tuple[Array, Array, NDArray[np.complex128] | None]


@dataclass(frozen=True, slots=True)
class Placed:
    """An effect with parameters p (in declared order) shared by the places of index `at`; `key` heads their names."""

    effect: Effect
    key: str  # "bearing1.x.clearance"
    at: tuple[int, ...]
    p: Array
    free: tuple[bool, ...]

    def with_values(self, p: Array) -> Placed:
        return replace(self, p=p)

    def name(self, k: int) -> str:
        return f"{self.key}.{self.effect.parameters[k].name}"


def remembers(placed: Placed, lin: Array) -> bool:
    """Whether a law has a memory that obeys no linear equations."""
    return placed.effect.kind == "memory" and linear_memory.response(placed.effect, placed.p, lin) is None


def evaluate(placed: Placed, data: MotionBlocks, i: int, lin: Array, p: Array | None = None) -> Evaluated:
    """(n,) N of the effect at place i, (folds, places, 2) its mean tangents to x_l and v_l of every place in every time
    fold, and what more it answers to x_l in the mean, (places, bins) N/m, where it has a memory or acts through the
    disc.

    lin : (places, 3) m, kL, c. The tangent is averaged along the path, not under an assumed density: for a jump
    in v it is the Ito correction of this path.
    """
    p = np.ascontiguousarray(placed.p if p is None else p, dtype=np.float64)
    slopes = np.zeros((FOLDS, len(data.places), 2))
    if placed.effect.kind == "memory":
        linear = linear_memory.response(placed.effect, p, lin[i])
        if linear is not None:
            own = linear(2 * np.pi * data.f_hz)
            return linear_memory.filtered(linear, data.x[i], data.rate_hz), slopes, at_home(own, i, data)
        f, mean = along(placed.effect, p, lin[i], data.seen(i), data.v[i], data.rate_hz)
        return f, slopes, at_home(mean.at(data.f_hz), i, data)
    if placed.effect.kind == "shaft":
        f, across = shaft_law.along(placed.effect, p, data, i, lin)
        return f, slopes, across
    out, sums = _along(placed.effect, p, data, i)
    slopes[:, i] += sums[:, :2]
    o = data.other(i)
    if o is not None:
        slopes[:, o] += sums[:, 2:]
    return out, slopes, None


def at_home(response: NDArray[np.complex128] | complex, i: int, data: MotionBlocks) -> NDArray[np.complex128]:
    """(places, bins) of a response (bins,) to the displacement of place i itself."""
    out = np.zeros((len(data.places), data.bins.size), complex)
    out[i] = response
    return out


def sharp_at(effect: Effect, p: Array, data: MotionBlocks, i: int) -> bool:
    """Whether the samples of a law at place i do not hold what it does: it jumps, or its harmonics fold."""
    size = data.sizes(i)
    return jumps(effect, p, size) or folds(effect, p, size, data.rate_hz - data.band[1])


def _along(
    effect: Effect, p: Array, data: MotionBlocks, i: int, tangents: Series | None = None
) -> tuple[Array, Array]:  # fmt: skip
    """(n,) N of a law along the motion of place i, and (folds, 4) its mean tangents: features.py, as the fit has them.

    A law with a jump, or whose harmonics fold back into the band, is evaluated on a finer grid. tangents : (2, n) to
    be filled with those along x and v, on the grid of the data.
    """
    o, n, size = data.other(i), data.x.shape[1], data.sizes(i)
    reads = depends(effect, p, np.maximum(size, 1e-300))
    sharp = tangents is None and sharp_at(effect, p, data, i)
    zero, states = np.zeros(n), product((i, o), (data.calmed, data.v.__getitem__))
    seen = [of(j) if read and j is not None else zero for (j, of), read in zip(states, reads.tolist(), strict=True)]
    out, sums = np.empty(n), np.zeros((FOLDS, 4))
    for f, a, b in _pieces(data):
        rows = np.clip(np.arange(a - MARGIN, b + MARGIN), 0, n - 1) if sharp else slice(a, b)
        x, v, xo, vo, t, phase = (z[rows] for z in (*seen, data.t, data.phase))
        valid = np.ones(x.size, bool)
        state = State(x, v, xo, vo, t, phase, data.sign(i), data.smoothing(i), valid)
        if sharp:
            force, part = law_force(effect, p, state.finer(reads), reads)
            out[a:b], part = decimated(force), part / FINER
        else:
            series = None if tangents is None else (tangents[0, a:b], tangents[1, a:b])
            out[a:b], part = law_force(effect, p, state, reads, series)
        sums[f] += part
    if not (np.isfinite(sums).all() and max(out.max(), -out.min()) < LARGEST):
        raise NotFiniteError(effect.name, data.places[i])
    sums /= np.maximum(data.fold_rows, 1)[:, None]
    if data.calm is not None:
        for f, a, b in _pieces(data):  # by time folds, as the black box: beside a drift theirs differ
            as_seen(out[a:b], sums[f], data.calm[:, a:b], i, -1 if o is None else o)
    return out, sums


def _pieces(data: MotionBlocks) -> Iterator[tuple[int, int, int]]:
    """The time fold of a piece of the record, its first row and the one after its last."""
    last = np.cumsum(data.fold_rows)
    for f, (rows, end) in enumerate(zip(data.fold_rows.tolist(), last.tolist(), strict=True)):
        for a in range(end - rows, end, PIECE):
            yield f, a, min(a + PIECE, end)


def tangent_series(placed: Placed, data: MotionBlocks, i: int, p: Array) -> Series:
    """(2, n) tangents of a law along x and v at place i, those whose means `evaluate` gives."""
    tangents = np.zeros((2, data.x.shape[1]), np.float32)
    _along(placed.effect, np.ascontiguousarray(p, dtype=np.float64), data, i, tangents)
    return tangents
