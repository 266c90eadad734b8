"""The force of a law along the measured motion, as the estimator needs it: smoothed over what the band leaves out.

The true displacement is the band-limited one plus an out-of-band remainder e, small, Gaussian and independent of it.
What the in-band force sees of a law phi is then E_e[phi(x + e)], and its mean tangent is E_e[phi'(x + e)]. A three-
point Gauss-Hermite rule gives both: nodes at -h, 0, +h with h = sqrt(3) sd(e), weights 1/6, 2/3, 1/6; the derivative
is the central difference over the same nodes (Stein's identity), so a jump such as sgn(v) gets its density term.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .effect import Effect
from .effects.compiled import address, call_force, memory_array

Floats = NDArray[np.float64]
NEAREST = 0.02  # least smoothing, in standard deviations of the state: a step needs some width to have a derivative


@njit(cache=True, error_model="numpy", nogil=True)
def _smoothed(law, p, x, v, xo, vo, t, phase, s, valid, h, out, sums):  # type: ignore[no-untyped-def]
    """Fill out (n,); add to sums (4,) the tangents along x, v, xo, vo over the valid rows. h (4,): 0 leaves out."""
    for i in range(x.size):
        if not valid[i]:
            out[i] = 0.0
            continue
        f = call_force(law, x[i], v[i], xo[i], vo[i], t[i], phase[i], s, p)
        y = f
        if h[0] > 0.0:
            a = call_force(law, x[i] + h[0], v[i], xo[i], vo[i], t[i], phase[i], s, p)
            b = call_force(law, x[i] - h[0], v[i], xo[i], vo[i], t[i], phase[i], s, p)
            y += (a + b - 2.0 * f) / 6.0
            sums[0] += (a - b) / (2.0 * h[0])
        if h[1] > 0.0:
            a = call_force(law, x[i], v[i] + h[1], xo[i], vo[i], t[i], phase[i], s, p)
            b = call_force(law, x[i], v[i] - h[1], xo[i], vo[i], t[i], phase[i], s, p)
            y += (a + b - 2.0 * f) / 6.0
            sums[1] += (a - b) / (2.0 * h[1])
        if h[2] > 0.0:
            a = call_force(law, x[i], v[i], xo[i] + h[2], vo[i], t[i], phase[i], s, p)
            b = call_force(law, x[i], v[i], xo[i] - h[2], vo[i], t[i], phase[i], s, p)
            y += (a + b - 2.0 * f) / 6.0
            sums[2] += (a - b) / (2.0 * h[2])
        if h[3] > 0.0:
            a = call_force(law, x[i], v[i], xo[i], vo[i] + h[3], t[i], phase[i], s, p)
            b = call_force(law, x[i], v[i], xo[i], vo[i] - h[3], t[i], phase[i], s, p)
            y += (a + b - 2.0 * f) / 6.0
            sums[3] += (a - b) / (2.0 * h[3])
        out[i] = y


@dataclass(frozen=True, slots=True)
class State:
    """What a law is evaluated on: (n,) arrays at one place, and the widths of the smoothing.

    x, v, xo, vo : m and m/s (zeros where there is no other direction); t : s; phase : rad; s : +1 in x, -1 in y.
    h : (4,) half-widths for x, v, xo, vo. valid : (n,) bool.
    """

    x: Floats
    v: Floats
    xo: Floats
    vo: Floats
    t: Floats
    phase: Floats
    s: float
    h: Floats
    valid: NDArray[np.bool_]


def depends(effect: Effect, p: Floats, scale: Floats) -> NDArray[np.bool_]:
    """(4,) whether the law reads x, v, xo, vo, by trying 64 states of rms `scale` (4,)."""
    from .effects.compiled import force_array

    rng = np.random.default_rng(0)
    z = rng.normal(size=(4, 64)) * scale[:, None] * 2.0
    t, phase = rng.uniform(0, 10, 64), rng.uniform(0, 2 * np.pi, 64)
    reads = np.zeros(4, bool)
    base = force_array(effect, p, z[0], z[1], z[2], z[3], t, phase)
    for k in range(4):
        other = z.copy()
        other[k] = rng.normal(size=64) * scale[k] * 2.0
        reads[k] = not np.array_equal(base, force_array(effect, p, other[0], other[1], other[2], other[3], t, phase))
    return reads


def law_force(effect: Effect, p: Floats, state: State, reads: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """(n,) smoothed force in N, 0 on invalid rows, and (4,) sums of its tangents over the valid rows."""
    out, sums = np.empty_like(state.x), np.zeros(4)
    h = np.where(reads, state.h, 0.0)
    law: Any = np.uint64(address(effect.force))
    columns = (state.x, state.v, state.xo, state.vo, state.t, state.phase)
    _smoothed(law, np.ascontiguousarray(p), *columns, state.s, state.valid, h, out, sums)
    return out, sums


__all__ = ["NEAREST", "State", "depends", "law_force", "memory_array"]
