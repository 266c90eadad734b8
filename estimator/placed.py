"""An effect put at places of a record: its force, its mean tangent, its tangent along the path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .effect import Effect
from .effects.compiled import address, call_force, force_array, memory_array
from .features import FINER, MARGIN, State, decimated, depends, jumps, law_force
from .motion_blocks import MotionBlocks

Array = NDArray[np.float64]
Evaluated = tuple[Array, Array, NDArray[np.complex128] | None]


@dataclass(frozen=True, slots=True)
class Placed:
    """An effect with parameters p (in declared order) shared by the places of index `at`; `key` heads their names."""

    effect: Effect
    key: str  # "bearing1.x.clearance"
    at: tuple[int, ...]
    p: Array
    free: tuple[bool, ...]

    def with_values(self, p: Array) -> Placed:
        return replace(self, p=p)

    def name(self, k: int) -> str:
        return f"{self.key}.{self.effect.parameters[k].name}"


@njit(cache=True, error_model="numpy", nogil=True)
def _along(law, p, x, v, xo, vo, t, phase, s, h, out, slopes):  # type: ignore[no-untyped-def]
    """Fill out (n,) with the law's force; slopes (4,) with its mean central differences over +-h along x, v, xo, vo.

    Along v every row counts, and the force is averaged over what the band leaves out of v (three points, features.py).
    Along x, of which little is left out, every eighth row is enough for the slope.
    """
    n = x.size
    for i in range(n):
        f = call_force(law, x[i], v[i], xo[i], vo[i], t[i], phase[i], s, p)
        y = f
        if h[1] > 0.0:
            up = call_force(law, x[i], v[i] + h[1], xo[i], vo[i], t[i], phase[i], s, p)
            down = call_force(law, x[i], v[i] - h[1], xo[i], vo[i], t[i], phase[i], s, p)
            slopes[1] += up - down
            y += (up + down - 2.0 * f) / 6.0
        if h[3] > 0.0:
            up = call_force(law, x[i], v[i], xo[i], vo[i] + h[3], t[i], phase[i], s, p)
            down = call_force(law, x[i], v[i], xo[i], vo[i] - h[3], t[i], phase[i], s, p)
            slopes[3] += up - down
            y += (up + down - 2.0 * f) / 6.0
        out[i] = y
    if h[0] > 0.0:
        for i in range(0, n, 8):
            slopes[0] += 8.0 * call_force(law, x[i] + h[0], v[i], xo[i], vo[i], t[i], phase[i], s, p)
            slopes[0] -= 8.0 * call_force(law, x[i] - h[0], v[i], xo[i], vo[i], t[i], phase[i], s, p)
    if h[2] > 0.0:
        for i in range(0, n, 8):
            slopes[2] += 8.0 * call_force(law, x[i], v[i], xo[i] + h[2], vo[i], t[i], phase[i], s, p)
            slopes[2] -= 8.0 * call_force(law, x[i], v[i], xo[i] - h[2], vo[i], t[i], phase[i], s, p)
    for k in range(4):
        if h[k] > 0.0:
            slopes[k] /= 2.0 * h[k] * n


def evaluate(placed: Placed, data: MotionBlocks, i: int, lin: Array, p: Array | None = None) -> Evaluated:
    """(n,) N of the effect at place i, (places, 2) its mean tangent to x_l and v_l of every place, and memory.

    lin : (3,) m, kL, c of the place. The tangent is averaged along the path, not under an assumed density: for a jump
    in v it is the Ito correction of this path.
    """
    p = np.ascontiguousarray(placed.p if p is None else p, dtype=np.float64)
    effect = placed.effect
    slopes = np.zeros((len(data.places), 2))
    if effect.kind == "memory":
        f = remember(effect, p, lin, data.x[i], data.v[i], data.rate_hz)
        return f, slopes, _memory_response(effect, data, i, lin, p, f)
    o = data.other(i)
    zero = np.zeros_like(data.x[i])
    xo, vo = (zero, zero) if o is None else (data.x[o], data.v[o])
    scale = data.sizes(i)
    reads = depends(effect, p, np.maximum(scale, 1e-300))
    if jumps(effect, p, scale):
        out, sums = _on_finer_grid(effect, p, data, i, reads)
        slopes[i] += sums[:2]
        if o is not None:
            slopes[o] += sums[2:]
        return out, slopes, None
    h = np.where(reads, [0.07, 0.0, 0.07, 0.0] * scale + [0.0, 1.0, 0.0, 1.0] * data.smoothing(i), 0.0)
    out, sums = np.empty(data.x.shape[1]), np.zeros(4)
    law = np.uint64(address(effect.force))
    _along(law, p, data.x[i], data.v[i], xo, vo, data.t, data.phase, data.sign(i), h, out, sums)
    slopes[i] += sums[:2]
    if o is not None:
        slopes[o] += sums[2:]
    return out, slopes, None


def _on_finer_grid(
    effect: Effect, p: Array, data: MotionBlocks, i: int, reads: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """(n,) N of a law with a jump, without its harmonics above Nyquist, which fold back if it is sampled; and (4,)."""
    o, n = data.other(i), data.x.shape[1]
    zero = np.zeros(n)
    xo, vo = (zero, zero) if o is None else (data.x[o], data.v[o])
    h, step = data.smoothing(i), 32 * data.block
    out, sums = np.empty(n), np.zeros(4)
    for a in range(0, n, step):
        b = min(a + step, n)
        rows = np.clip(np.arange(a - MARGIN, b + MARGIN), 0, n - 1)
        x, v, xs, vs, t, phase = (z[rows] for z in (data.x[i], data.v[i], xo, vo, data.t, data.phase))
        state = State(x, v, xs, vs, t, phase, data.sign(i), h, np.ones(rows.size, bool))
        force, part = law_force(effect, p, state.finer(), reads)
        out[a:b] = decimated(force)
        sums += part
    return out, sums / (FINER * n)


def tangent_series(placed: Placed, data: MotionBlocks, i: int, p: Array) -> Array:
    """(2, n) tangents of a law along x and v at place i, by the same differences as their means in `evaluate`."""
    effect, o = placed.effect, data.other(i)
    zero = np.zeros(data.x.shape[1])
    xo, vo = (zero, zero) if o is None else (data.x[o], data.v[o])
    scale = data.sizes(i)
    used = depends(effect, p, np.maximum(scale, 1e-300))
    out = np.zeros((2, data.x.shape[1]))
    for a in np.flatnonzero(used[:2]):
        h = data.smoothing(i)[1] if a == 1 else 0.07 * scale[0]
        ends = []
        for step in (h, -h):
            x, v = data.x[i] + (step if a == 0 else 0.0), data.v[i] + (step if a == 1 else 0.0)
            ends.append(force_array(effect, p, x, v, xo, vo, data.t, data.phase, data.sign(i)))
        out[a] = (ends[0] - ends[1]) / (2 * h)
    return out


def remember(effect: Effect, p: Array, lin: Array, x: Array, v: Array, rate_hz: float) -> Array:
    """(n,) N of a force with memory, its states integrated at four times the rate (slip is faster than the samples)."""
    fine = np.arange(4 * (x.size - 1) + 1) / 4.0
    rows = np.arange(x.size)
    return memory_array(effect, p, lin, np.interp(fine, rows, x), np.interp(fine, rows, v), 4.0 * rate_hz)[::4].copy()


def _memory_response(
    effect: Effect, data: MotionBlocks, i: int, lin: Array, p: Array, f: Array
) -> NDArray[np.complex128]:
    """(bins,) N/m mean linear response T(f) of a force with memory to a small added motion.

    A small white displacement e is added and the change of the force regressed on e passed through causal first-order
    lags: T = b0 + b1 i w + sum b_k i w / (i w + 1 / tau_k). It is what F and the force share under the model (Novikov),
    whatever the amplitude distribution.
    """
    n = min(data.x.shape[1], 1 << 17)
    x, v, f = data.x[i][:n], data.v[i][:n], f[:n]
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / data.rate_hz)
    spectrum = np.random.default_rng(1).standard_normal((2, w.size))
    inside = (w > 2 * np.pi * data.band[0] / 2) & (w < 2 * np.pi * data.band[1])
    e = np.where(inside, spectrum[0] + 1j * spectrum[1], 0.0) / np.sqrt(1 + (w / _peak(x, v)) ** 2)
    size = 0.05 * float(x.std()) / float(np.fft.irfft(e, n).std())
    e *= size
    df = remember(effect, p, lin, x + np.fft.irfft(e, n), v + np.fft.irfft(1j * w * e, n), data.rate_hz) - f
    taus = np.array([0.1, 0.4, 1.6, 6.4]) / _peak(x, v)

    def basis(w: NDArray[np.floating]) -> NDArray[np.complex128]:
        return np.stack([np.ones(w.size), 1j * w, *(1j * w / (1j * w + 1 / tau) for tau in taus)])

    skip = n // 20  # the two runs start alike
    B = np.stack([np.fft.irfft(b * e, n)[skip:] for b in basis(w)])
    d = np.sqrt(np.sum(B * B, axis=1))
    weights = np.linalg.lstsq((B @ B.T) / np.multiply.outer(d, d), (B @ df[skip:]) / d, rcond=1e-8)[0] / d
    return np.asarray(weights @ basis(2 * np.pi * data.f_hz))


def _peak(x: Array, v: Array) -> float:
    return float(v.std() / x.std())
