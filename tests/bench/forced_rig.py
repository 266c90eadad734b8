"""The reference rig under a force that is known: band-limited, measured beside the acceleration at all four places.

Shares nothing with the package and nothing with reference_rig.py but its numbers. The force is white noise at the
sampling rate through an interpolating filter that ends before the Nyquist frequency, so it is a smooth function of time
whose samples say all of it; it is known at both ends and in the middle of each Runge-Kutta step, without a hold. The
acceleration is that of the equation of motion at the instant of the sample: nothing is filtered or delayed.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray
from reference_rig import DISC, MASS, RATE, SHAFT, SHAFT_DAMPING, TRUTH
from scipy.signal import firwin, upfirdn

Floats = NDArray[np.float64]
KNL = 1.3e18
STEPS = 8  # a sample
EDGE_HZ = 11500.0  # half of the force's amplitude
LEAD_S = 4.0  # from rest, not kept: the disc on its shaft loses 1/e in a second
CHUNK, REACH = 8192, 64  # samples at a time; under the interpolating filter
KEYS = ("kL", "c", "kNL")
NOISE = 0.02  # m/s^2 rms, of each accelerometer
COUNT = 490.5 / 32768  # m/s^2
FORCE_COUNT = 20.0 / 32768  # N


def truth() -> Floats:
    """(12,) kL, c, kNL of the four places, place by place."""
    return np.stack([TRUTH["kL"], TRUTH["c"], np.full(4, KNL)], axis=1).ravel()


@njit(cache=True)
def accelerate(x, v, f, p, a):  # type: ignore[no-untyped-def]
    for q in range(2):
        a[4 + q] = 0.0
    for i in range(4):
        d = 4 + i % 2
        shaft = SHAFT * (x[i] - x[d]) + SHAFT_DAMPING * (v[i] - v[d])
        a[i] = (f[i] - p[i, 0] * x[i] - p[i, 1] * v[i] - p[i, 2] * x[i] ** 3 - shaft) / MASS
        a[d] += shaft / DISC


@njit(cache=True)
def _integrate(f, x, v, h, p, steps, out):  # type: ignore[no-untyped-def]
    """f : (2 steps n + 1, 4) at every half step; out : (n, 4) acceleration at the samples."""
    a1, a2, a3, a4 = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)
    for n in range(out.shape[0] * steps):
        accelerate(x, v, f[2 * n], p, a1)
        if n % steps == 0:
            out[n // steps] = a1[:4]
        v2 = v + 0.5 * h * a1
        accelerate(x + 0.5 * h * v, v2, f[2 * n + 1], p, a2)
        v3 = v + 0.5 * h * a2
        accelerate(x + 0.5 * h * v2, v3, f[2 * n + 1], p, a3)
        v4 = v + h * a3
        accelerate(x + h * v3, v4, f[2 * n + 2], p, a4)
        x += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


def taps(finer: int) -> Floats:
    """Of the filter that makes the force on a grid so many times finer."""
    return np.asarray(firwin(REACH * finer + 1, EDGE_HZ, fs=RATE * finer, window=("kaiser", 10.0)) * finer)


def respond(white: Floats, p: Floats, steps: int = STEPS) -> tuple[Floats, Floats]:
    """(n, 4) m/s^2 and (n, 4) N, from rest, n a little less than the rows of `white` (rows, 4) at the sampling rate.

    p : (12,) as in `truth`.
    """
    fine = 2 * steps
    x, v = np.zeros(6), np.zeros(6)
    accelerations, forces = [], []
    for start in range(0, len(white) - REACH - 1, CHUNK):
        part = white[start : start + CHUNK + REACH + 1]
        n = len(part) - REACH - 1
        f = upfirdn(taps(fine), part, up=fine, axis=0)[REACH * fine : (REACH + n) * fine + 1]
        out = np.empty((n, 4))
        _integrate(np.ascontiguousarray(f), x, v, 1 / (RATE * steps), p.reshape(4, 3), steps, out)
        accelerations.append(out)
        forces.append(f[:-1:fine])
    return np.concatenate(accelerations), np.concatenate(forces)


def white(seconds: float, seed: int) -> Floats:
    """What the force of a record is made of: its one-sided PSD in the band is that of the reference rig."""
    rows = int((seconds + LEAD_S) * RATE) + 65
    return np.random.default_rng(seed).normal(size=(rows, 4)) * np.sqrt(TRUTH["S"] / 2 * RATE)


@lru_cache(maxsize=1)
def true_record(seconds: float, seed: int) -> tuple[Floats, Floats]:
    """(n, 4) m/s^2 and (n, 4) N without noise."""
    a, f = (z[int(LEAD_S * RATE) :] for z in respond(white(seconds, seed), truth()))
    return a, f


def measured(seconds: float, seed: int, force_noise: float) -> Floats:
    """(n, 8) what the sensors send: accelerations, then forces. force_noise : N rms, of each force sensor."""
    a, f = true_record(seconds, seed)
    rng = np.random.default_rng((seed, 1))
    a = a + NOISE * rng.normal(size=a.shape)
    f = f + force_noise * rng.normal(size=f.shape)
    return np.concatenate([np.round(a / COUNT) * COUNT, np.round(f / FORCE_COUNT) * FORCE_COUNT], axis=1)
