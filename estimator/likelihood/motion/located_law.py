"""The laws of a model at their places: start values, force and mean tangents along a motion record."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Series
from estimator.effects import CATALOGUE
from estimator.effects.engine.custom import effect_of
from estimator.effects.engine.strength import Size
from estimator.effects.places import at, kinematic, written
from estimator.errors import LawNotFiniteError
from estimator.likelihood.thresholds import LIMITS
from estimator.model.effect import Effect, EffectParameter
from estimator.model.rig import Model

from . import linear_memory, shaft_law
from .denoise import restore_mean_tangent
from .harmonics import PERIODIC_EFFECTS
from .law_smoothing import MARGIN_ROWS, LawStates, decimated, harmonics_alias, has_jump, law_force, reads_states
from .memory_law import memory_force_and_response
from .motion_record import TIME_FOLDS, MotionRecord

FORCE_KINDS = ("force", "memory", "shaft")  # kinds of effects that act through the motion of the bearing caps


def natural_sizes(data: MotionRecord, i: int, kL: float) -> Size:
    """Natural sizes at a place from the measured motion, SI. kL : N/m."""
    return Size(
        x=float(data.rms[0, i]), v=float(data.rms[1, i]), m=float(data.mass[i]), kL=float(kL),
        a=float(data.rms[2, i]), rate_hz=data.rate_hz, band_hz=data.band[1],
    )  # fmt: skip


def first_stiffness(data: MotionRecord, i: int) -> float:
    """First estimate of the stiffness at a place, N/m: mass times E[v^2] / E[x^2]."""
    return float(data.mass[i] * np.mean(data.v[i] ** 2) / np.mean(data.x[i] ** 2))


def acted_on(effect: Effect, canonical: str, data: MotionRecord) -> tuple[int, ...]:
    """Indices of the measured places on which an effect at a canonical place acts."""
    if effect.kind in ("shaft", "disc"):
        return tuple(range(len(data.places)))
    return tuple(i for i, p in enumerate(data.places) if p == canonical or p.split(".")[0] == canonical)


def searched_parameters(effect: Effect, model: Model) -> list[int]:
    """Indices of the searched parameters: neither amplitudes, nor given, nor known from the bearing geometry.

    A ball-pass order found in the record is searched too, as the phase of the amplitudes depends on it.
    """
    return [
        k
        for k, q in enumerate(effect.parameters)
        if not q.linear and not q.given and (kinematic(q.scale, model) is None or _estimated(q, model))
    ]


def _estimated(q: EffectParameter, model: Model) -> bool:
    return q.scale == "bpfo" and model.order_found


def start_value(q: EffectParameter, natural: Size, model: Model) -> float:
    """Start value of a parameter without a setting, SI."""
    known = kinematic(q.scale, model)
    if known is not None:
        return known
    return 0.0 if q.linear else q.default * natural.of(q)


def located_laws(model: Model, data: MotionRecord) -> list[LocatedLaw]:
    """The model's force laws at their places, started at the values of the rig file."""
    out = []
    for use in model.effects:
        effect = effect_of(use)
        if effect.kind not in FORCE_KINDS or effect.name in PERIODIC_EFFECTS:
            continue
        loose = set(searched_parameters(effect, model))
        for canonical in at(effect, use, model):
            where = acted_on(effect, canonical, data)
            if not where:
                continue
            settings = written(effect, use, model, canonical)
            natural = natural_sizes(data, where[0], first_stiffness(data, where[0]))
            p = np.zeros(len(effect.parameters))
            free = []
            for k, q in enumerate(effect.parameters):
                s = settings.get(q.name)
                p[k] = s.value if s is not None and s.value is not None else start_value(q, natural, model)
                typed = s is not None and s.value is not None and not q.given  # of a kinematic number: it may slip
                free.append((q.linear or k in loose or typed) and not (s is not None and s.fixed))
            out.append(LocatedLaw(effect=effect, key=f"{canonical}.{effect.name}", at=where, p=p, free=tuple(free)))
    return out


