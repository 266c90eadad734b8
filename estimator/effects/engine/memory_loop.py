"""A law with memory along a path as machine code: its force, its states, and their linearisation about the path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numba import njit
from numba.extending import overload

from estimator.arrays import Array, Series
from estimator.model.effect import Effect

from .compiled import rise
from .law_loop import source_version

DERIVATIVE_STEP_REL = 1e-7  # change of a state or of the motion over its largest value


@dataclass(frozen=True, slots=True)
class LinearisedMemory:
    """Linearisation of S states and of the force about a path of n rows.

    step : (n, S, S + 2) derivatives of the states' change over a step by the states before, the mean displacement and
    its rise. force : (n, S + 2) derivatives of the force by the states, x and v.
    """

    step: Array
    force: Array


def force_along_path(
    effect: Effect, p: Array, lin: Array, x: Series, v: Series, dt: float, start: Array, about: bool = True
) -> tuple[Array, Array, LinearisedMemory | None]:  # fmt: skip
    """Force (n,) N along a path (n,) from states `start` (S,), the states (n, S), and the linearisation if `about`."""
    if effect.rates is None or effect.memory_force is None:
        raise ValueError(f"{effect.name}: no memory law (kind {effect.kind})")
    n, S, rows = x.size, effect.states, x.size if about else 0
    out, states, step, force = np.empty(n), np.empty((n, S)), np.empty((rows, S, S + 2)), np.empty((rows, S + 2))
    states[0] = start
    size = np.array([*np.maximum(np.abs(start), np.abs(x).max()), np.abs(x).max(), np.abs(v).max()])
    small = DERIVATIVE_STEP_REL * np.maximum(size, 1e-300)
    law = _compiled(effect.rates, effect.memory_force, S)
    law(*(np.ascontiguousarray(z, dtype=np.float64) for z in (p, lin, x, v)), dt, small,
        np.array([True] * S + [*reads_motion(effect, p, lin)]), states, out, step, force)  # fmt: skip
    return out, states, LinearisedMemory(step, force) if about else None


def reads_motion(effect: Effect, p: Array, lin: Array) -> tuple[bool, bool]:
    """Whether a law with memory reads the displacement, and whether its force reads the velocity, by trial."""
    return _reads(effect, tuple(p.tolist()), tuple(lin.tolist()))


@lru_cache(maxsize=64)  # asked for every piece of a path
def _reads(effect: Effect, p: tuple[float, ...], lin: tuple[float, ...]) -> tuple[bool, bool]:
    if effect.rates is None or effect.memory_force is None:
        return False, False
    rng, S, x_read, v_read = np.random.default_rng(0), effect.states, False, False
    for scale in (*np.abs(p), 1.0):  # lengths of the law may be among its parameters
        z, x, v, more = scale * rng.normal(size=4)
        here, there = np.zeros((2, S))
        effect.rates(np.full(S, z), x, v, p, lin, here)
        effect.rates(np.full(S, z), x + more, v, p, lin, there)
        f, fx, fv = (effect.memory_force(np.full(S, z), *xv, p, lin) for xv in ((x, v), (x + more, v), (x, v + more)))
        x_read |= f != fx or not np.array_equal(here, there)
        v_read |= f != fv
    return x_read, v_read


@cache
def _compiled(rates: Callable[..., None], force: Callable[..., float], S: int) -> Callable[..., None]:
    """The compiled loop of `force_along_path` for one law, kept on disk: twice as fast as calls by address."""
    version = source_version(rates)  # belongs to what is kept on disk: a changed law is compiled anew
    exact = {"error_model": "numpy"}
    overload(rates, strict=False, jit_options=exact)(lambda z, x, v, p, lin, dz: rates)
    overload(force, strict=False, jit_options=exact)(lambda z, x, v, p, lin: force)
    one = "float64[::1]"

    @njit(
        f"void({', '.join([one] * 4)}, float64, {one}, boolean[::1], float64[:,::1], {one}, float64[:,:,::1], "
        "float64[:,::1])", cache=version >= 0, error_model="numpy", nogil=True,
    )  # fmt: skip
    def along(p, lin, x, v, dt, small, read, Z, out, step, tangent):  # type: ignore[no-untyped-def]
        z, after, half, d0, d1 = Z[0].copy(), np.zeros(S), np.zeros(S), np.zeros(S), np.zeros(S)
        changes = S + 2 if len(step) > 0 or version < -1 else 0
        rate = 1.0 / dt
        for i in range(x.size):
            last = i == x.size - 1
            mid = x[i] if last else 0.5 * (x[i] + x[i + 1])
            speed = v[i] if last else (x[i + 1] - x[i]) * rate
            for j in range(S):
                Z[i, j] = z[j]
            out[i] = force(z, x[i], v[i], p, lin)
            rates(z, mid, speed, p, lin, d0)
            for j in range(S):
                half[j] = z[j] + 0.5 * dt * d0[j]
            rates(half, mid, speed, p, lin, d1)
            for j in range(S):
                after[j] = z[j] + rise(d0[j], d1[j], dt, S == 1)
            for k in range(changes):  # a state, the displacement, the rise or the velocity
                dz, dx, dv = small[k] if k < S else 0.0, small[k] if k == S else 0.0, small[k] if k > S else 0.0
                up = small[S] if k > S else 0.0
                if k < S:
                    z[k] += dz
                tangent[i, k] = (force(z, x[i] + dx, v[i] + dv, p, lin) - out[i]) / small[k] if read[k] else 0.0
                if k != S or read[k]:
                    rates(z, mid + dx, speed + up * rate, p, lin, d0)
                    for j in range(S):
                        half[j] = z[j] + 0.5 * dt * d0[j]
                    rates(half, mid + dx, speed + up * rate, p, lin, d1)
                for j in range(S):
                    changed = z[j] + rise(d0[j], d1[j], dt, S == 1)
                    step[i, j, k] = (changed - after[j]) / (dz + dx + up) if k != S or read[k] else 0.0
                if k < S:
                    z[k] = Z[i, k]
            for j in range(S):
                z[j] = after[j]

    return along  # type: ignore[no-any-return]


def memory_array(effect: Effect, p: Array, lin: Array, x: Series, v: Series, rate_hz: float) -> Array:
    """(n,) N, the force of a memory effect along displacement and velocity, its states from rest.

    lin : (3,) m, kL, c of the place.
    """
    return force_along_path(effect, p, lin, x, v, 1.0 / rate_hz, np.zeros(effect.states), about=False)[0]
