"""Displacement below the band, which no accelerometer measures: computed from the laws and the known forces.

A law phi with an even part (quadratic, one-sided stop) moves the cap off its centre, further while the vibration is
stronger: x_slow = -h(phi(x + x_slow)). h is the compliance of the rotor below the band; through the shaft it also acts
on the opposite cap. Without this displacement the coefficient of the law is biased by some per cent. A hysteresis moves
the cap by loops that end off the centre. A periodic force below the band, such as an imbalance, moves the working point
of every law. So does a measured force below the band.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.law_loop import force_array
from estimator.effects.engine.memory_loop import memory_array
from estimator.likelihood.motion.located_law import LocatedLaw, has_nonlinear_memory, law_along_record
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.thresholds import LIMITS
from estimator.model.effect import Effect
from estimator.parallel import map_threads
from estimator.signals.band_limit import unmeasured_gain

from .modal_response import compliance


def has_even_part(effect: Effect, p: Array, sizes: Array) -> bool:
    """Whether a law has a part that is even in the motion. sizes : (4,) rms of x, v, xo, vo, m and m/s."""
    if effect.kind != "force" or effect.force is None:
        return False
    x, v, xo, vo = np.random.default_rng(0).normal(size=(4, LIMITS.tried_states)) * sizes[:, None]
    there, back = force_array(effect, p, x, v, xo, vo), force_array(effect, p, -x, -v, -xo, -vo)
    return bool(np.abs(there + back).max() > LIMITS.min_even_part_rel * np.abs(there - back).max() + 1e-300)


def usual_parameters(effect: Effect) -> Array:
    """(k,) default parameters of a law, in natural sizes."""
    return np.array([1.0 if q.linear else q.default for q in effect.parameters])


def usual_sizes(effect: Effect) -> Array:
    """(4,) sizes of x, v, xo, vo that fit the default parameters of a law (a user's law has lengths in m)."""

    def of(unit: str) -> float:
        return max((abs(q.default) for q in effect.parameters if q.unit == unit and q.default), default=1.0)

    return np.array([of("m"), of("m/s")] * 2)


def below_band_displacement(load: Mapping[int, Array], data: MotionRecord, D: Array) -> dict[int, Array]:
    """(n,) m by place, unmeasured displacement below the band under restoring forces `load` (n,) N by place.

    D : (places, places, 2) mean tangents by displacement and velocity, N/m and N s/m.
    """
    from scipy.fft import irfft, next_fast_len, rfft

    n, low = data.x.shape[1], data.band[0]
    size = next_fast_len(n, real=True)
    f: Array = np.asarray(np.fft.rfftfreq(size, 1 / data.rate_hz)[: int(low * size / data.rate_hz) + 1], np.float64)
    unmeasured = [np.where(f < low, unmeasured_gain(f, data.rate_hz, data.band, kind), 0.0) for kind in data.kinds]
    G = np.stack(unmeasured, axis=1)[..., None] * compliance(2 * np.pi * f, data.mass, D, data.rotor)
    forces = {j: np.asarray(rfft(one, size)[: f.size]) for j, one in load.items()}
    there = [i for i in range(G.shape[1]) if G[:, i, list(forces)].any()]
    F = np.stack([*forces.values()], axis=1)
    return {i: irfft(-(G[:, i, list(forces)] * F).sum(axis=1), size)[:n] for i in there}


def with_below_band_motion(data: MotionRecord, kL: Array, c: Array, uses: Sequence[LocatedLaw]) -> MotionRecord:
    """Record with the displacement below the band: measured, and from laws and measured forces.

    If a cap resonates below the band, measured forces are neglected there: the response at the resonance is not
    identified by the band. kL : (places,) N/m; c : (places,) N s/m.
    """
    lin = np.stack([data.mass, kL, c], axis=1)
    own = [[u for u in uses if i in u.at and u.p.any() and _is_slow(u, data, i, lin)] for i in range(len(data.places))]
    if not any(own) and data.below_band_force is None:
        return data
    for _ in range(1 if data.below_band_force is None else LIMITS.measured_force_rounds):
        load, tangents = _slow_force(data, own, lin)
        D = np.stack([np.diag(kL), np.diag(c)], axis=-1)
        if data.below_band_force is not None:  # the caps then move much, and a strong law answers as its mean tangent
            D[..., 0] += tangents
            if not _above(data, np.diag(D[..., 0])):
                return with_below_band_motion(replace(data, slow=data.measured, below_band_force=None), kL, c, uses)
            before = np.zeros(data.x.shape, np.float32) if data.slow is None else data.slow
            load = {i: load.get(i, 0.0) - tangents[i] @ before - force for i, force in enumerate(data.below_band_force)}
        slow = np.zeros(data.x.shape, np.float32)
        if load:
            for i, x in below_band_displacement(load, data, D).items():
                slow[i] += x
        if data.measured is not None:
            slow += data.measured
        data = replace(data, slow=slow)
    return data


def _above(data: MotionRecord, k: Array) -> bool:
    """Whether every cap resonates above the lower band edge. k : (places,) N/m, stiffness of the bearing."""
    held = 0.0 if data.rotor is None else data.rotor.held[0]
    return bool(np.all(k + held > data.mass * (2 * np.pi * data.band[0]) ** 2))


def _is_slow(use: LocatedLaw, data: MotionRecord, i: int, lin: Array) -> bool:
    """Whether a law makes displacement below the band, or acts on the displacement of a measured force."""
    if use.effect.kind == "force":
        return data.below_band_force is not None or has_even_part(use.effect, use.p, data.sizes(i))
    return has_nonlinear_memory(use, lin[i])


def _slow_force(data: MotionRecord, own: Sequence[Sequence[LocatedLaw]], lin: Array) -> tuple[dict[int, Array], Array]:
    """Force (n,) N of the laws by place, and (places, places) N/m their mean tangents to the displacements."""

    def force(use: LocatedLaw, i: int) -> tuple[Array, Array]:
        if use.effect.kind == "force":
            f, slopes, _ = law_along_record(use, data, i, lin)
            return f, slopes[:, 0]
        return memory_array(use.effect, use.p, lin[i], data.displacement(i), data.v[i], data.rate_hz), np.zeros(
            len(own)
        )

    def at(i: int) -> tuple[Array, Array]:
        forces, slopes = zip(*(force(u, i) for u in own[i]), strict=True)
        return np.asarray(np.sum(forces, axis=0)), np.asarray(np.sum(slopes, axis=0))

    there = [i for i, laws in enumerate(own) if laws]
    found = dict(zip(there, map_threads(at, there), strict=True))
    tangents = np.zeros((len(own), len(own)))
    for i, (_, slopes) in found.items():
        tangents[i] = slopes
    return {i: f for i, (f, _) in found.items()}, tangents