def trial_effects(model: Model) -> list[Effect]:
    """Effects that a diagnosis tries: the catalogue, and laws of the user that the model does not have yet."""
    return [*CATALOGUE.values(), *(effect_of(use) for use in model.candidates)]


LawAlongPath = tuple[Array, Array, NDArray[np.complex128] | None]


@dataclass(frozen=True, slots=True)
class LocatedLaw:
    """One law with its parameters, acting at one or more places.

    effect : the law. key : head of the names of its parameters, "bearing1.x.clearance". at : indices of its places.
    p : (k,) parameters in declared order, SI. free : (k,) whether each parameter is fitted.
    """

    effect: Effect
    key: str
    at: tuple[int, ...]
    p: Array
    _: KW_ONLY
    free: tuple[bool, ...]

    def with_values(self, p: Array) -> LocatedLaw:
        return replace(self, p=p)

    def name(self, k: int) -> str:
        return f"{self.key}.{self.effect.parameters[k].name}"


def has_nonlinear_memory(placed: LocatedLaw, lin: Array) -> bool:
    """Whether a law has memory whose states obey nonlinear equations. lin : (3,) m, kL, c."""
    return placed.effect.kind == "memory" and linear_memory.linear_response(placed.effect, placed.p, lin) is None


def law_along_record(
    placed: LocatedLaw, data: MotionRecord, i: int, lin: Array, p: Array | None = None
) -> LawAlongPath:
    """Force of a law at place i along the record, its mean tangents, and its mean response.

    The tangent is averaged along the path, not under an assumed density: for a jump in v it is the Ito correction of
    this path. lin : (places, 3) m, kL, c. p : parameters in place of the law's own.

    Returns the force (n,) N; its mean tangents (places, 2) to x and v of every place, N/m and N s/m; and
    (places, bins) N/m its mean response to the displacement of every place, None unless the law has memory or acts
    through the disc.
    """
    p = np.ascontiguousarray(placed.p if p is None else p, dtype=np.float64)
    slopes = np.zeros((len(data.places), 2))
    if placed.effect.kind == "memory":
        linear = linear_memory.linear_response(placed.effect, p, lin[i])
        if linear is not None:
            own = linear(2 * np.pi * data.f_hz)
            return linear_memory.filtered_series(linear, data.x[i], data.rate_hz), slopes, own_response(own, i, data)
        if not np.isfinite(data.displacement(i).sum() + p.sum()):
            raise LawNotFiniteError(placed.effect.name, data.places[i])
        f, mean = memory_force_and_response(placed.effect, p, lin[i], data.displacement(i), data.v[i], data.rate_hz)
        return f, slopes, own_response(mean.at(data.f_hz), i, data)
    if placed.effect.kind == "shaft":
        f, across = shaft_law.shaft_force(placed.effect, p, data, i, lin)
        return f, slopes, across
    amplitudes = np.array([q.linear for q in placed.effect.parameters])
    out, sums = _along(placed.effect, p, data, i, like=np.where(amplitudes, p, placed.p))
    slopes[i] += sums[:2]
    o = data.other(i)
    if o is not None:
        slopes[o] += sums[2:]
    return out, slopes, None


def own_response(response: NDArray[np.complex128] | complex, i: int, data: MotionRecord) -> NDArray[np.complex128]:
    """(places, bins) N/m, response (bins,) to the displacement of place i itself; 0 for other places."""
    out = np.zeros((len(data.places), data.bins.size), complex)
    out[i] = response
    return out


def needs_finer_grid(effect: Effect, p: Array, data: MotionRecord, i: int) -> bool:
    """Whether a law at place i has to be evaluated on a finer grid: it jumps, or its harmonics alias."""
    return _character(effect, tuple(p), tuple(data.sizes(i)), data.rate_hz - data.band[1])[1]


