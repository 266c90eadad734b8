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

from dataclasses import dataclass

import numpy as np
from numba import njit

from estimator.arrays import Array, Complexes, Series
from estimator.effects.engine.memory_loop import LinearisedMemory, force_along_path, reads_motion
from estimator.likelihood.thresholds import LIMITS
from estimator.model.effect import Effect

from .law_smoothing import MARGIN_ROWS, decimated, interpolated


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


def memory_force_and_response(
    effect: Effect, p: Array, lin: Array, x: Series, v: Series, rate_hz: float
) -> tuple[Array, MeanResponse]:
    """Force (n,) N along a path, states from rest, and its mean response. lin : (3,) m, kL, c."""
    n, rate = x.size, LIMITS.memory_grid_factor * rate_hz
    mean = StepResponses(x, v, 1.0 / rate)
    out, start = np.empty(n), np.zeros(effect.states)
    fast, stride = (
        reads_motion(effect, p, lin)[1],
        min(max(n // LIMITS.memory_rows_per_piece // LIMITS.min_pieces, 1), LIMITS.max_piece_stride),
    )
    for a in range(0, n, LIMITS.memory_rows_per_piece):
        b = min(a + LIMITS.memory_rows_per_piece, n)
        rows = np.clip(np.arange(a - MARGIN_ROWS, b + MARGIN_ROWS), 0, n - 1)
        fine = interpolated(x[rows], LIMITS.memory_grid_factor)
        speed = interpolated(v[rows], LIMITS.memory_grid_factor) if fast else np.zeros_like(fine)
        stepped = a // LIMITS.memory_rows_per_piece % stride == 0
        force, states, about = force_along_path(effect, p, lin, fine, speed, 1.0 / rate, start, stepped)
        start = states[(b - a) * LIMITS.memory_grid_factor].copy()  # where the next piece begins
        out[a:b] = decimated(force, LIMITS.memory_grid_factor)
        if about is not None:
            mean.add(about)
    return out, mean.response()


class StepResponses:
    """Sums of step responses along a path x, v (any rate), on rows dt apart."""

    def __init__(self, x: Series, v: Series, dt: float) -> None:
        cycle = 2 * np.pi * float(np.sqrt(np.dot(x, x) / np.dot(v, v))) / dt  # rows
        self.dt, self.stride = dt, max(1, int(cycle / LIMITS.steps_per_cycle))
        self.sums, self.counts = np.zeros((2, int(LIMITS.memory_cycles * cycle) + 2))
        self.rows, self.tangent = 0, 0.0

    def add(self, about: LinearisedMemory) -> None:
        """Add the step responses along a piece of the path."""
        _launch(about.step, about.force, self.stride, LIMITS.followed_halvings, self.sums, self.counts)
        self.rows, self.tangent = self.rows + len(about.force), self.tangent + float(about.force[:, -1].sum())

    def response(self) -> MeanResponse:
        return MeanResponse(self.sums / np.maximum(self.counts, 1.0), self.dt, self.tangent / max(self.rows, 1))


@njit(cache=True, error_model="numpy", nogil=True)
def _launch(step, force, stride, halvings, sums, counts):  # type: ignore[no-untyped-def]
    """Add to sums (lags,) the increments, from row to row, of the force after a rise of the displacement by 1 over a
    step of the grid, a rise every `stride` rows; add to counts (lags,) the number of rises."""
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
