"""The slow displacement that some laws make and no accelerometer sees: below the band, it follows from the law.

A law with an even part (a quadratic one, a one-sided stop) pushes the cap off its centre, by more while the vibration
is stronger: x_slow = -h(phi(x + x_slow)), h the stiffness-controlled response below the band. Left out, kq of 6 % of
the bearing force comes out 4 % too small, and the law works about the wrong centre. A periodic force below the band,
such as an imbalance, turns the stiffness of a law that sees only the rest. Hysteresis pushes by loops that end off the
centre, now on this side and now on that: less, but what it loses so near the edge of the band, and about twice the
resonance, would be taken for stiffness.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .bandlimit import unseen
from .effect import Effect
from .effects.compiled import memory_array
from .effects.law_loop import force_array
from .features import Series
from .linear_memory import filtered
from .motion_blocks import MotionBlocks
from .placed import Placed, evaluate, remembers
from .side_by_side import each

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
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


def own_sizes(effect: Effect) -> Array:
    """(4,) of x, v, xo, vo that the usual parameters of a law are natural for: a user's law has its lengths in m."""

    def of(unit: str) -> float:
        return max((abs(q.default) for q in effect.parameters if q.unit == unit and q.default), default=1.0)

    return np.array([of("m"), of("m/s")] * 2)


def below(
    linear: tuple[float, float, float], rate_hz: float, band: tuple[float, float], kind: str
) -> Callable[[Array], Complexes]:
    """Displacement below the band per restoring force, m/N at w (f,) rad/s, as far as a sensor of this kind does not
    show it. linear : m, k, c."""
    m, k, c = linear

    def response(w: Array) -> Complexes:
        f = w / (2 * np.pi)
        part = np.where(f < band[0], unseen(f, rate_hz, band, kind), 0.0)
        return np.asarray(-part / (k + 1j * w * c - m * w**2))

    return response


def with_slow(data: MotionBlocks, kL: Array, c: Array, uses: Sequence[Placed]) -> MotionBlocks:
    """The record with the slow displacement of the laws as they stand, and of periodic forces, beside what sensors
    measure of it. kL, c : (places,)."""
    lin = np.stack([data.mass, kL, c], axis=1)
    own = [[u for u in uses if i in u.at and u.p.any() and (lopsided(u.effect, u.p, data.sizes(i)) or
            remembers(u, lin[i]))] for i in range(len(data.places))]  # fmt: skip
    if not any(own) and not data.pushes:
        return data
    stiffness = kL + np.diag(data.shaft[0].real)  # N/m at the lowest bin

    def force(use: Placed, i: int) -> Array:
        if use.effect.kind == "force":
            return evaluate(use, data, i, lin)[0]
        return memory_array(use.effect, use.p, lin[i], data.seen(i), data.v[i], data.rate_hz)

    def response(i: int) -> Callable[[Array], Complexes]:
        return below((float(data.mass[i]), float(stiffness[i]), float(c[i])), data.rate_hz, data.band, data.kinds[i])

    def at(i: int) -> Series:
        if not own[i]:
            return np.zeros(data.x.shape[1], np.float32)
        total = np.sum([force(u, i) for u in own[i]], axis=0)
        return filtered(response(i), total, data.rate_hz).astype(np.float32)

    slow = np.stack(each(at, range(len(data.places))))
    for push in data.pushes:
        for i, x in push.displacement(data.t, data.phase, lambda i, w: -response(i)(w)).items():
            slow[i] += x
    if data.measured is not None:
        slow += data.measured
    return replace(data, slow=slow)
