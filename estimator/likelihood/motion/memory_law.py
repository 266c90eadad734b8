"""Forces with memory whose states obey nonlinear equations (Bouc-Wen): force along the motion, and mean response.

The states are integrated on a grid finer than the samples, with band-limited interpolation of the motion.

The likelihood needs the mean response <T(f)> of the force to an added small displacement. It is the average over small
steps of displacement that are launched all along the path. A regression of the force on the motion would be biased, as
the motion is not Gaussian.

The step responses follow from the states and the force linearised about the path.
Over a step of the grid the states change by A dZ + b (x0 + x1)/2 + d (x1 - x0), and the force by r dZ + s x + u v, for
a small change dZ of the states and a small motion x, v. All six are derivatives of the integrator itself, so what is
made of them is the derivative of the force that the path is given, kinks included.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from zlib import crc32

import numpy as np
from numba import njit
from numba.extending import overload

from estimator.arrays import Array, Complexes, Series
from estimator.effects.engine.compiled import rise
from estimator.model.effect import Effect

from .law_smoothing import MARGIN_ROWS, decimated, interpolated

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
    module = sys.modules.get(rates.__module__)
    try:
        source = inspect.getsource(module) if module else ""
    except (OSError, TypeError):
        source = ""
    version = crc32(source.encode())  # belongs to what is kept on disk: a changed law is compiled anew
    exact = {"error_model": "numpy"}
    overload(rates, strict=False, jit_options=exact)(lambda z, x, v, p, lin, dz: rates)
    overload(force, strict=False, jit_options=exact)(lambda z, x, v, p, lin: force)
    one = "float64[::1]"

    @njit(
        f"void({', '.join([one] * 4)}, float64, {one}, boolean[::1], float64[:,::1], {one}, float64[:,:,::1], "
        "float64[:,::1])", cache=bool(source), error_model="numpy", nogil=True,
    )  # fmt: skip
    def along(p, lin, x, v, dt, small, read, Z, out, step, tangent):  # type: ignore[no-untyped-def]
        z, after, half, d0, d1 = Z[0].copy(), np.zeros(S), np.zeros(S), np.zeros(S), np.zeros(S)
        changes = S + 2 if len(step) > 0 or version < 0 else 0
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


FINE_GRID_FACTOR = 2  # rate of the grid for the states over the sampling rate
ROWS_PER_PIECE = 1 << 13  # rows linearised at a time: they stay in the cache
MAX_PIECE_STRIDE, MIN_PIECES = 3, 40  # steps are launched in every so manyth piece, in at least so many pieces
MEMORY_CYCLES = 8.0  # of the motion, after which the response to a step has settled
STEPS_PER_CYCLE = 2.6  # launched, at changing phases of the motion
FOLLOWED_HALVINGS = 5  # every second step is followed for half of MEMORY_CYCLES, every fourth for a quarter, ...


@dataclass(frozen=True, slots=True)
class MeanResponse:
    """Mean response of a force to displacement.

    taps : (lags,) N/m, force per past displacement, dt apart. dt : s. tangent : N s/m, to velocity alone.
    """

    taps: Array
    dt: float
    tangent: float

    def at(self, f_hz: Array) -> Complexes:
        """(f,) N/m."""
        size = 1 << int(np.ceil(np.log2(8 * self.taps.size)))
        f, z = np.fft.rfftfreq(size, self.dt), np.fft.rfft(self.taps, size)
        return np.interp(f_hz, f, z.real) + 1j * (np.interp(f_hz, f, z.imag) + 2 * np.pi * f_hz * self.tangent)


def memory_force(
    effect: Effect, p: Array, lin: Array, x: Series, v: Series, rate_hz: float, mean: StepResponses | None = None
) -> Array:  # fmt: skip
    """Force (n,) N along a path, states from rest. lin : (3,) m, kL, c. mean : accumulates step responses; or None."""
    n, rate = x.size, FINE_GRID_FACTOR * rate_hz
    out, start = np.empty(n), np.zeros(effect.states)
    fast, stride = reads_motion(effect, p, lin)[1], min(max(n // ROWS_PER_PIECE // MIN_PIECES, 1), MAX_PIECE_STRIDE)
    for a in range(0, n, ROWS_PER_PIECE):
        b = min(a + ROWS_PER_PIECE, n)
        rows = np.clip(np.arange(a - MARGIN_ROWS, b + MARGIN_ROWS), 0, n - 1)
        fine = interpolated(x[rows], FINE_GRID_FACTOR)
        speed = interpolated(v[rows], FINE_GRID_FACTOR) if fast else np.zeros_like(fine)
        stepped = mean is not None and a // ROWS_PER_PIECE % stride == 0
        force, states, about = force_along_path(effect, p, lin, fine, speed, 1.0 / rate, start, stepped)
        start = states[(b - a) * FINE_GRID_FACTOR].copy()  # where the next piece begins
        out[a:b] = decimated(force, FINE_GRID_FACTOR)
        if mean is not None and about is not None:
            mean.add(about)
    return out


def memory_force_and_response(
    effect: Effect, p: Array, lin: Array, x: Series, v: Series, rate_hz: float
) -> tuple[Array, MeanResponse]:
    """Force (n,) N along a path, states from rest, and its mean response. lin : (3,) m, kL, c."""
    mean = StepResponses(x, v, 1.0 / (FINE_GRID_FACTOR * rate_hz))
    return memory_force(effect, p, lin, x, v, rate_hz, mean), mean.response()


class StepResponses:
    """Sums of step responses along a path x, v (any rate), on rows dt apart."""

    def __init__(self, x: Series, v: Series, dt: float) -> None:
        cycle = 2 * np.pi * float(np.sqrt(np.dot(x, x) / np.dot(v, v))) / dt  # rows
        self.dt, self.stride = dt, max(1, int(cycle / STEPS_PER_CYCLE))
        self.sums, self.counts = np.zeros((2, int(MEMORY_CYCLES * cycle) + 2))
        self.rows, self.tangent = 0, 0.0

    def add(self, about: LinearisedMemory) -> None:
        """Add the step responses along a piece of the path."""
        _launch(about.step, about.force, self.stride, FOLLOWED_HALVINGS, self.sums, self.counts)
        self.rows, self.tangent = self.rows + len(about.force), self.tangent + float(about.force[:, -1].sum())

    def response(self) -> MeanResponse:
        return MeanResponse(self.sums / np.maximum(self.counts, 1.0), self.dt, self.tangent / max(self.rows, 1))


@njit(cache=True, error_model="numpy", nogil=True)
def _launch(step, force, stride, halvings, sums, counts):  # type: ignore[no-untyped-def]
    """Add to sums (lags,) what displacement that rises by 1 over a step of the grid adds to the force from row to row,
    a rise every `stride` rows; to counts (lags,) how many there were."""
    n, S = step.shape[:2]
    z, after = np.zeros(S), np.zeros(S)
    number = 0
    for i in range(0, n - 1, stride):
        number += 1
        followed = 0  # how often 2 divides the number
        while followed < halvings and (number >> followed) % 2 == 0:
            followed += 1
        life = sums.size >> (halvings - followed)
        if i + 1 + life > n:
            continue
        for j in range(S):
            z[j] = step[i, j, S + 1] + 0.5 * step[i, j, S]
        before = 0.0
        for k in range(life):
            row = i + 1 + k
            f = force[row, S]
            for j in range(S):
                f += force[row, j] * z[j]
            sums[k] += f - before
            counts[k] += 1.0
            before = f
            for j in range(S):
                a = step[row, j, S]
                for other in range(S):
                    a += step[row, j, other] * z[other]
                after[j] = a
            for j in range(S):
                z[j] = after[j]
