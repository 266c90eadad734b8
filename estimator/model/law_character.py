"""Arguments that a force law depends on, and its power, found by evaluating the law at a few states.

The law is scalar and plain, so no compiler is needed. Each amplitude is 1 in turn, the others 0: the parts of
amplitudes of different units have any size. Searched parameters have their defaults. States reach four times beyond the
largest length and velocity among the parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from estimator.arrays import Array

from .thresholds import LIMITS

if TYPE_CHECKING:
    from .effect import EffectParameter

State = Literal["displacement", "velocity", "both", "directions", "time", "shaft_angle", "none"]
Force = Callable[..., float]


def law_state(force: Force, parameters: Sequence[EffectParameter], one_direction: bool) -> State:
    """The arguments that a force law is a function of. one_direction : judged with the other direction at rest."""
    depends = _dependence(force, tuple(parameters), one_direction)
    if "phase" in depends:
        return "shaft_angle"
    if "t" in depends:
        return "time"
    if depends & {"xo", "vo"}:
        return "directions"
    if {"x", "v"} <= depends:
        return "both"
    return "displacement" if "x" in depends else "velocity" if "v" in depends else "none"


def law_power(force: Force, parameters: Sequence[EffectParameter]) -> int | None:
    """Exponent n of a law that is an amplitude times x^n; None of any other law."""
    if len(parameters) != 1 or not parameters[0].linear or law_state(force, parameters, False) != "displacement":
        return None
    one, two = (_forces(force, parameters, np.eye(6)[:1] * x)[0, 0] for x in (1.0, 2.0))
    n = round(float(np.log2(two / one))) if one * two > 0.0 else 0
    states = _states(parameters, False)
    return n if n > 0 and _same(_forces(force, parameters, states)[:, 0], one * states[:, 0] ** n) else None


@cache
def _dependence(force: Force, parameters: tuple[EffectParameter, ...], one_direction: bool) -> frozenset[str]:
    """Names of the arguments that change the force."""
    states = _states(parameters, one_direction)
    shuffled = np.roll(states, 1, axis=0)
    here, found = _forces(force, parameters, states), set()
    for k, name in enumerate(("x", "v", "xo", "vo", "t", "phase")):
        moved = states.copy()
        moved[:, k] = shuffled[:, k]
        if not _same(here, _forces(force, parameters, moved)):
            found.add(name)
    return frozenset(found)


def _states(parameters: Sequence[EffectParameter], one_direction: bool) -> Array:
    """(n_states, 6) x, v, xo, vo in natural sizes or SI, as the parameters are; t in s; phase in rad."""
    lengths, speeds = (
        [abs(q.default) for q in parameters if not q.linear and q.unit == unit and q.default] for unit in ("m", "m/s")
    )
    x, v = 4.0 * max(lengths, default=2e-7), 4.0 * max(speeds, default=2e-3)
    across = (0.0, 0.0) if one_direction else (x, v)
    low = np.array([-x, -v, -across[0], -across[1], 0.0, 0.0])
    return np.random.default_rng(0).uniform(low, [x, v, *across, 60.0, 1000.0], (LIMITS.n_states, 6))


def _forces(force: Force, parameters: Sequence[EffectParameter], states: Array) -> Array:
    """(n, amplitudes) the parts of the law at states (n, 6) in direction x; NaN where plain arithmetic fails."""
    amplitudes = [k for k, q in enumerate(parameters) if q.linear] or [-1]

    def at_state(z: list[float], amplitude: int) -> float:
        p = [float(k == amplitude) if q.linear else q.default for k, q in enumerate(parameters)]
        try:
            return float(force(*z, 1.0, p))
        except (ArithmeticError, ValueError):
            return float("nan")

    return np.array([[at_state(z, k) for k in amplitudes] for z in states.tolist()])


def _same(a: Array, b: Array) -> bool:
    """Whether two series of forces, (n,) or (n, parts), are equal but for rounding, where both are finite."""
    finite = np.isfinite(a) & np.isfinite(b)
    a, b = np.where(finite, a, 0.0), np.where(finite, b, 0.0)
    largest = np.maximum(np.abs(a), np.abs(b)).max(axis=0)
    return bool(np.all(np.abs(a - b).max(axis=0) <= LIMITS.tolerance_rel * largest))
