"""Regressors: one force per unit and its mean tangent for each parameter of the linear part and of a law."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion import linear_memory, shaft_law
from estimator.likelihood.motion.located_law import (
    LawAlongPath,
    LocatedLaw,
    law_along_record,
    own_response,
    tangent_series,
)
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.thresholds import LIMITS
from estimator.parallel import map_threads

from .fluctuation import Fluctuation

T = TypeVar("T")


def regressors(placed: LocatedLaw, data: MotionRecord, lin: Array, linear_only: bool = False) -> list[Regressor]:
    """Regressors of a law, one per free parameter; none for a law that is zero along the record.

    The regressor of a linear parameter is the force per unit, that of a searched parameter a central difference.
    lin : (places, 3) m, kL, c. linear_only : whether to leave out searched parameters.
    """

    def law(i: int, p: Array) -> LawAlongPath:
        return law_along_record(placed, data, i, lin, p)

    responding = placed.effect.kind in ("memory", "shaft")
    at = _once(law) if responding else law
    free = [k for k, q in enumerate(placed.effect.parameters) if placed.free[k] and (q.linear or not linear_only)]
    if placed.effect.kind == "shaft":  # integrated anew for every one of them
        caps = {shaft_law.first_of_direction(data, i) for i in placed.at}
        map_threads(lambda ask: at(*ask), [(i, p) for k in free for p, _ in _ends(placed, k, data) for i in caps])
    out = []
    for k in free:
        q = placed.effect.parameters[k]
        series: dict[int, NDArray[Any]] = {}
        memory: dict[int, Complexes] = {}
        slopes = np.zeros((len(data.places), len(data.places), 2))
        ends = _ends(placed, k, data)
        for i in placed.at:
            made = [
                at(shaft_law.first_of_direction(data, i) if placed.effect.kind == "shaft" else i, p) for p, _ in ends
            ]
            series[i] = _summed(f if w == 1.0 else w * f for (_, w), (f, _, _) in zip(ends, made, strict=True))
            slopes[i] = _summed(w * s for (_, w), (_, s, _) in zip(ends, made, strict=True))
            if responding:
                memory[i] = _summed(w * m for (_, w), (_, _, m) in zip(ends, made, strict=True) if m is not None)
        rms = float(np.sqrt(np.mean([np.dot(z, z) / z.size for z in series.values()])))
        if rms == 0.0:
            continue  # of a law that is still zero, or that the motion does not reach
        out.append(
            in_single_precision(
                Regressor(
                    name=placed.name(k),
                    unit=q.unit,
                    series=series,
                    tangent=slopes,
                    scale=1.0 / rms,
                    memory=memory,
                )  # fmt: skip
            )
        )
    return out


def with_second_order(
    made: list[Regressor], placed: LocatedLaw, fluctuations: Sequence[Fluctuation | None]
) -> list[Regressor]:
    """Regressors of a law with the second-order correction of their mean response. fluctuations : by place."""
    if placed.effect.kind != "force" or not any(fluctuations[i] for i in placed.at):
        return made
    numbers = {placed.name(k): k for k in range(len(placed.effect.parameters))}
    out = []
    for term in made:
        memory, k = dict(term.memory), numbers[term.name]
        for i in placed.at:
            if (here := fluctuations[i]) is not None:
                ends = _ends(placed, k, here.data)
                own = here.of(_summed(w * tangent_series(placed, here.data, i, p) for p, w in ends))
                memory[i] = memory.get(i, 0.0) - own_response(own, i, here.data)
        out.append(replace(term, memory=memory))
    return out


def block_tangents(placed: LocatedLaw, k: int, data: MotionRecord, i: int) -> Array:
    """(blocks, 2) mean tangents of each block to x and v of place i, per unit of parameter k of a memoryless law."""
    tangents = np.asarray(_summed(w * tangent_series(placed, data, i, p) for p, w in _ends(placed, k, data)))
    return np.asarray(tangents.reshape(2, data.blocks, -1).mean(axis=2, dtype=np.float64).T)


def _once(found: Callable[[int, Array], T]) -> Callable[[int, Array], T]:
    """The function `found` with a cache by place and parameters."""
    known: dict[tuple[int, bytes], T] = {}

    def at(i: int, p: Array) -> T:
        key = i, p.tobytes()
        if key not in known:
            known[key] = found(i, p)
        return known[key]

    return at


def _ends(placed: LocatedLaw, k: int, data: MotionRecord) -> list[tuple[Array, float]]:
    """Parameter vectors and weights whose sum of forces is the force per unit of parameter k."""
    parameters = placed.effect.parameters
    if placed.effect.kind == "shaft" and data.disc is not None:  # linear in the first order only: it moves the disc
        near = LIMITS.shaft_step_rel * data.disc.K * np.eye(placed.p.size)[k]
        if np.abs(placed.p).max() <= near[k]:  # on trial
            return [(near, 1.0 / near[k])]
        return [(placed.p + near, 0.5 / near[k]), (placed.p - near, -0.5 / near[k])]
    if parameters[k].linear:
        p = np.where([q.linear for q in parameters], 0.0, placed.p)
        p[k] = 1.0
        return [(p, 1.0)]
    amplitudes = [j for j, q in enumerate(parameters) if q.linear]
    if placed.effect.kind == "memory" and len(amplitudes) == 1:
        # one force is that of the amplitude; a column need not be the derivative to give no bias
        unit, a, step = (
            _ends(placed, amplitudes[0], data)[0][0],
            placed.p[amplitudes[0]],
            LIMITS.min_searched_step_rel * abs(placed.p[k]),
        )
        up = unit.copy()
        up[k] += step
        return [(up, a / step), (unit, -a / step)]
    step = 1e-3 * max(parameter_scale(placed, k, data), 1e-12)
    up, down = placed.p.copy(), placed.p.copy()
    up[k] += step
    down[k] -= step
    return [(up, 0.5 / step), (down, -0.5 / step)]


def parameter_scale(placed: LocatedLaw, k: int, data: MotionRecord) -> float:
    """Scale of a searched parameter: its own size, or the change of a shaft order that turns the end by a radian."""
    if placed.effect.parameters[k].scale == "bpfo":
        return 1.0 / max(float(data.phase[-1]), 1.0)
    return float(abs(placed.p[k]))


def _summed(parts: Iterator[Any]) -> Any:
    """Sum of the parts, in the memory of the first."""
    total = next(parts)
    for part in parts:
        total += part
    return total


def in_single_precision(term: Regressor) -> Regressor:
    """The regressor with its own series in single precision if that can hold it; views of the record stay."""
    if term.scale > 1.0 / LIMITS.min_single_rms:
        return term
    return replace(
        term, series={i: z if z.base is not None else z.astype(np.float32, copy=False) for i, z in term.series.items()}
    )


@dataclass(frozen=True, slots=True)
class Span:
    """Span of the base regressors at one place, each scaled to rms 1.

    base : the k regressors. part : (k, n / projection_stride) every so manyth sample. gram : (k, k) of part.
    slopes : (k, places, 2) mean tangents. memory : (k, places, bins) mean responses, see Regressor; None if all are
    zero.
    """

    base: tuple[Regressor, ...]
    part: NDArray[np.float32]
    gram: Array
    slopes: Array
    _: KW_ONLY
    memory: Complexes | None


def span_at(base: Sequence[Regressor], i: int) -> Span:
    """Span of the base regressors at place i, without a mass: its response is no tangent."""
    spanning = tuple(b for b in base if i in b.series and b.mass_at is None)
    part = np.stack([(b.series[i][:: LIMITS.projection_stride] * b.scale).astype(np.float32) for b in spanning])
    wide = part.astype(np.float64)
    more = next((b.memory[i] for b in spanning if i in b.memory), None)
    memory = None if more is None else np.stack([b.memory.get(i, 0.0 * more) * b.scale for b in spanning])
    slopes = np.stack([b.tangent[i] * b.scale for b in spanning])
    return Span(base=spanning, part=part, gram=wide @ wide.T, slopes=slopes, memory=memory)


class Spans:
    """Span of the base regressors at every place, made on demand."""

    def __init__(self, base: Sequence[Regressor]) -> None:
        self._base, self._made = base, dict[int, Span]()

    def __getitem__(self, i: int) -> Span:
        if i not in self._made:
            self._made[i] = span_at(self._base, i)
        return self._made[i]


def orthogonalised(term: Regressor, spans: Spans) -> Regressor | None:
    """The regressor less its projection on the base, series and tangent alike.

    The likelihood is the same function of the new parameter; nearly equal regressors keep their difference in single
    precision. None if less than `min_independent_rms_rel` of the rms is left.
    """
    series, slopes, memory = {}, term.tangent.copy(), dict(term.memory)
    before = after = 0.0
    for i, z in term.series.items():
        base = spans[i]
        weights = np.linalg.lstsq(base.gram, base.part @ z[:: LIMITS.projection_stride], rcond=1e-10)[0]
        rest = z.astype(np.float64)
        for weight, b in zip(weights, base.base, strict=True):
            rest -= weight * b.scale * b.series[i]
        slopes[i] -= np.tensordot(weights, base.slopes, 1)
        if base.memory is not None:
            memory[i] = np.asarray(memory.get(i, 0.0) - np.tensordot(weights, base.memory, 1), np.complex128)
        series[i] = rest
        before += float(z @ z)
        after += float(rest @ rest)
    if not after > LIMITS.min_independent_rms_rel**2 * before:
        return None
    n = next(iter(series.values())).size
    return replace(
        term,
        series=series,
        tangent=slopes,
        memory=memory,
        scale=1.0 / float(np.sqrt(after / len(series) / n)),
    )


def linear_regressors(data: MotionRecord, i: int, lin: Array, uses: Sequence[LocatedLaw] = ()) -> list[Regressor]:
    """Regressors of kL, c and a free mass at place i, but for those that are held.

    lin : (3,) m, kL, c. uses : laws; a pedestal responds to kL and c too.
    """
    P = len(data.places)
    out = []
    for which, (name, unit, z) in enumerate((("kL", "N/m", data.x[i]), ("c", "N s/m", data.v[i]))):
        if f"{data.places[i]}.{name}" in data.held:
            continue
        slope = np.zeros((P, P, 2))
        slope[i, i, which] = 1.0
        series, memory = z, dict[int, Complexes]()
        for use in uses:
            own = i in use.at and use.effect.kind == "memory"
            if own and (more := linear_memory.response_derivative(use.effect, use.p, lin, 1 + which)) is not None:
                series = (series + linear_memory.filtered_series(more, data.x[i], data.rate_hz)).astype(z.dtype)
                memory[i] = memory.get(i, 0.0) + own_response(more(2 * np.pi * data.f_hz), i, data)
        rms = max(float(data.rms[which, i]), 1e-300)
        out.append(
            Regressor(
                name=f"{data.places[i]}.{name}",
                unit=unit,
                series={i: series},
                tangent=slope,
                scale=1.0 / rms,
                memory=memory,
            )  # fmt: skip
        )
    if (a := data.free_inertia.get(i)) is not None:
        scale = 1.0 / max(float(data.rms[2, i]), 1e-300)
        out.append(Regressor(f"{data.places[i]}.m", "kg", {i: a}, np.zeros((P, P, 2)), scale=scale, mass_at=i))
    return out


@dataclass(frozen=True, slots=True)
class Regressor:
    """Force per unit of one parameter along the record, and its mean tangent.

    name : "bearing1.x.kL" ... unit : of the parameter. series : by place index, (n,) N per unit.
    tangent : (places, places, 2) mean derivative of the force at place i by x and v of place l, per unit.
    scale : the parameter is multiplied by 1 / scale in the computation, so that the rms of its force is 1.
    memory : by place index, (places, bins) N/m per unit, further mean response of the force to the displacement of
    every place: of a law with memory or through the disc, and the second-order correction.
    shape : (bins,) factor of the spectra of the series; None is 1.
    mass_at : index of the place whose mass the parameter is; None for any other parameter.
    """

    name: str
    unit: str
    series: dict[int, NDArray[Any]]
    tangent: Array
    _: KW_ONLY
    scale: float = 1.0
    memory: dict[int, Complexes] = field(default_factory=dict)
    shape: Complexes | None = None
    mass_at: int | None = None


def tangent_response(tangent: Array, s: Complexes) -> Complexes:
    """(..., bins) kg, response of a mean tangent (..., 2) to acceleration at s = i w (bins,) rad/s."""
    return np.asarray(tangent[..., :1] / s**2 + tangent[..., 1:] / s)


def regressor_response(term: Regressor, s: Complexes) -> Complexes:
    """(places, places, bins) kg, response of one scaled unit of a regressor to acceleration at s = i w (bins,)."""
    out = tangent_response(term.tangent, s)
    for i, more in term.memory.items():
        out[i] += more / s**2
    if term.mass_at is not None:
        out[term.mass_at, term.mass_at] += 1.0
    return out * term.scale