@lru_cache(maxsize=LIMITS.characters_held)  # pieces of a stream ask for the same law again and again
def _character(
    effect: Effect, p: tuple[float, ...], size: tuple[float, ...], folding_hz: float
) -> tuple[NDArray[np.bool_], bool]:
    """Which of x, v, xo, vo a law reads, and whether the law needs a finer grid. size : (4,) rms of the four."""
    values, rms = np.array(p), np.array(size)
    reads = reads_states(effect, values, np.maximum(rms, 1e-300))
    return reads, has_jump(effect, values, rms) or harmonics_alias(effect, values, rms, folding_hz)


def _along(
    effect: Effect, p: Array, data: MotionRecord, i: int, tangents: Series | None = None, like: Array | None = None
) -> tuple[Array, Array]:  # fmt: skip
    """Force (n,) N of a memoryless law along the motion of place i, and its mean tangents (4,) to x, v, xo, vo.

    A law that jumps, or whose harmonics alias, is evaluated on a finer grid. tangents : (2, n) to be filled with the
    tangents along x and v, on the grid of the record. like : parameters that decide on the grid, so that laws whose
    difference is taken have the same one; None: p.
    """
    o, n = data.other(i), data.x.shape[1]
    asked = p if like is None else like
    reads, jumps = _character(effect, tuple(asked), tuple(data.sizes(i)), data.rate_hz - data.band[1])
    sharp = tangents is None and jumps
    zero, states = np.zeros(n), product((i, o), (data.denoised_displacement, data.v.__getitem__))
    seen = [of(j) if read and j is not None else zero for (j, of), read in zip(states, reads.tolist(), strict=True)]
    out, sums = np.empty(n), np.zeros((TIME_FOLDS, 4))
    for f, a, b in _pieces(data):
        rows = np.clip(np.arange(a - MARGIN_ROWS, b + MARGIN_ROWS), 0, n - 1) if sharp else slice(a, b)
        x, v, xo, vo, t, phase = (z[rows] for z in (*seen, data.t, data.phase))
        valid = np.ones(x.size, bool)
        state = LawStates(x=x, v=v, xo=xo, vo=vo, t=t, phase=phase, s=data.sign(i), h=data.smoothing(i), valid=valid)
        if sharp:
            force, part = law_force(effect, p, state.finer(reads), reads)
            out[a:b], part = decimated(force), part / LIMITS.law_grid_factor
        else:
            series = None if tangents is None else (tangents[0, a:b], tangents[1, a:b])
            out[a:b], part = law_force(effect, p, state, reads, series)
        sums[f] += part
    if not (np.isfinite(sums).all() and max(out.max(), -out.min()) < LIMITS.max_force_n):
        raise LawNotFiniteError(effect.name, data.places[i])
    if data.denoise_correction is not None:
        means, other = sums / np.maximum(n * data.fold_blocks[:, None] / data.blocks, 1.0), -1 if o is None else o
        for f, a, b in _pieces(data):  # by time folds, as the black box: beside a drift theirs differ
            restore_mean_tangent(out[a:b], means[f], data.denoise_correction[:, a:b], i, other)
    return out, sums.sum(axis=0) / max(n, 1)


def _pieces(data: MotionRecord) -> Iterator[tuple[int, int, int]]:
    """Pieces of the rows of a record: time fold, first row, row after the last."""
    cuts = [0, *(np.flatnonzero(np.diff(data.fold)) + 1).tolist(), data.blocks]
    rows = [cut * data.x.shape[1] // data.blocks for cut in cuts]
    for cut, first, end in zip(cuts, rows, rows[1:], strict=False):
        for a in range(first, end, LIMITS.law_rows_per_piece):
            yield int(data.fold[cut]), a, min(a + LIMITS.law_rows_per_piece, end)


def tangent_series(placed: LocatedLaw, data: MotionRecord, i: int, p: Array) -> Series:
    """(2, n) tangents of a law to x and v along place i, N/m and N s/m."""
    tangents = np.zeros((2, data.x.shape[1]), np.float32)
    _along(placed.effect, np.ascontiguousarray(p, dtype=np.float64), data, i, tangents)
    return tangents
