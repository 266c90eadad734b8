"""A model as the arrays that the compiled stepping reads: matrices, effect table, force shaping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import simulate_kernel as kernel
from .effect import Effect
from .effects import CATALOGUE
from .effects.places import at, values
from .errors import ModelError
from .model import DIRECTIONS, NODES, EffectUse, Model
from .rotor import Array, Assembly, assemble

KINDS = {
    "acceleration": kernel.ACCELERATION,
    "velocity": kernel.VELOCITY,
    "displacement": kernel.DISPLACEMENT,
    "force": kernel.EXCITATION,
}


@dataclass(frozen=True, slots=True)
class Acting:
    """One effect at one canonical place. where : (7,) as in simulate_kernel.effect_forces, s : +1 in x, -1 in y."""

    effect: Effect
    place: str
    p: Array
    where: tuple[int, ...]
    s: float
    lin: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything the stepping needs. channels : (c, 2) kind and degree of freedom of each stepped channel."""

    rig: Assembly
    block: NDArray[np.int64]
    acting: tuple[Acting, ...]
    channels: NDArray[np.int64]
    shapes: tuple[tuple[int, Callable[..., Array], Array], ...]  # (dof, shape, p) of coloured forces
    correlation: tuple[tuple[int, int, float], ...]  # (dof, dof, coefficient)
    sensors: tuple[tuple[int, Effect, Array], ...]  # (channel number, effect, p)


def effect_of(use: EffectUse) -> Effect:
    """The effect that a use names: of the catalogue, or the user's own."""
    if use.custom is not None:
        from .effects.custom import custom_effect

        return custom_effect(use)
    if use.name not in CATALOGUE:
        raise ModelError(f"no effect {use.name!r} in the catalogue: see `rotorscope effects`, or use [[model.custom]]")
    return CATALOGUE[use.name]


def build(model: Model) -> Plan:
    """The plan of a model with every value given. Raises ModelError naming what is missing."""
    rig = assemble(model)
    acting: list[Acting] = []
    shapes: list[tuple[int, Callable[..., Array], Array]] = []
    correlation: list[tuple[int, int, float]] = []
    sensors: list[tuple[int, Effect, Array]] = []
    for use in model.effects:
        effect = effect_of(use)
        for place in at(effect, use, model):
            p = values(effect, use, model, place)
            if effect.kind == "sensor":
                hit = [i for i, c in enumerate(model.channels) if c.place == place and c.kind not in ("force", "tacho")]
                sensors += [(i, effect, p) for i in hit]
            elif effect.name == "correlated_force":
                i, j = (rig.index(f"{n}.{place.split('.')[1]}") for n in NODES)
                correlation.append((i, j, float(p[0])))
            elif effect.kind == "excitation" and effect.shape is not None:
                shapes.append((rig.index(place), effect.shape, p))
            else:
                acting += _acting(effect, place, p, rig, model)
    blocks = [[i for i, dof in enumerate(rig.dofs) if dof.endswith("." + d)] for d in DIRECTIONS]
    block = np.array([[b[0], b[-1] + 1] for b in blocks for _ in b], dtype=np.int64)
    stepped = [(KINDS[c.kind], rig.index(c.place)) for c in model.channels if c.kind in KINDS]
    return Plan(
        rig,
        block,
        tuple(acting),
        np.array(stepped, dtype=np.int64).reshape(-1, 2),
        tuple(shapes),
        tuple(correlation),
        tuple(sensors),
    )


def _acting(effect: Effect, place: str, p: Array, rig: Assembly, model: Model) -> list[Acting]:
    """The rows of the effect table of one effect at one place: one per direction that it pushes in."""
    node = place.split(".")[0]
    one = place.split(".")[1:] or [d for d in DIRECTIONS if any(dof.endswith("." + d) for dof in rig.dofs)]
    rows: list[Acting] = []
    for d in one:
        other = "y" if d == "x" else "x"

        def dof(name: str) -> int:
            return rig.dofs.index(name) if name in rig.dofs else -1

        s = 1.0 if d == "x" else -1.0
        if effect.kind in ("disc", "shaft"):
            caps = [dof(f"{n}.{d}") for n in NODES] + [dof(f"disc.{other}")] + [dof(f"{n}.{other}") for n in NODES]
            code = kernel.SHAFT if effect.kind == "shaft" else kernel.FORCE
            where = (code, rig.index(f"disc.{d}"), *caps)
            lin = (0.0, 0.0, 0.0)
        else:
            i = rig.index(f"{node}.{d}")
            code = kernel.MEMORY if effect.kind == "memory" else kernel.FORCE
            where = (code, i, -1, -1, dof(f"{node}.{other}"), -1, -1)
            linear = model.linear[f"{node}.{d}"]
            lin = (float(rig.M[i, i]), float(linear["kL"].value or 0.0), float(linear["c"].value or 0.0))
        rows.append(Acting(effect, place, p, where, s, lin))
    return rows


@dataclass(frozen=True, slots=True)
class Table:
    """The effect table as arrays, in the argument order of the kernels."""

    law: NDArray[np.uint64]
    law2: NDArray[np.uint64]
    where: NDArray[np.int64]
    sign: Array
    P: Array
    lin: Array
    zat: NDArray[np.int64]

    @property
    def arguments(self) -> tuple[NDArray[np.generic], ...]:
        return self.law, self.law2, self.where, self.sign, self.P, self.lin, self.zat


def table(acting: tuple[Acting, ...]) -> Table:
    """The compiled effect table; laws are compiled here, on first use."""
    from .effects.compiled import address

    n = len(acting)
    width = max((a.p.size for a in acting), default=0) or 1
    law, law2 = np.zeros(n, dtype=np.uint64), np.zeros(n, dtype=np.uint64)
    P, zat = np.zeros((n, width)), np.zeros(n + 1, dtype=np.int64)
    for k, a in enumerate(acting):
        if a.effect.kind == "memory":
            if a.effect.rates is None or a.effect.memory_force is None:
                raise ModelError(f"effect {a.effect.name}: a memory effect needs rates and memory_force")
            law[k], law2[k] = address(a.effect.memory_force, "memory"), address(a.effect.rates, "rates")
        elif a.effect.force is not None:
            law[k] = address(a.effect.force)
        else:
            raise ModelError(f"effect {a.effect.name} (kind {a.effect.kind}) has no law to simulate")
        P[k, : a.p.size] = a.p
        zat[k + 1] = zat[k] + (a.effect.states if a.effect.kind == "memory" else 0)
    where = np.array([a.where for a in acting], dtype=np.int64).reshape(n, 7)
    lin = np.array([a.lin for a in acting], dtype=np.float64).reshape(n, 3)
    return Table(law, law2, where, np.array([a.s for a in acting], dtype=np.float64), P, lin, zat)
