"""Laws between the disc and the caps (a breathing crack): their force on the caps along the measured motion, and its
mean response.

The disc is not measured. A law that takes g(phase) of the shaft's stiffness changes the motion of the disc. The
deflection s of the disc against the mean of the two caps of a direction obeys

    m s'' + C s' + (K - g) s = -m x'',    x the mean displacement of the two caps of a direction,

with m, C, K those of the disc on its shaft: linear, and periodic in time. s = s0 + s1, where s0 is the deflection with
the unchanged shaft, which is part of the known force. The law adds the force m s1'' / 2 on each cap. s1 is integrated
along the path, as a series in g does not converge at the disc's resonance (quality of thousands).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numba import njit

from estimator.arrays import Array, Complexes
from estimator.effects.engine.law_loop import force_array
from estimator.likelihood.thresholds import LIMITS
from estimator.model.effect import Effect
from estimator.results import Message

from .linear_memory import filtered_series
from .motion_record import MotionRecord, without_bins


def first_of_direction(data: MotionRecord, i: int) -> int:
    """Index of the first cap of the direction of a place: the force on both caps is the same."""
    o = data.opposite(i)
    return i if o is None else min(i, o)


def shaft_force(effect: Effect, p: Array, data: MotionRecord, i: int, lin: Array) -> tuple[Array, Complexes]:
    """Force (n,) N on the cap at a place, and (places, bins) N/m its mean response to the displacement of every place.

    Both are zero without a disc on a shaft, or if the opposite cap is not measured. lin : (places, 3) m, kL, c.
    """
    across, disc, o = np.zeros((len(data.places), data.bins.size), complex), data.disc, data.opposite(i)
    if disc is None or o is None:
        return np.zeros(data.x.shape[1]), across
    caps, g = sorted((i, o)), _taken(effect, p, data.t, data.phase)
    if max(-g.min(), g.max()) < LIMITS.min_law_rel * disc.K:
        disc = disc.blurred()
    correction = 0.0 if data.denoise_correction is None else data.denoise_correction[caps].astype(np.float64)
    mean = 0.5 * (data.x[caps] + correction).sum(axis=0)
    steps = max(1, int(np.ceil(disc.w0 / (LIMITS.max_step_rad * data.rate_hz))))
    disc_motion = filtered_series(disc.follows, mean, data.rate_hz, 2 * steps)
    force = _beside(disc_motion, g, disc.m, disc.C, disc.K, 1.0 / data.rate_hz, steps)
    angles = 2 * np.pi * np.arange(LIMITS.angles_per_turn) / LIMITS.angles_per_turn
    turn = np.fft.fft(_taken(effect, p, np.zeros(LIMITS.angles_per_turn), angles)) / LIMITS.angles_per_turn
    speed = float((data.phase[-1] - data.phase[0]) / (data.t[-1] - data.t[0]))
    bins = 2 * np.pi * data.f_hz
    across[caps] = own = 0.5 * disc.changed(bins, float(turn[0].real), complex(turn[1]), speed, lin[caps])
    if (
        data.denoise_correction is not None
    ):  # its mean response is to the whole displacement, as of the laws at a cap: denoise.py
        force -= filtered_series(lambda w: np.interp(w, bins, own), np.asarray(correction).sum(axis=0), data.rate_hz)
    return force, across


def _comb_hz(data: MotionRecord, effects: Iterable[Effect]) -> tuple[float, float] | None:
    """Range of frequencies that a model with a law of the shaft leaves out, Hz; None for other models."""
    return data.disc.comb_hz if data.disc is not None and any(effect.kind == "shaft" for effect in effects) else None


def without_shaft_orders(data: MotionRecord, effects: Iterable[Effect]) -> MotionRecord:
    """Record without the bins at the shaft orders about the disc's resonance; unchanged for other models."""
    comb = _comb_hz(data, effects)
    return data if comb is None else without_bins(data, *comb)


def comb_message(data: MotionRecord, effects: Iterable[Effect]) -> tuple[Message, ...]:
    """Message about the bins that are left out. data : the record of the fit."""
    comb = _comb_hz(data, effects)
    if comb is None or comb[1] < data.band[0] or comb[0] > data.band[1]:
        return ()
    low, high = comb
    text = (
        f"the model has a breathing (cracked) shaft, so {low:.0f} to {high:.0f} Hz are left out of the fit: compare "
        "its likelihood only with models that have it too, as improve does"
    )
    return (Message("shaft_comb_left_out", text),)


def _taken(effect: Effect, p: Array, t: Array, phase: Array) -> Array:
    """(n,) N/m, reduction of the shaft's stiffness by a law."""
    zero = np.zeros(t.size)
    return np.asarray(-force_array(effect, p, np.ones(t.size), zero, zero, zero, t, phase))


@njit(cache=True, error_model="numpy", nogil=True)
def _beside(s0, g, m, C, K, dt, steps):  # type: ignore[no-untyped-def]
    """(n,) N, the force m s1'' / 2 = (g s - C s1' - K s1) / 2. s0 : (2 steps n,) m, at half steps; g : (n,) N/m.

    Each step is that of a linear oscillator with the mean g, exact but for Simpson's rule over its forcing.
    """
    n = g.size
    out = np.empty(n)
    h = dt / steps
    half = 0.5 * C / m
    s = v = 0.0
    for i in range(n):
        out[i] = 0.5 * (g[i] * (s0[2 * steps * i] + s) - C * v - K * s)
        if i + 1 == n:
            break
        rise = (g[i + 1] - g[i]) / steps
        for k in range(steps):
            j = 2 * (steps * i + k)
            ga, gb = g[i] + k * rise, g[i] + (k + 1) * rise
            gm = 0.5 * (ga + gb)
            p = complex(-half, np.sqrt(max((K - gm) / m - half * half, 1e-6 * K / m)))
            e = np.exp(0.5 * h * p)
            q = e * e * complex(v - p.real * s, p.imag * s)  # s' - conj(p) s
            q += h / (6.0 * m) * (e * e * (ga * s0[j]) + 4.0 * e * (gm * s0[j + 1]) + gb * s0[j + 2])
            s = q.imag / p.imag
            v = q.real + p.real * s
    return out
