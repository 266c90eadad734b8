"""The slow displacement that some laws make and no accelerometer sees: below the band, it follows from the law.

A law with an even part (a quadratic one, a one-sided stop) pushes the cap off its centre, by more while the vibration
is stronger: x_slow = -h(phi(x + x_slow)), h the response of the rotor below the band, through the shaft also at the
other cap: there it is half as large with a shaft twice as stiff as the bearings. Left out, kq of 6 % of
the bearing force comes out 4 % too small, and the law works about the wrong centre. A periodic force below the band,
such as an imbalance, turns the stiffness of a law that sees only the rest. Hysteresis pushes by loops that end off the
centre, now on this side and now on that: less, but what it loses so near the edge of the band, and about twice the
resonance, would be taken for stiffness.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .bandlimit import unseen
from .effect import Effect
from .effects.compiled import memory_array
from .effects.law_loop import force_array
from .mean_response import yields
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
    yields: Callable[[Array], Complexes], rate_hz: float, band: tuple[float, float], kinds: Sequence[str]
) -> Callable[[Array], Complexes]:
    """Displacement below the band per force, (f, places, places) m/N at w (f,) rad/s, as far as the sensors do not show
    it. yields : all of it. kinds : of the sensor at each place."""

    def response(w: Array) -> Complexes:
        f = w / (2 * np.pi)
        part = np.stack([np.where(f < band[0], unseen(f, rate_hz, band, kind), 0.0) for kind in kinds], axis=1)
        return np.asarray(part[..., None] * yields(w))

    return response


def moved(
    push: Mapping[int, Array], response: Callable[[Array], Complexes], rate_hz: float, low_hz: float
) -> dict[int, Array]:
    """(n,) m by place, of those that restoring forces push (n,) N by place move; nothing from low_hz on."""
    from scipy.fft import irfft, next_fast_len, rfft

    n = next(iter(push.values())).size
    size = next_fast_len(n, real=True)
    f: Array = np.asarray(np.fft.rfftfreq(size, 1 / rate_hz)[: int(low_hz * size / rate_hz) + 1], np.float64)
    G = response(2 * np.pi * f)
    forces = {j: np.asarray(rfft(one, size)[: f.size]) for j, one in push.items()}
    there = [i for i in range(G.shape[1]) if G[:, i, list(forces)].any()]
    F = np.stack([*forces.values()], axis=1)
    return {i: irfft(-(G[:, i, list(forces)] * F).sum(axis=1), size)[:n] for i in there}


def with_slow(data: MotionBlocks, kL: Array, c: Array, uses: Sequence[Placed]) -> MotionBlocks:
    """The record with the slow displacement of the laws as they stand, and of periodic forces, beside what sensors
    measure of it. kL, c : (places,)."""
    lin = np.stack([data.mass, kL, c], axis=1)
    own = [[u for u in uses if i in u.at and u.p.any() and (lopsided(u.effect, u.p, data.sizes(i)) or
            remembers(u, lin[i]))] for i in range(len(data.places))]  # fmt: skip
    if not any(own) and not data.pushes:
        return data
    D = np.stack([np.diag(kL), np.diag(c)], axis=-1)
    response = below(
        lambda w: yields(w, data.mass, D, data.places, data.disc), data.rate_hz, data.band, data.kinds
    )  # fmt: skip

    def force(use: Placed, i: int) -> Array:
        if use.effect.kind == "force":
            return evaluate(use, data, i, lin)[0]
        return memory_array(use.effect, use.p, lin[i], data.seen(i), data.v[i], data.rate_hz)

    def at(i: int) -> Array:
        return np.asarray(np.sum([force(u, i) for u in own[i]], axis=0))

    pushed = [i for i, laws in enumerate(own) if laws]
    slow = np.zeros(data.x.shape, np.float32)
    if pushed:
        push = dict(zip(pushed, each(at, pushed), strict=True))
        for i, x in moved(push, response, data.rate_hz, data.band[0]).items():
            slow[i] += x
    for periodic in data.pushes:
        for i, x in periodic.displacement(data.t, data.phase, response).items():
            slow[i] += x
    if data.measured is not None:
        slow += data.measured
    return replace(data, slow=slow)
