"""A model as the arrays that the compiled stepping reads: matrices, effect table, force shaping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.effects.places import at, values
from estimator.errors import ModelError
from estimator.model.effect import Effect
from estimator.model.rig import CAP_DIRECTIONS, Model
from estimator.model.rotor import Assembly, assemble

from . import kernel as kernel

CHANNEL_KINDS = {
    "acceleration": kernel.CHANNEL_ACCELERATION,
    "velocity": kernel.CHANNEL_VELOCITY,
    "displacement": kernel.CHANNEL_DISPLACEMENT,
    "force": kernel.CHANNEL_FORCE,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ActingLaw:
    """A row of the effect table: one effect that acts in one direction at one location.

    effect : the effect. place : canonical location, such as "bearing1.x". p : (parameters,) values in SI units.
    where : (7,) kind of law, degree of freedom, those of cap 1 and cap 2, and the same three of the other direction;
    -1 where the rig has none. s : +1 in x, -1 in y. lin : mass kg, kL N/m, c N s/m of the cap, which laws with memory
    read; 0 for laws of the disc and the shaft.
    """

    effect: Effect
    place: str
    p: Array
    where: tuple[int, ...]
    s: float
    lin: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Plan:
    """A model as the stepping reads it.

    rig : matrices of the linear rotor. acting : rows of the effect table. channels : (channels, 2) kind and degree of
    freedom of each stepped channel. shapes : degree of freedom, spectral shape and its parameters of each force that
    is not white. correlation : two degrees of freedom and the correlation coefficient of their forces. sensors :
    channel number, sensor effect and its parameters.
    """

    rig: Assembly
    acting: tuple[ActingLaw, ...]
    channels: NDArray[np.int64]
    shapes: tuple[tuple[int, Callable[..., Array], Array], ...]
    _: KW_ONLY
    correlation: tuple[tuple[int, int, float], ...]
    sensors: tuple[tuple[int, Effect, Array], ...]


def simulation_plan(model: Model) -> Plan:
    """The plan of a model whose values are all given. Raises ModelError that names what is missing."""
    rig = assemble(model)
    acting: list[ActingLaw] = []
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
            elif effect.scope == "bearings":
                i, j = (rig.index(f"{n}.{place.split('.')[1]}") for n in model.bearings)
                correlation.append((i, j, float(p[0])))
            elif effect.kind == "excitation" and effect.shape is not None:
                shapes.append((rig.index(place), effect.shape, p))
            else:
                acting += _acting(effect, place, p, rig, model)
    stepped = [(CHANNEL_KINDS[c.kind], rig.index(c.place)) for c in model.channels if c.kind in CHANNEL_KINDS]
    return Plan(
        rig=rig,
        acting=tuple(acting),
        channels=np.array(stepped, dtype=np.int64).reshape(-1, 2),
        shapes=tuple(shapes),
        correlation=tuple(correlation),
        sensors=tuple(sensors),
    )


def _acting(effect: Effect, place: str, p: Array, rig: Assembly, model: Model) -> list[ActingLaw]:
    """The rows of the effect table of one effect at one location: one per direction of its force. p : its values."""
    node = place.split(".")[0]
    one = place.split(".")[1:] or [d for d in CAP_DIRECTIONS if any(dof.endswith("." + d) for dof in rig.dofs)]
    rows: list[ActingLaw] = []
    for d in one:
        other = "y" if d == "x" else "x"

        def dof(name: str) -> int:
            return rig.dofs.index(name) if name in rig.dofs else -1

        s = 1.0 if d == "x" else -1.0
        if effect.kind in ("disc", "shaft"):
            ends = model.bearings if effect.kind == "shaft" else ("", "")
            here, across = ([dof(f"{n}.{along}") for n in ends] for along in (d, other))
            caps = [*here, dof(f"{node}.{other}"), *across]
            code = kernel.LAW_SHAFT if effect.kind == "shaft" else kernel.LAW_FORCE
            where = (code, rig.index(f"{node}.{d}"), *caps)
            lin = (0.0, 0.0, 0.0)
        else:
            i = rig.index(f"{node}.{d}")
            code = kernel.LAW_MEMORY if effect.kind == "memory" else kernel.LAW_FORCE
            where = (code, i, -1, -1, dof(f"{node}.{other}"), -1, -1)
            linear = model.linear[f"{node}.{d}"]
            mass = model.cap_mass(f"{node}.{d}") or 0.0
            lin = (mass, float(linear["kL"].value or 0.0), float(linear["c"].value or 0.0))
        rows.append(ActingLaw(effect=effect, place=place, p=p, where=where, s=s, lin=lin))
    return rows


EffectTable = tuple[
    NDArray[np.uint64], NDArray[np.uint64], NDArray[np.uintp], NDArray[np.uintp], NDArray[np.uintp], Array
]


def effect_table(acting: tuple[ActingLaw, ...], dofs: int) -> tuple[EffectTable, int, tuple[Array, Array]]:
    """The effect table of the kernels, the number of memory states, and the arrays that the table points into.

    Laws are compiled here, at first use. The arrays must outlive the table. dofs : number of degrees of freedom.
    """
    from estimator.effects.engine.compiled import address

    n, states = len(acting), 0
    width = max((a.p.size for a in acting), default=0) or 1
    law, law2 = np.zeros(n, dtype=np.uint64), np.zeros(n, dtype=np.uint64)
    P, lin = np.zeros((n, width)), np.zeros((n, 3))
    where = np.zeros((n, 8), dtype=np.uintp)
    for k, a in enumerate(acting):
        if a.effect.kind == "memory":
            if a.effect.rates is None or a.effect.memory_force is None:
                raise ModelError(f"effect {a.effect.name}: a memory effect needs rates and memory_force")
            law[k], law2[k] = address(a.effect.memory_force, "memory"), address(a.effect.rates, "rates")
        elif a.effect.force is not None:
            law[k] = address(a.effect.force)
        else:
            raise ModelError(f"effect {a.effect.name} (kind {a.effect.kind}) has no law to simulate")
        P[k, : a.p.size], lin[k] = a.p, a.lin
        where[k, 0] = a.where[0]
        where[k, 1:7] = [i if i >= 0 else dofs for i in a.where[1:]]
        where[k, 7] = states
        states += a.effect.states if a.effect.kind == "memory" else 0
    sign = np.array([a.s for a in acting], dtype=np.float64)
    at = np.arange(n, dtype=np.uintp) * np.uintp(8)
    p = np.uintp(P.ctypes.data) + at * np.uintp(width)
    lin_at = np.uintp(lin.ctypes.data) + at * np.uintp(3)
    return (law, law2, p, lin_at, where, sign), states, (P, lin)
