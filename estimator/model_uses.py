"""A model's effects as they act on a record: starting values in SI, what is free, natural sizes from the data."""

from __future__ import annotations

import numpy as np

from .effect import Effect, EffectParameter
from .effects import CATALOGUE
from .effects.custom import effect_of
from .effects.places import at, kinematic, written
from .effects.strength import Size
from .model import Model
from .motion_blocks import MotionBlocks
from .periodic import PERIODIC
from .placed import Placed

FORCES = ("force", "memory", "shaft")  # kinds that act through the motion of the caps


def size(data: MotionBlocks, i: int, kL: float) -> Size:
    """Natural sizes at a place, measured."""
    return Size(
        x=float(data.rms[0, i]), v=float(data.rms[1, i]), m=float(data.mass[i]), kL=float(kL),
        a=float(data.rms[2, i]), rate_hz=data.rate_hz, band_hz=data.band[1],
    )  # fmt: skip


def stiffness(data: MotionBlocks, i: int) -> float:
    """N/m, first idea: E[v^2] / E[x^2] times the mass."""
    return float(data.mass[i] * np.mean(data.v[i] ** 2) / np.mean(data.x[i] ** 2))


def acting(effect: Effect, canonical: str, data: MotionBlocks) -> tuple[int, ...]:
    """Indices of the measured places that an effect at a canonical place acts on."""
    if effect.kind in ("shaft", "disc"):
        return tuple(range(len(data.places)))
    return tuple(i for i, p in enumerate(data.places) if p == canonical or p.split(".")[0] == canonical)


def searched(effect: Effect, model: Model) -> list[int]:
    """Numbers of the parameters that are searched: neither amplitudes, nor given, nor known from the geometry. A
    ball-pass order of the record is stepped with the rest: the phase of the amplitudes hangs on it."""
    return [
        k
        for k, q in enumerate(effect.parameters)
        if not q.linear and not q.given and (kinematic(q.scale, model) is None or _estimated(q, model))
    ]


def _estimated(q: EffectParameter, model: Model) -> bool:
    return q.scale == "bpfo" and model.order_found


def start(q: EffectParameter, natural: Size, model: Model) -> float:
    """SI value of a parameter that nothing is said about."""
    known = kinematic(q.scale, model)
    if known is not None:
        return known
    return 0.0 if q.linear else q.default * natural.of(q)


def placed_of(model: Model, data: MotionBlocks) -> list[Placed]:
    """The model's force effects at their places, with the rig file's values as start."""
    out = []
    for use in model.effects:
        effect = effect_of(use)
        if effect.kind not in FORCES or effect.name in PERIODIC:
            continue
        loose = set(searched(effect, model))
        for canonical in at(effect, use, model):
            where = acting(effect, canonical, data)
            if not where:
                continue
            settings = written(effect, use, model, canonical)
            natural = size(data, where[0], stiffness(data, where[0]))
            p = np.zeros(len(effect.parameters))
            free = []
            for k, q in enumerate(effect.parameters):
                s = settings.get(q.name)
                p[k] = s.value if s is not None and s.value is not None else start(q, natural, model)
                typed = s is not None and s.value is not None and not q.given  # of a kinematic number: it may slip
                free.append((q.linear or k in loose or typed) and not (s is not None and s.fixed))
            out.append(Placed(effect, f"{canonical}.{effect.name}", where, p, tuple(free)))
    return out


def on_trial(model: Model) -> list[Effect]:
    """What a diagnosis tries: the catalogue, and the laws of the user that are no part of the model yet."""
    return [*CATALOGUE.values(), *(effect_of(use) for use in model.candidates)]


def clipped(model: Model) -> frozenset[str]:
    """Places whose channel the model calls clipped."""
    named = {p for u in model.effects if u.name == "sensor_clipping" for p in u.parameters}
    return frozenset(p for p in model.places if p in named or p.split(".")[0] in named)
