"""Laws as machine code: every law gets one C signature, so one compiled kernel can call any of them by address.

That keeps start-up short: the kernels of simulations are compiled once and cached on disk whatever the model, a law of
the catalogue is cached beside its file, and only a user's own law is compiled anew (about 0.1 s).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from llvmlite import ir
from numba import cfunc, njit, types
from numba.core.errors import NumbaError, UnsupportedBytecodeError
from numba.extending import intrinsic

from estimator.errors import ModelError

F = types.float64
P = types.CPointer(F)
FORCE_SIGNATURE = F(F, F, F, F, F, F, F, P)  # x, v, xo, vo, t, phase, s, p
RATES_SIGNATURE = types.void(P, F, F, P, P, P)  # z, x, v, p, lin, dz
MEMORY_SIGNATURE = F(P, F, F, P, P)  # z, x, v, p, lin


@cache
def address(law: Callable[..., Any], kind: str = "force") -> int:
    """Address of a law compiled for `kind` force | rates | memory. Kept alive for the life of the process.

    Raises ModelError for a law that numba cannot compile.
    """
    signature = {"force": FORCE_SIGNATURE, "rates": RATES_SIGNATURE, "memory": MEMORY_SIGNATURE}[kind]
    on_disk = not law.__code__.co_filename.startswith("<")  # a law made from an expression has no file
    return machine_code(law, signature, law, cache=on_disk)


def machine_code(law: Callable[..., Any], signature: Any, function: Callable[..., Any], **options: Any) -> int:
    """Address of a C function of a signature from a function that calls a law, or the law itself. Kept alive.

    Raises ModelError for a law that numba cannot compile.
    """
    try:
        compiled = cfunc(signature, error_model="numpy", **options)(function)
    except (NumbaError, UnsupportedBytecodeError, TypeError) as error:
        why = str(error).strip().splitlines()
        said = next((line.strip() for line in why[1:] if line.strip()), why[0])
        raise ModelError(
            f"law {law.__name__} of {law.__code__.co_filename}: numba cannot compile it: {said}; "
            "write it with its arguments, numbers and the math module alone (docs/effects.md)"
        ) from error
    _KEPT_CODE.append(compiled)
    return int(compiled.address)


def ready() -> None:
    """Make numba load its libraries (0.3 s) by a call of one of its functions, compiled as all others are."""
    rise(1.0, 1.0, 1.0, True)


_KEPT_CODE: list[Any] = []  # the code lives as long as its object


def _caller(signature: Any, addresses: Sequence[int]) -> Any:
    """Argument types and code of an intrinsic that calls the function at an address (its first argument).

    addresses : pointers, given as integers: no view of an array is made and counted for every call.
    """
    args = [types.uintp if i in addresses else a for i, a in enumerate(signature.args)]

    def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        pointer = ir.DoubleType().as_pointer()
        low = [pointer if t == P else ir.DoubleType() for t in signature.args]
        void = signature.return_type == types.void
        kind = ir.FunctionType(ir.VoidType() if void else ir.DoubleType(), low)
        given = [builder.inttoptr(v, pointer) if i in addresses else v for i, v in enumerate(values[1:])]
        result = builder.call(builder.inttoptr(values[0], kind.as_pointer()), given)
        return context.get_dummy_value() if void else result

    return args, generate


_FORCE_AT_ARGS, _FORCE_AT_CODE = _caller(FORCE_SIGNATURE, (7,))
_RATES_AT_ARGS, _RATES_AT_CODE = _caller(RATES_SIGNATURE, (0, 3, 4, 5))
_MEMORY_AT_ARGS, _MEMORY_AT_CODE = _caller(MEMORY_SIGNATURE, (0, 3, 4))


@intrinsic
def call_force_at(typingctx, law, x, v, xo, vo, t, phase, s, p):  # type: ignore[no-untyped-def]
    return types.float64(types.uint64, *_FORCE_AT_ARGS), _FORCE_AT_CODE


@intrinsic
def call_rates_at(typingctx, law, z, x, v, p, lin, dz):  # type: ignore[no-untyped-def]
    return types.void(types.uint64, *_RATES_AT_ARGS), _RATES_AT_CODE


@intrinsic
def call_memory_at(typingctx, law, z, x, v, p, lin):  # type: ignore[no-untyped-def]
    return types.float64(types.uint64, *_MEMORY_AT_ARGS), _MEMORY_AT_CODE


@njit(cache=True, error_model="numpy", nogil=True)
def rise(start, half, dt, alone):  # type: ignore[no-untyped-def]
    """Increment of a state over a step, from its rates at the start and at half a step: the midpoint rule.

    alone : a single state. Where its rate falls it goes as exp(h), as the half step says: 1 / (1 - h/2 + h^2/12) is the
    mean of that, stable however fast. Value and slope are those of the midpoint rule at h = 0: derivatives of the step
    have no jump.
    """
    bend = half - start  # h / 2 of the start
    if not alone or bend * start >= 0.0:
        return dt * half
    return dt * start**3 / (start * start - start * bend + bend * bend / 3.0)
