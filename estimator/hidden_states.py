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
from numpy.typing import NDArray

from .effect import Effect
from .effects.compiled import remembered, steps
from .features import MARGIN, decimated, interpolated

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
FINER = 2  # of the grid that states are integrated on: each step goes as exp(h), see compiled.py
PIECE = 1 << 15  # rows at a time
CYCLES = 8.0  # of the motion, after which a step is forgotten or kept for good
EVERY = 31.3  # cycles a step is launched: longer than an amplitude lasts, and never at the same phase


@dataclass(frozen=True, slots=True)
class MeanResponse:
    """Of a force to displacement. step : (lags,) N/m after a step, dt apart. tangent : N s/m, to velocity alone."""

    step: Array
    dt: float
    tangent: float

    @property
    def taps(self) -> Array:
        """(lags,) N/m: the force of every displacement so far, one tap for each."""
        rise = np.diff(self.step)
        taps = np.zeros(self.step.size)
        taps[0] = self.step[0]
        taps[:-1] += 0.5 * rise
        taps[1:] += 0.5 * rise
        return taps

    def at(self, f_hz: Array) -> Complexes:
        """(f,) N/m."""
        size = 1 << int(np.ceil(np.log2(8 * self.step.size)))
        f, z = np.fft.rfftfreq(size, self.dt), np.fft.rfft(self.taps, size)
        return np.interp(f_hz, f, z.real) + 1j * (np.interp(f_hz, f, z.imag) + 2 * np.pi * f_hz * self.tangent)


def remember(
    effect: Effect, p: Array, lin: Array, x: Array, v: Array, rate_hz: float, mean: Steps | None = None
) -> Array:  # fmt: skip
    """(n,) N of a force along a path, its states from rest. lin : (3,) m, kL, c. mean : to be given steps."""
    n, rate = x.size, FINER * rate_hz
    out, start = np.empty(n), np.zeros(effect.states)
    for a in range(0, n, PIECE):
        b = min(a + PIECE, n)
        rows = np.clip(np.arange(a - MARGIN, b + MARGIN), 0, n - 1)
        fine = interpolated(x[rows], FINER), interpolated(v[rows], FINER)
        force, states = known = remembered(effect, p, lin, *fine, rate, start)
        start = states[(b - a) * FINER].copy()  # HALF rows before the end: where the next piece begins
        out[a:b] = decimated(force, FINER)
        if mean is not None:
            mean.add(effect, p, lin, *fine, known)
    return out


def along(effect: Effect, p: Array, lin: Array, x: Array, v: Array, rate_hz: float) -> tuple[Array, MeanResponse]:
    """The same with the mean response."""
    mean = Steps(x, v, 1.0 / (FINER * rate_hz))
    return remember(effect, p, lin, x, v, rate_hz, mean), mean.response()


def response_along(
    effect: Effect, p: Array, lin: Array, x: Array, v: Array, rate_hz: float, known: tuple[Array, Array]
) -> MeanResponse:
    """Mean response along a path at its own rate; known : what `remembered` says of it."""
    mean = Steps(x, v, 1.0 / rate_hz)
    mean.add(effect, p, lin, x, v, known)
    return mean.response()


class Steps:
    """Sums of the answers to steps along a path x, v (any rate), whose rows are to be dt apart."""

    def __init__(self, x: Array, v: Array, dt: float) -> None:
        cycle = 2 * np.pi * float(np.sqrt(np.dot(x, x) / np.dot(v, v))) / dt  # rows
        self.dt, self.stride, self.sums = dt, int(EVERY * cycle) + 1, np.zeros(int(CYCLES * cycle) + 2)
        self.count, self.tangent = 0, 0.0

    def add(self, effect: Effect, p: Array, lin: Array, x: Array, v: Array, known: tuple[Array, Array]) -> None:
        """Steps along a piece of it; known : what `remembered` says of the piece."""
        count, tangent = steps(effect, p, lin, x, v, 1.0 / self.dt, known, self.stride, self.sums)
        self.count, self.tangent = self.count + count, self.tangent + tangent

    def response(self) -> MeanResponse:
        count = max(self.count, 1)
        return MeanResponse(self.sums / count, self.dt, self.tangent / count)
