"""A law along signals as machine code: one loop with the law and its neighbours to either side in a state.

What the three have in common, cos phi say, is computed once, and a law of products is vectorised. Every law has a loop
of its own, as a call of it for every sample takes several times as long. Arrays go in by address: a quarter of a second
to compile, a third of what numba's arrays need. Calls let go of the interpreter.
"""

from __future__ import annotations

import ctypes
import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from zlib import crc32

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.model.effect import Effect

from .compiled import machine_code

F, P = types.float64, types.CPointer(types.float64)
LOOP_SIGNATURE = F(P, P, P, P, P, P, F, F, F, F, F, P, types.CPointer(types.uint8), F, types.int64, P, P, types.int64)
LOOP_ARGUMENT_TYPES = {P: ctypes.c_void_p, types.CPointer(types.uint8): ctypes.c_void_p, F: ctypes.c_double,
                       types.int64: ctypes.c_int64}  # fmt: skip
LOOP_POINTER_TYPE = ctypes.CFUNCTYPE(ctypes.c_double, *(LOOP_ARGUMENT_TYPES[t] for t in LOOP_SIGNATURE.args))


@cache
def compiled(law: Callable[..., float]) -> Callable[..., float]:
    """The loop of a law. Raises ModelError for one that numba cannot compile."""
    version = source_version(law)  # belongs to what is kept on disk: a changed law is compiled anew
    # the bits are those of the law called for one sample; a long law called as a function would keep all from being
    # vectorised
    strict = {"error_model": "numpy", "fastmath": False, "forceinline": True}
    overload(law, strict=False, jit_options=strict)(lambda x, v, xo, vo, t, phase, s, p: law)

    def loop(  # type: ignore[no-untyped-def]
        x, v, xo, vo, t, phase, dx, dv, dxo, dvo, s, p, valid, weight, further, out, tangent, n
    ):  # fmt: skip
        total = 0.0
        for i in range(n if version >= -1 else 0):
            here = law(x[i], v[i], xo[i], vo[i], t[i], phase[i], s, p)
            up = law(x[i] + dx, v[i] + dv, xo[i] + dxo, vo[i] + dvo, t[i], phase[i], s, p)
            down = law(x[i] - dx, v[i] - dv, xo[i] - dxo, vo[i] - dvo, t[i], phase[i], s, p)
            out[i] = (out[i] if further else here) + (up + down - 2.0 * here) / 6.0
            tangent[i] = weight * (up - down)
            total += tangent[i] if valid[i] else 0.0
        return total

    return LOOP_POINTER_TYPE(
        machine_code(law, LOOP_SIGNATURE, loop, cache=version >= 0, fastmath={"reassoc", "contract"})
    )


def source_version(law: Callable[..., object]) -> int:
    """Checksum of the source of a law; -1 where no module holds the source, as for an expression."""
    module = sys.modules.get(law.__module__)
    try:
        held = law.__closure__ is not None or getattr(module, law.__name__, None) is law
        source = inspect.getsource(module) if module and held else ""
    except (OSError, TypeError):
        source = ""
    return crc32(source.encode()) if source else -1


def law_of(effect: Effect, p: Sequence[float] | Array) -> Callable[..., float]:
    """The force law of an effect. Raises ValueError if the effect has none."""
    if effect.force is None:
        raise ValueError(f"{effect.name}: no force law (kind {effect.kind})")
    return effect.force if effect.for_given is None else effect.for_given(p)


@dataclass(frozen=True, slots=True)
class Signals:
    """x, v, xo, vo, t, phase, (n,) each, float64 and contiguous, and valid (n,), with their addresses: to ask numpy for
    all of them takes longer than a law along 4096 rows."""

    arrays: tuple[NDArray[np.generic], ...]
    at: tuple[int, ...]

    @classmethod
    def of(cls, signals: Sequence[Array], valid: NDArray[np.bool_]) -> Signals:
        arrays = (*signals, np.ascontiguousarray(valid))
        return cls(arrays, tuple(z.ctypes.data for z in arrays))


def smoothed(
    law: Callable[..., float], p: Array, signals: Signals, k: int, h: float, s: float, out: Array, tangent: Array,
    further: bool = False,
) -> float:  # fmt: skip
    """Fill out (n,) with the mean of a law over the nodes -h, 0, +h in the k-th of x, v, xo, vo, weights 1/6, 2/3, 1/6;
    tangent (n,) with its central difference there, 0 where h is; return the sum of that over the valid rows. further :
    out already holds the mean over another state, to which this mean is added.

    All arrays are float64 and contiguous.
    """
    shift, (*at, valid) = [0.0] * 4, signals.at
    shift[k] = h
    return compiled(law)(
        *at, *shift, s, p.ctypes.data, valid, 0.5 / h if h else 0.0, further, out.ctypes.data, tangent.ctypes.data,
        out.size,
    )  # fmt: skip


def force_array(
    effect: Effect, p: Array, x: Array, v: Array | float = 0.0, xo: Array | float = 0.0, vo: Array | float = 0.0,
    t: Array | float = 0.0, phase: Array | float = 0.0, s: float = 1.0,
) -> Array:  # fmt: skip
    """(n,) N, the restoring force of an effect's law along signals; scalars are held. p : parameters in their order."""
    law, p = law_of(effect, p), np.ascontiguousarray(p, dtype=np.float64)
    x = np.ascontiguousarray(x, dtype=np.float64)
    held = (np.broadcast_to(np.asarray(a, np.float64), x.shape) for a in (v, xo, vo, t, phase))
    signals = Signals.of([x, *map(np.ascontiguousarray, held)], np.zeros(x.size, bool))
    out, spare = np.empty_like(x), np.empty_like(x)
    smoothed(law, p, signals, 0, 0.0, float(s), out, spare)
    return out
