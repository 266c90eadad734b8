"""Forces with memory that obey no linear equations (Bouc-Wen): the force along the measured motion, and its mean
response to a little more motion.

The states are integrated on a grid finer than the samples, on the motion as its band limits it: on straight lines
between samples the force at 6 kHz comes out 16 % too small.

The likelihood needs the mean response <T(f)> of the force to an added displacement. It is found from steps of
displacement that are launched all along the path: what each leaves in the force, averaged over the steps, is the step
response, without the scatter of a random probe. physics.md section 5 says why it is no regression on the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from .arrays import Array, Complexes, Series
from .effect import Effect
from .features import MARGIN, decimated, interpolated
from .linearised import Linearised, passed, reads

FINER = 2  # of the grid that states are integrated on
PIECE = 1 << 13  # rows at a time: what is linearised about them stays in the cache
STRIDE, ENOUGH = 3, 40  # at most, of pieces of which one has steps; how many do, before others are left out
CYCLES = 8.0  # of the motion, after which a step is forgotten or kept for good
OFTEN = 2.6  # steps launched in a cycle, at ever other phases: what they do at once counts most, and costs little
HALVINGS = 5  # every second step is followed to half of CYCLES at most, every second of these to a quarter, ...


@dataclass(frozen=True, slots=True)
class MeanResponse:
    """Of a force to displacement. taps : (lags,) N/m, the force of every displacement so far, rows dt apart.
    tangent : N s/m, to velocity alone."""

    taps: Array
    dt: float
    tangent: float

    def at(self, f_hz: Array) -> Complexes:
        """(f,) N/m."""
        size = 1 << int(np.ceil(np.log2(8 * self.taps.size)))
        f, z = np.fft.rfftfreq(size, self.dt), np.fft.rfft(self.taps, size)
        return np.interp(f_hz, f, z.real) + 1j * (np.interp(f_hz, f, z.imag) + 2 * np.pi * f_hz * self.tangent)


def remember(
    effect: Effect, p: Array, lin: Array, x: Series, v: Series, rate_hz: float, mean: Steps | None = None
) -> Array:  # fmt: skip
    """(n,) N of a force along a path, its states from rest. lin : (3,) m, kL, c. mean : to be given steps."""
    n, rate = x.size, FINER * rate_hz
    out, start = np.empty(n), np.zeros(effect.states)
    fast, stride = reads(effect, p, lin)[1], min(max(n // PIECE // ENOUGH, 1), STRIDE)
    for a in range(0, n, PIECE):
        b = min(a + PIECE, n)
        rows = np.clip(np.arange(a - MARGIN, b + MARGIN), 0, n - 1)
        fine = interpolated(x[rows], FINER)
        speed = interpolated(v[rows], FINER) if fast else np.zeros_like(fine)
        stepped = mean is not None and a // PIECE % stride == 0
        force, states, about = passed(effect, p, lin, fine, speed, 1.0 / rate, start, stepped)
        start = states[(b - a) * FINER].copy()  # HALF rows before the end: where the next piece begins
        out[a:b] = decimated(force, FINER)
        if mean is not None and about is not None:
            mean.add(about)
    return out


def along(effect: Effect, p: Array, lin: Array, x: Series, v: Series, rate_hz: float) -> tuple[Array, MeanResponse]:
    """The same with the mean response."""
    mean = Steps(x, v, 1.0 / (FINER * rate_hz))
    return remember(effect, p, lin, x, v, rate_hz, mean), mean.response()


class Steps:
    """Sums of the answers to steps along a path x, v (any rate), whose rows are to be dt apart."""

    def __init__(self, x: Series, v: Series, dt: float) -> None:
        cycle = 2 * np.pi * float(np.sqrt(np.dot(x, x) / np.dot(v, v))) / dt  # rows
        self.dt, self.stride = dt, max(1, int(cycle / OFTEN))
        self.sums, self.counts = np.zeros((2, int(CYCLES * cycle) + 2))
        self.rows, self.tangent = 0, 0.0

    def add(self, about: Linearised) -> None:
        """Steps along a piece of it."""
        _launch(about.step, about.force, self.stride, HALVINGS, self.sums, self.counts)
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
