"""An effect put at places of a record: its force, one column per parameter, and its mean tangent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .effect import Effect
from .effects.compiled import address, call_force, memory_array
from .features import depends
from .motion_blocks import MotionBlocks
from .path_fit import Term

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

    Along v every row counts: for a jump the sum is the crossing rate of this very path. Along x every eighth does.
    """
    n = x.size
    for i in range(n):
        out[i] = call_force(law, x[i], v[i], xo[i], vo[i], t[i], phase[i], s, p)
        if h[1] > 0.0:
            slopes[1] += call_force(law, x[i], v[i] + h[1], xo[i], vo[i], t[i], phase[i], s, p)
            slopes[1] -= call_force(law, x[i], v[i] - h[1], xo[i], vo[i], t[i], phase[i], s, p)
        if h[3] > 0.0:
            slopes[3] += call_force(law, x[i], v[i], xo[i], vo[i] + h[3], t[i], phase[i], s, p)
            slopes[3] -= call_force(law, x[i], v[i], xo[i], vo[i] - h[3], t[i], phase[i], s, p)
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
    rms = data.rms
    scale = np.array([rms[0, i], rms[1, i], 0.0 if o is None else rms[0, o], 0.0 if o is None else rms[1, o]])
    h = np.where(depends(effect, p, np.maximum(scale, 1e-300)), 0.07 * scale, 0.0)
    out, sums = np.empty(data.x.shape[1]), np.zeros(4)
    law = np.uint64(address(effect.force))
    _along(law, p, data.x[i], data.v[i], xo, vo, data.t, data.phase, data.sign(i), h, out, sums)
    slopes[i] += sums[:2]
    if o is not None:
        slopes[o] += sums[2:]
    return out, slopes, None


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


def terms(placed: Placed, data: MotionBlocks, lin: Array, linear_only: bool = False) -> list[Term]:
    """One column per free parameter: the force per unit for a linear one, a central difference for a searched one.

    lin : (places, 3) m, kL, c.
    """
    out = []
    linear = np.array([q.linear for q in placed.effect.parameters])
    for k, q in enumerate(placed.effect.parameters):
        if not placed.free[k] or (linear_only and not q.linear):
            continue
        series: dict[int, Array] = {}
        memory = None
        slopes = np.zeros((len(data.places), len(data.places), 2))
        for i in placed.at:
            if q.linear:
                p = np.where(linear, 0.0, placed.p)
                p[k] = 1.0
                series[i], slopes[i], memory = evaluate(placed, data, i, lin[i], p)
            else:
                step = (0.02 if placed.effect.kind == "memory" else 1e-3) * max(abs(placed.p[k]), 1e-12)
                up, down = placed.p.copy(), placed.p.copy()
                up[k] += step
                down[k] -= step
                fu, su, mu = evaluate(placed, data, i, lin[i], up)
                fd, sd, md = evaluate(placed, data, i, lin[i], down)
                series[i], slopes[i] = (fu - fd) / (2 * step), (su - sd) / (2 * step)
                memory = None if mu is None or md is None else (mu - md) / (2 * step)
        rms = max(float(np.sqrt(np.mean([z @ z / z.size for z in series.values()]))), 1e-300)
        out.append(Term(placed.name(k), q.unit, series, slopes, 1.0 / rms, memory))
    return out


def light(term: Term) -> Term:
    """The term for keeping: its own series in single precision, views of the record as they are."""
    return replace(term, series={i: z if z.base is not None else z.astype(np.float32) for i, z in term.series.items()})


@dataclass(frozen=True, slots=True)
class Span:
    """What the base terms span at one place: B (k, n) scaled to rms 1, their Gram matrix and tangents."""

    B: NDArray[np.float32]
    part: NDArray[np.float32]  # (k, n / STRIDE) of B
    gram: Array
    slopes: Array  # (k, places, 2)


@njit(cache=True, error_model="numpy", nogil=True)
def _less(z, B, weights):  # type: ignore[no-untyped-def]
    """z - weights @ B, (n,), in one pass, double precision."""
    out = np.empty(z.size)
    for i in range(z.size):
        total = z[i]
        for k in range(B.shape[0]):
            total -= weights[k] * B[k, i]
        out[i] = total
    return out


STRIDE = 4  # of the samples that the projection is computed from; it need not be exact, only subtracted exactly


def span(base: Sequence[Term], i: int) -> Span:
    """The base at place i."""
    own = [b for b in base if i in b.series]
    B = np.stack([(b.series[i] * b.scale).astype(np.float32) for b in own])
    part = np.ascontiguousarray(B[:, ::STRIDE])
    wide = part.astype(np.float64)
    return Span(B, part, wide @ wide.T, np.stack([b.tangent[i] * b.scale for b in own]))


class Spans:
    """The base's span at every place, made when it is first asked for."""

    def __init__(self, base: Sequence[Term]) -> None:
        self._base, self._made = base, dict[int, Span]()

    def __getitem__(self, i: int) -> Span:
        if i not in self._made:
            self._made[i] = span(self._base, i)
        return self._made[i]


def orthogonal(term: Term, spans: Spans, least: float = 1e-4) -> Term | None:
    """The term without what the base (by place) already explains there, series and tangent alike.

    The likelihood is the same function of the new parameter; what changes is that nearly equal columns keep their
    difference in single precision. None if less than `least` of its rms is left: the base says it all.
    """
    series, slopes = {}, term.tangent.copy()
    before = after = 0.0
    for i, z in term.series.items():
        base = spans[i]
        weights = np.linalg.lstsq(base.gram, base.part @ z[::STRIDE], rcond=1e-10)[0]
        rest = _less(z, base.B, weights)
        slopes[i] -= np.tensordot(weights, base.slopes, 1)
        series[i] = rest
        before += float(z @ z)
        after += float(rest @ rest)
    if not after > least**2 * before:
        return None
    n = next(iter(series.values())).size
    return replace(term, series=series, tangent=slopes, scale=1.0 / float(np.sqrt(after / len(series) / n)))


def linear_terms(data: MotionBlocks, i: int) -> list[Term]:
    """kL and c of a place."""
    P = len(data.places)
    out = []
    for which, (name, unit, z) in enumerate((("kL", "N/m", data.x[i]), ("c", "N s/m", data.v[i]))):
        slope = np.zeros((P, P, 2))
        slope[i, i, which] = 1.0
        out.append(Term(f"{data.places[i]}.{name}", unit, {i: z}, slope, 1.0 / max(float(z.std()), 1e-300)))
    return out
