"""The slow displacement that lopsided laws make and no accelerometer sees: below the band, it follows from the law.

A law with an even part (a quadratic one, a one-sided stop) pushes the cap off its centre, by more while the vibration
is stronger: x_slow = -h(phi(x + x_slow)), h the stiffness-controlled response below the band. Left out, kq of 6 % of
the bearing force comes out 4 % too small, and the law works about the wrong centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .bandlimit import passband
from .effect import Effect
from .effects.compiled import force_array
from .motion_blocks import MotionBlocks
from .placed import Placed, evaluate
from .side_by_side import each

Array = NDArray[np.float64]
EVEN = 1e-3  # of a law's size: less of it is even in x by rounding alone
STEPS = 40  # points from which that is seen


def lopsided(effect: Effect, p: Array, sizes: Array) -> bool:
    """Whether a law has a part that is even in the motion; sizes : (4,) of x, v, xo, vo."""
    if effect.kind != "force" or effect.force is None:
        return False
    x, v, xo, vo = np.random.default_rng(0).normal(size=(4, STEPS)) * sizes[:, None]
    there, back = force_array(effect, p, x, v, xo, vo), force_array(effect, p, -x, -v, -xo, -vo)
    return bool(np.abs(there + back).max() > EVEN * np.abs(there - back).max() + 1e-300)


def usual(effect: Effect) -> Array:
    """(k,) parameters of a law in natural sizes."""
    return np.array([1.0 if q.linear else q.default for q in effect.parameters])


def with_slow(data: MotionBlocks, kL: Array, c: Array, uses: Sequence[Placed]) -> MotionBlocks:
    """The record with the slow displacement of the laws as they stand. kL, c : (places,)."""
    own = [[u for u in uses if i in u.at and u.p.any() and lopsided(u.effect, u.p, data.sizes(i))]
           for i in range(len(data.places))]  # fmt: skip
    if not any(own):
        return data
    from scipy.fft import irfft, next_fast_len, rfft

    n = data.x.shape[1]
    size = next_fast_len(n, real=True)
    f: Array = np.asarray(np.fft.rfftfreq(size, 1 / data.rate_hz), dtype=np.float64)
    f = f[f < data.band[0]]
    below = 1.0 - passband(f, data.rate_hz, data.band)
    shaft = data.shaft[0].real  # N/m at the lowest bin

    def at(i: int) -> Array:
        if not own[i]:
            return np.zeros(n)
        pushed = np.sum([evaluate(u, data, i, np.array([data.mass[i], kL[i], c[i]]))[0] for u in own[i]], axis=0)
        response = below / (kL[i] + shaft[i, i] + 2j * np.pi * f * c[i] - data.mass[i] * (2 * np.pi * f) ** 2)
        out = np.zeros(size // 2 + 1, complex)
        out[: f.size] = -response * rfft(pushed, size)[: f.size]
        return np.asarray(irfft(out, size)[:n])

    return replace(data, slow=np.stack(each(at, range(len(data.places)))))
