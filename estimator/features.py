"""The force of a law along the measured motion, as the estimator needs it: smoothed over what the band leaves out.

The true displacement is the band-limited one plus an out-of-band remainder e, small, Gaussian and independent of it.
What the in-band force sees of a law phi is then E_e[phi(x + e)], and its mean tangent is E_e[phi'(x + e)]. A three-
point Gauss-Hermite rule gives both: nodes at -h, 0, +h with h = sqrt(3) sd(e), weights 1/6, 2/3, 1/6; the derivative
is the central difference over the same nodes (Stein's identity), so a jump such as sgn(v) gets its density term.

A law with a jump or a kink has harmonics above the Nyquist frequency; sampled, they would fold back into the band. It
is evaluated on a grid finer by `FINER` and brought back through a low-pass filter.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .effect import Effect
from .effects.compiled import address, call_force, force_array

Floats = NDArray[np.float64]
NEAREST = 0.02  # least smoothing, in standard deviations of the state: a step needs some width to have a derivative
FINER = 4
HALF = 12  # half support of the interpolation, in samples of the coarse grid
MARGIN = 2 * HALF  # rows needed on either side of those that come out


@njit(cache=True, error_model="numpy", nogil=True)
def _smoothed(law, p, x, v, xo, vo, t, phase, s, valid, h, out, sums, kx, kv):  # type: ignore[no-untyped-def]
    """Fill out (n,); add to sums (4,) the tangents along x, v, xo, vo over the valid rows. h (4,): 0 leaves out.

    kx, kv : (n,) tangents along x and v, or arrays of no length.
    """
    series = kx.size > 0
    for i in range(x.size):
        f = call_force(law, x[i], v[i], xo[i], vo[i], t[i], phase[i], s, p)
        y = f
        if h[0] > 0.0:
            a = call_force(law, x[i] + h[0], v[i], xo[i], vo[i], t[i], phase[i], s, p)
            b = call_force(law, x[i] - h[0], v[i], xo[i], vo[i], t[i], phase[i], s, p)
            y += (a + b - 2.0 * f) / 6.0
            d = (a - b) / (2.0 * h[0])
            if valid[i]:
                sums[0] += d
            if series:
                kx[i] = d
        if h[1] > 0.0:
            a = call_force(law, x[i], v[i] + h[1], xo[i], vo[i], t[i], phase[i], s, p)
            b = call_force(law, x[i], v[i] - h[1], xo[i], vo[i], t[i], phase[i], s, p)
            y += (a + b - 2.0 * f) / 6.0
            d = (a - b) / (2.0 * h[1])
            if valid[i]:
                sums[1] += d
            if series:
                kv[i] = d
        if h[2] > 0.0:
            a = call_force(law, x[i], v[i], xo[i] + h[2], vo[i], t[i], phase[i], s, p)
            b = call_force(law, x[i], v[i], xo[i] - h[2], vo[i], t[i], phase[i], s, p)
            y += (a + b - 2.0 * f) / 6.0
            if valid[i]:
                sums[2] += (a - b) / (2.0 * h[2])
        if h[3] > 0.0:
            a = call_force(law, x[i], v[i], xo[i], vo[i] + h[3], t[i], phase[i], s, p)
            b = call_force(law, x[i], v[i], xo[i], vo[i] - h[3], t[i], phase[i], s, p)
            y += (a + b - 2.0 * f) / 6.0
            if valid[i]:
                sums[3] += (a - b) / (2.0 * h[3])
        out[i] = y


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"reassoc", "contract"})
def _interpolate(z, taps, out):  # type: ignore[no-untyped-def]
    """out (n U,) on the finer grid from z (n + 2 half,); taps (U, 2 half)."""
    finer, length = taps.shape
    for i in range(out.size // finer):
        for u in range(finer):
            total = 0.0
            for j in range(length):
                total += taps[u, j] * z[i + 1 + j]
            out[i * finer + u] = total


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"reassoc", "contract"})
def _decimate(z, taps, finer, out):  # type: ignore[no-untyped-def]
    """out (n,) from z ((n + 2 half) U,) through the symmetric taps (2 half U + 1,)."""
    for i in range(out.size):
        total = 0.0
        for j in range(taps.size):
            total += taps[j] * z[i * finer + j]
        out[i] = total


@cache
def _prototype() -> tuple[Floats, Floats]:
    """(U, 2 half) taps of the interpolation and (2 half U + 1,) of the decimation: one Kaiser low-pass, -80 dB."""
    from scipy.signal import firwin

    h = np.asarray(firwin(2 * HALF * FINER + 1, 1.0 / FINER, window=("kaiser", 8.0)))
    # value at i + u / U from samples i - half + 1 ... i + half
    offset = (HALF - 1 - np.arange(2 * HALF))[None, :] * FINER + np.arange(FINER)[:, None]
    return np.ascontiguousarray(FINER * h[offset + HALF * FINER]), h


@dataclass(frozen=True, slots=True)
class State:
    """What a law is evaluated on: (n,) arrays at one place, MARGIN rows wider on either side than what is asked for.

    x, v, xo, vo : m and m/s (zeros where there is no other direction); t : s; phase : rad; s : +1 in x, -1 in y.
    h : (4,) half-widths of the smoothing for x, v, xo, vo. valid : (n,) bool.
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

    def inner(self) -> State:
        """Without the margins."""
        k = slice(MARGIN, -MARGIN)
        x, v, xo, vo, t, phase = (
            np.ascontiguousarray(z[k]) for z in (self.x, self.v, self.xo, self.vo, self.t, self.phase)
        )
        return State(x, v, xo, vo, t, phase, self.s, self.h, self.valid[k])

    def finer(self) -> State:
        """On the finer grid, HALF (coarse) rows wider than the inner rows on either side."""
        taps = _prototype()[0]
        n = (self.x.size - 2 * HALF) * FINER

        def fine(z: Floats) -> Floats:
            out = np.empty(n)
            _interpolate(z, taps, out)
            return out

        def linear(z: Floats) -> Floats:
            z = z[HALF : n // FINER + HALF + 1]
            return (z[:-1, None] + np.diff(z)[:, None] * (np.arange(FINER) / FINER)).ravel()

        x, v, xo, vo = (fine(z) if z.any() else np.zeros(n) for z in (self.x, self.v, self.xo, self.vo))
        valid = np.repeat(self.valid[HALF:-HALF], FINER)
        valid[: HALF * FINER] = valid[-HALF * FINER :] = False  # the margins do not count in the mean tangents
        return State(x, v, xo, vo, linear(self.t), linear(self.phase), self.s, self.h, valid)


def depends(effect: Effect, p: Floats, scale: Floats) -> NDArray[np.bool_]:
    """(4,) whether the law reads x, v, xo, vo, by trying 64 states of rms `scale` (4,)."""
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


def rough(effect: Effect, p: Floats, scale: Floats) -> bool:
    """Whether the law has a jump or a kink along orbits of up to four standard deviations."""
    largest = []
    for n in (4096, 16384):
        at = np.linspace(0.0, 2 * np.pi, n)
        worst = 0.0
        for size in (1.3, 2.6, 4.1):
            x, v, xo, vo = (size * scale[i] * np.sin(at + shift) for i, shift in enumerate((0.1, 1.67, 2.3, 3.9)))
            f = force_array(effect, p, x, v, xo, vo, at / 10.0, at)
            if np.ptp(f) > 0:
                worst = max(worst, float(np.abs(np.diff(f, 2)).max() / np.ptp(f)))
        largest.append(worst)
    return largest[1] > largest[0] / 9.0  # second differences fall by 16 if the law is smooth, by 4 at a kink


def law_force(
    effect: Effect,
    p: Floats,
    state: State,
    reads: NDArray[np.bool_],
    series: tuple[Floats, Floats] | None = None,
) -> tuple[Floats, Floats]:
    """(n,) smoothed force in N on the grid of `state`, and (4,) sums of its tangents over the valid rows.

    series : arrays to fill with the tangents along x and v.
    """
    out, sums = np.empty_like(state.x), np.zeros(4)
    h = np.where(reads, state.h, 0.0)
    law: Any = np.uint64(address(effect.force))
    columns = (state.x, state.v, state.xo, state.vo, state.t, state.phase)
    kx, kv = (np.empty(0), np.empty(0)) if series is None else series
    _smoothed(law, np.ascontiguousarray(p), *columns, state.s, state.valid, h, out, sums, kx, kv)
    return out, sums


def decimated(force: Floats) -> Floats:
    """The inner rows of a force on the finer grid of `State.finer`, without what does not fit under Nyquist."""
    out = np.empty(force.size // FINER - 2 * HALF)
    _decimate(force, _prototype()[1], FINER, out)
    return out
