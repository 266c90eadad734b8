"""Force of a law along the measured motion, smoothed over the unmeasured part of the motion.

The true displacement is the band-limited one plus an out-of-band remainder e, small, Gaussian and independent of it.
The in-band force of a law phi is then E_e[phi(x + e)], and its mean tangent is E_e[phi'(x + e)]. A three-
point Gauss-Hermite rule gives both: nodes at -h, 0, +h with h = sqrt(3) sd(e), weights 1/6, 2/3, 1/6; the derivative
is the central difference over the same nodes (Stein's identity), so a jump such as sgn(v) gets its density term.

A law with a jump or a kink has harmonics above the Nyquist frequency. Sampled, they would alias into the band. Such a
law is evaluated on a grid finer by `law_grid_factor`, and its force is low-pass filtered and decimated. The same is
done for a smooth law at a resonance so high that its few harmonics alias.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.arrays import Array, Series
from estimator.effects.engine.law_loop import Signals, compiled, force_array, law_of, smoothed
from estimator.likelihood.thresholds import LIMITS
from estimator.model.effect import Effect
from estimator.signals import low_pass

HALF_SUPPORT_ROWS = 12  # of the interpolation, rows of the coarse grid
MARGIN_ROWS = 2 * HALF_SUPPORT_ROWS  # rows needed on either side of the result


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


@njit(cache=True, error_model="numpy", nogil=True)
def _between(z, out):  # type: ignore[no-untyped-def]
    """out (n U,) on straight lines between the points of z (n + 1,)."""
    n = z.size - 1
    finer = out.size // n
    for i in range(n):
        step = (z[i + 1] - z[i]) / finer
        for u in range(finer):
            out[i * finer + u] = z[i] + u * step


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"reassoc", "contract"})
def _decimate(z, taps, finer, out):  # type: ignore[no-untyped-def]
    """out (n,) from z ((n + 2 half) U,) through the symmetric taps (2 half U + 1,)."""
    rows = min(1024, out.size)
    reach = (taps.size - 1) // finer
    phases = np.empty((finer, rows + reach + 1))  # so that neighbours in the inner loop are neighbours in memory
    for first in range(0, out.size, rows):
        n = min(rows, out.size - first)
        for i in range(n + reach + 1):
            for u in range(finer):
                k = (first + i) * finer + u
                phases[u, i] = z[k] if k < z.size else 0.0
        part = out[first : first + n]
        part[:] = 0.0
        for j in range(taps.size):
            tap, row = taps[j], phases[j % finer, j // finer :]
            for i in range(n):
                part[i] += tap * row[i]


@cache
def _prototype(finer: int) -> tuple[Array, Array]:
    """(U, 2 half) taps of the interpolation and (2 half U + 1,) of the decimation: one Kaiser low-pass, -80 dB."""
    h = low_pass.kaiser_low_pass(2 * HALF_SUPPORT_ROWS * finer + 1, 1.0 / finer, 8.0)
    # value at i + u / U from samples i - half + 1 ... i + half
    offset = (HALF_SUPPORT_ROWS - 1 - np.arange(2 * HALF_SUPPORT_ROWS))[None, :] * finer + np.arange(finer)[:, None]
    return np.ascontiguousarray(
        h[offset + HALF_SUPPORT_ROWS * finer] / h[HALF_SUPPORT_ROWS * finer]
    ), h  # through the samples


@dataclass(frozen=True, slots=True)
class LawStates:
    """States at one place that a law is evaluated on, (n,) each, MARGIN_ROWS wider on either side than the result.

    x, v, xo, vo : m and m/s (zeros without another direction). t : s. phase : rad. s : +1 in x, -1 in y.
    h : (4,) half-widths of the smoothing for x, v, xo, vo. valid : (n,) bool. made : cache of `signals`.
    """

    x: Series
    v: Series
    xo: Series
    vo: Series
    _: KW_ONLY
    t: Series
    phase: Series
    s: float
    h: Array
    valid: NDArray[np.bool_]
    made: dict[bytes, Signals] = field(default_factory=dict)

    def signals(self, reads: NDArray[np.bool_]) -> Signals:
        """Signals for a law that reads these of x, v, xo, vo; zeros for the others."""
        key = reads.tobytes()
        if key not in self.made:
            if b"" not in self.made:
                still = np.zeros(self.x.size)  # a gap that no state tried has reached is not reached by it
                signals = (self.x, self.v, self.xo, self.vo, self.t, self.phase, still)
                self.made[b""] = Signals.of([_signal(z) for z in signals], self.valid)
            *own, t, phase, zeros, valid = self.made[b""].at
            seen = (z if read else zeros for z, read in zip(own, reads.tolist(), strict=True))
            self.made[key] = Signals(self.made[b""].arrays, (*seen, t, phase, valid))
        return self.made[key]

    def inner(self) -> LawStates:
        """The states without the margins."""
        k = slice(MARGIN_ROWS, -MARGIN_ROWS)
        x, v, xo, vo, t, phase = (
            np.ascontiguousarray(z[k]) for z in (self.x, self.v, self.xo, self.vo, self.t, self.phase)
        )
        return LawStates(x=x, v=v, xo=xo, vo=vo, t=t, phase=phase, s=self.s, h=self.h, valid=self.valid[k])

    def finer(self, reads: NDArray[np.bool_]) -> LawStates:
        """The states on the fine grid, HALF_SUPPORT_ROWS (coarse) wider than the inner rows; 0 for what is not read."""
        n = (self.x.size - 2 * HALF_SUPPORT_ROWS) * LIMITS.law_grid_factor
        zero = np.zeros(n)

        def linear(z: Series) -> Array:
            out = np.empty(n)
            _between(z[HALF_SUPPORT_ROWS : n // LIMITS.law_grid_factor + HALF_SUPPORT_ROWS + 1], out)
            return out

        x, v, xo, vo = (
            interpolated(z) if u else zero for z, u in zip((self.x, self.v, self.xo, self.vo), reads, strict=True)
        )
        valid = np.repeat(self.valid[HALF_SUPPORT_ROWS:-HALF_SUPPORT_ROWS], LIMITS.law_grid_factor)
        valid[: HALF_SUPPORT_ROWS * LIMITS.law_grid_factor] = valid[-HALF_SUPPORT_ROWS * LIMITS.law_grid_factor :] = (
            False  # the margins do not count in the mean tangents
        )
        return LawStates(
            x=x, v=v, xo=xo, vo=vo, t=linear(self.t), phase=linear(self.phase), s=self.s, h=self.h, valid=valid
        )


def reads_states(effect: Effect, p: Array, scale: Array) -> NDArray[np.bool_]:
    """(4,) whether a law reads x, v, xo, vo, by trial at 64 states of rms `scale` (4,)."""
    z, t, phase = _tried_states()
    x, v, xo, vo = scale[:, None] * z
    force = force_array(effect, p, x, v, xo, vo, t, phase).reshape(5, 64)
    return np.asarray(np.any(force[1:] != force[0], axis=1))


@cache
def _tried_states() -> tuple[Array, Array, Array]:
    """(4, 320) x, v, xo, vo of rms 2, five times the same 64, from the second time on one of the four anew; (320,) t
    and phase."""
    rng = np.random.default_rng(0)
    z = np.tile(2.0 * rng.normal(size=(4, 64)), 5)
    t, phase = rng.uniform(0, 10, 64), rng.uniform(0, 2 * np.pi, 64)
    for k in range(4):
        z[k, 64 * (k + 1) : 64 * (k + 2)] = 2.0 * rng.normal(size=64)
    return z, np.tile(t, 5), np.tile(phase, 5)


def has_jump(effect: Effect, p: Array, scale: Array) -> bool:
    """Whether the law has a jump along orbits of up to four standard deviations."""
    return _shrinking(effect, p, scale, 512) < 2.0  # by 1 at a jump


def harmonics_alias(effect: Effect, p: Array, scale: Array, folding_hz: float) -> bool:
    """Whether a harmonic of the law aliases into the band.

    scale : (4,) rms of x, v, xo, vo. folding_hz : the sampling rate less the upper band edge.
    """
    x, v = scale[::2], scale[1::2]
    moving = x > 0.0
    hz = LIMITS.frequency_spread * float((v[moving] / (2 * np.pi * x[moving])).max(initial=0.0))
    return LIMITS.max_harmonic * hz > folding_hz and highest_harmonic(effect, p, scale) * hz > folding_hz


def highest_harmonic(effect: Effect, p: Array, scale: Array) -> int:
    """Highest harmonic of the force along an orbit of 2.6 standard deviations, at most `max_harmonic`."""
    x, v, xo, vo = 2.6 * scale[:, None] * _orbit(np.linspace(0.0, 2 * np.pi, 63, endpoint=False))
    size = np.abs(np.fft.rfft(force_array(effect, p, x, v, xo, vo)))[1 : LIMITS.max_harmonic + 1]
    return 1 + int(np.flatnonzero(size > LIMITS.min_harmonic_rel * size.max(initial=0.0)).max(initial=0))


def _shrinking(effect: Effect, p: Array, scale: Array, points: int) -> float:
    """Ratio of the largest second difference of the force on orbits of `points` to that on four times as many."""
    largest = []
    for n in (points, 4 * points):
        at, states = _orbits(n)
        x, v, xo, vo = scale[:, None] * states
        f = force_array(effect, p, x, v, xo, vo, at / 10.0, at).reshape(-1, n)
        size = np.ptp(f, axis=1)
        sharpest = np.abs(np.diff(f, 2)).max(axis=1)
        largest.append(float(np.max(sharpest[size > 0] / size[size > 0], initial=0.0)))
    return largest[0] / largest[1] if largest[1] > 0.0 else np.inf


@cache
def _orbits(n: int) -> tuple[Array, Array]:
    """Angles of the orbits in n steps each, rad, and (4, ...) x, v, xo, vo along them over their rms."""
    at = np.linspace(0.0, 2 * np.pi, n)
    return np.tile(at, len(LIMITS.orbit_sizes_sd)), np.concatenate(
        [size * _orbit(at) for size in LIMITS.orbit_sizes_sd], axis=1
    )


def _orbit(at: Array) -> Array:
    """(4, n) x, v, xo, vo of amplitude 1 at these angles."""
    return np.asarray(np.sin(at + np.array([[0.1], [1.67], [2.3], [3.9]])))


def law_force(
    effect: Effect, p: Array, state: LawStates, reads: NDArray[np.bool_], series: tuple[Series, Series] | None = None
) -> tuple[Array, Array]:
    """(n,) smoothed force in N on the grid of `state`, and (4,) sums of its tangents over the valid rows.

    reads : of x, v, xo, vo, as `reads_states` has it. series : arrays to fill with the tangents along x and v.
    """
    law, p, sums = law_of(effect, p), np.ascontiguousarray(p), np.zeros(4)
    signals = state.signals(reads)
    out, tangent = np.empty(state.x.size), np.empty(state.x.size)
    widths = [(k, h) for k, h in enumerate((reads * state.h).tolist()) if h > 0.0]
    for number, (k, h) in enumerate(widths or [(0, 0.0)]):
        sums[k] = smoothed(law, p, signals, k, h, state.s, out, tangent, number > 0)
        if series is not None and k < 2:
            series[k][...] = tangent
    return out, sums


def _signal(z: Series) -> Array:
    """The series as contiguous float64, as the compiled loops need it."""
    return np.ascontiguousarray(z, dtype=np.float64)


def compile_law(effect: Effect, p: Array) -> None:
    """Compile the law of an effect, before several threads ask for it. Raises ValueError if the effect has none."""
    compiled(law_of(effect, p))


def interpolated(z: Series, finer: int = LIMITS.law_grid_factor) -> Array:
    """A signal (n,) on the fine grid, without HALF_SUPPORT_ROWS (coarse) rows on either side."""
    out = np.empty((z.size - 2 * HALF_SUPPORT_ROWS) * finer)
    _interpolate(np.asarray(z, np.float64), _prototype(finer)[0], out)
    return out


def decimated(force: Array, finer: int = LIMITS.law_grid_factor) -> Array:
    """The inner rows of a force on the finer grid of `LawStates.finer`, without components above Nyquist."""
    out = np.empty(force.size // finer - 2 * HALF_SUPPORT_ROWS)
    _decimate(force, _prototype(finer)[1], finer, out)
    return out
