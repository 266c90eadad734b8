"""Gauss-Newton fit of all laws of a model to a record.

Each step makes a working point at the present values, takes the step of its likelihood, and renews what of the record
depends on the values: denoised displacement, motion outside the band, below-band motion, level of the excitation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.effects.engine.strength import search_range
from estimator.likelihood.motion.denoise import (
    DenoisingFilter,
    denoising_filter,
    noise_displacement_psd,
    noise_is_negligible,
)
from estimator.likelihood.motion.located_law import (
    LocatedLaw,
    first_stiffness,
    has_nonlinear_memory,
    law_along_record,
    natural_sizes,
)
from estimator.likelihood.motion.motion_record import MotionRecord, leading_blocks, mean_psd
from estimator.likelihood.motion.shaft_law import without_shaft_orders
from estimator.likelihood.path.excitation_level import levels_agree, relative_level
from estimator.likelihood.path.working_point import WorkingPoint, point_at
from estimator.likelihood.response.below_band import with_below_band_motion
from estimator.likelihood.thresholds import LIMITS
from estimator.parallel import map_threads
from estimator.signals.band_limit import out_of_band_sd

from .noise_level import MIN_NOISE_RATIO, sensor_noise_ratio


def fit_model(
    data: MotionRecord, uses: list[LocatedLaw], start: WorkingPoint | None = None, rounds: int = LIMITS.max_rounds,
    moving: float = LIMITS.max_last_step_sd,
) -> WorkingPoint:  # fmt: skip
    """The working point of kL, c, S and every free parameter of the laws, fitted to a record.

    uses : laws with start values. start : working point to begin from; None: no values of the linear part are needed.
    rounds : of steps, at most. moving : size of the last step, standard deviations, that ends the fit before.
    """
    data = without_shaft_orders(data, [use.effect for use in uses])
    if start is None:
        start = _fit_of_parts(data, uses, rounds)
        uses, rounds = (uses, rounds) if start is None else (list(start.placed), LIMITS.max_last_rounds)
    data, kL, c, nu, S = _start_values(data, uses, start)
    del start  # frees its spectra
    moved = np.full(1, np.inf)
    while True:
        data = data if moved.max(initial=0.0) < LIMITS.max_still_step_sd else with_below_band_motion(data, kL, c, uses)
        point = point_at(data, kL, c, nu, S, uses)
        S = point.S
        moved = np.abs(point.fit.delta) / np.sqrt(np.diag(point.fit.covariance))
        moved = moved[: moved.size - 2 * len(data.shared) - len(data.periodic_amplitudes)]
        kL, c, uses = _stepped(point, kL, c)
        mass = _stepped_mass(point)
        nu_old, (nu, weight) = nu, sensor_noise_ratio(point)
        settled = np.allclose(
            nu * weight,
            nu_old * weight,
            rtol=LIMITS.noise_tolerance_rel,
            atol=LIMITS.noise_tolerance_rel * MIN_NOISE_RATIO,
        )
        data, settled = _renewed_record(point, nu, settled)
        if rounds == 0 or (moved.max(initial=0.0) < moving and settled):
            data = _with_leaking_edges(point)
            data = data.with_mass(mass) if data.free_inertia else data
            return replace(point, data=data, kL=kL, c=c, placed=tuple(uses))
        data = data.with_mass(mass) if data.free_inertia else data
        rounds -= 1
        del point  # frees its spectra before the next are made


def _start_values(
    data: MotionRecord, uses: list[LocatedLaw], start: WorkingPoint | None
) -> tuple[MotionRecord, Array, Array, Array, Array]:  # fmt: skip
    """The record with the motion that laws see at the start, and the first kL, c, nu and S, (places,) each."""
    if start is None:
        kL, c, S = _first_linear_values(data)
        around = {} if data.background is None else data.background.at
        nu = np.array([around[p].noise_ratio if p in around else 0.0 for p in data.places])
        return _denoised(replace(data, out_of_band_sd=_out_of_band_sd_at(data, c, kL, S)), nu, S), kL, c, nu, S
    kL, c, nu, S = start.kL.copy(), start.c.copy(), start.nu.copy(), start.S
    if start.data is not data:
        data = data.with_mass(start.data.mass) if data.free_inertia else data
        marked = (d.leaking_edges_hz for d in (data, start.data) if d.leaking_edges_hz)
        edges_hz, outside = tuple(map(max, zip(*marked, strict=True))), start.data.out_of_band_sd
        data = _denoised(replace(data, out_of_band_sd=outside, leaking_edges_hz=edges_hz), nu, start.S)
    known = {u.key for u in start.placed}
    if new := sorted({i for u in uses if u.key not in known for i in u.at}):  # a strong law takes over much of kL and c
        kL[new], c[new] = (values[new] for values in _first_linear_values(data, uses, start.lin)[:2])
    return data, kL, c, nu, S


def _with_leaking_edges(point: WorkingPoint) -> MotionRecord:
    """The record of a point with the edges of the band from which noise leaks there."""
    leakage = point.whitening.leakage
    edges_hz = () if leakage is None or not any(leakage.edges_hz) else leakage.edges_hz
    if edges_hz in ((), point.data.leaking_edges_hz):
        return point.data
    return replace(point.data, leaking_edges_hz=edges_hz)


def _renewed_record(point: WorkingPoint, nu: Array, settled: bool) -> tuple[MotionRecord, bool]:
    """The record of a point with all that depends on its values, and whether that has settled.

    nu : (places,) sensor noise over S. settled : whether the sensor noise has settled.
    """
    data = _with_leaking_edges(point)
    data = data if settled else _denoised(data, nu, point.S)
    outside = _out_of_band_sd(point)
    if not np.allclose(outside, data.out_of_band_sd, rtol=LIMITS.left_out_tolerance_rel, atol=0.0):
        data, settled = replace(data, out_of_band_sd=outside), False
    level = _excitation_level(point)
    if not levels_agree(level, data.level):
        data, settled = replace(data, level=level), False
    return data, settled


def _fit_of_parts(data: MotionRecord, uses: list[LocatedLaw], rounds: int = LIMITS.max_rounds) -> WorkingPoint | None:
    """The fit of a part of a long record; None for a short record.

    Where laws with memory make a step expensive, longer parts follow by one step each.
    """
    lin = np.stack([data.mass, *np.ones((2, len(data.places)))], axis=1)
    dear = any(has_nonlinear_memory(u, lin[u.at[0]]) for u in uses)
    start, seconds = None, LIMITS.first_part_s
    while (start is None or dear) and (part := leading_blocks(data, seconds)) is not data:
        start = fit_model(part, uses, start, rounds if start is None else 0, LIMITS.max_part_step_sd)
        uses, seconds = list(start.placed), LIMITS.part_growth * seconds
    return start


def _first_linear_values(
    data: MotionRecord, uses: Sequence[LocatedLaw] = (), lin: Array | None = None
) -> tuple[Array, Array, Array]:
    """kL by least squares, c of the likeliest single oscillator of that stiffness, and S, (places,) each.

    Least squares is consistent for kL, because E[a v] = 0, and for c where the force is measured. All three are taken
    from the fitted bins, which tones are not in.

    uses : laws whose force, at (places, 3) m, kL, c, is taken out of the balance.
    """
    kL, c, powers = np.zeros((3, len(data.places)))
    for i, place in enumerate(data.places):
        known = data.known[i]
        for use in uses:
            if i in use.at and lin is not None:
                known = known + law_along_record(use, data, i, lin)[0]
        force, x, v = (_start_spectrum(data, z) for z in (known, data.x[i], data.v[i]))
        background = None if data.background is None else data.background.at.get(place)
        free = -np.vdot(x, force).real / np.vdot(x, x).real if background is None else background.stiffness
        kL[i] = data.held.get(f"{place}.kL", free)
        force += kL[i] * x
        if data.measured_force_psd[i] > 0.0:
            damping = np.array([-np.vdot(v, force).real / np.vdot(v, v).real])
        else:
            damping = 2 * np.geomspace(*LIMITS.start_damping_ratios) * np.sqrt(max(kL[i], 0.0) * data.mass[i])
        damping = damping if background is None else np.array([background.damping])
        damping = np.array([data.held[f"{place}.c"]]) if f"{place}.c" in data.held else damping
        Q = np.mean(np.abs(force) ** 2) + damping * (2 * np.vdot(v, force).real + damping * np.vdot(v, v).real) / x.size
        w = 2 * np.pi * data.f_hz
        A = data.mass[i] - kL[i] / w**2 - 1j * damping[:, None] / w
        best = int(np.argmin(np.log(Q) - 2 * np.log(np.abs(A)).mean(axis=1)))
        c[i], powers[i] = damping[best], Q[best]
    return kL, c, powers


def _start_spectrum(data: MotionRecord, series: NDArray[np.floating]) -> Complexes:
    """(blocks, bins) spectra of a series (n,) in some of the blocks; the mean square is the one-sided PSD."""
    some = series.reshape(data.blocks, data.block)[:: max(1, data.blocks // LIMITS.start_blocks)]
    window = np.hanning(data.block)
    scale = np.sqrt(2.0 / (data.rate_hz * np.sum(window**2)))
    return np.asarray(scale * np.fft.rfft(some * window, axis=1)[:, data.bins], np.complex128)


def last_step_sd(point: WorkingPoint) -> float:
    """The largest increment of the last step of a fit, standard deviations."""
    return float((np.abs(point.fit.delta) / np.sqrt(np.diag(point.fit.covariance))).max(initial=0.0))


def _stepped(point: WorkingPoint, kL: Array, c: Array) -> tuple[Array, Array, list[LocatedLaw]]:
    """kL, c and the laws after the step of the fit, searched parameters inside their limits."""
    bounds = [_step_limits(point, use, kL) for use in point.placed]
    limits = {use.name(k): own for use, each in zip(point.placed, bounds, strict=True) for k, own in each.items()}
    step = dict(zip(point.fit.names, step_within_limits(point, limits) * point.fit.scales, strict=True))
    places = point.data.places
    least = np.where(
        point.data.measured_force_psd > 0.0, LIMITS.min_stiffness_share * kL, -np.inf
    )  # a known force forgives no step too far
    kL = np.maximum(kL + np.array([step.get(f"{p}.kL", 0.0) for p in places]), least)
    c = c + np.array([step.get(f"{p}.c", 0.0) for p in places])
    uses = []
    for use, own in zip(point.placed, bounds, strict=True):
        p = use.p + np.array([step.get(use.name(k), 0.0) for k in range(use.p.size)])
        for k, (low, high) in own.items():
            p[k] = np.clip(p[k], use.p[k] + low, use.p[k] + high)
        uses.append(use.with_values(p))
    return kL, c, uses


def _stepped_mass(point: WorkingPoint) -> Array:
    """(places,) kg, masses after the step of the fit; a mass grows or shrinks by max_mass_factor at most."""
    mass, names = point.data.mass.copy(), point.fit.names
    for i in point.data.free_inertia:
        step = point.fit.value(f"{point.data.places[i]}.m")[0] if f"{point.data.places[i]}.m" in names else 0.0
        mass[i] = np.clip(mass[i] + step, mass[i] / LIMITS.max_mass_factor, mass[i] * LIMITS.max_mass_factor)
    return mass


def _step_limits(point: WorkingPoint, use: LocatedLaw, kL: Array) -> dict[int, tuple[float, float]]:
    """Limits of the step of each searched parameter of a law, down and up, by number of the parameter."""
    i = use.at[0]
    natural = natural_sizes(
        point.data, i, kL[i] if kL[i] > 0.0 else first_stiffness(point.data, i)
    )  # of a step too far
    out = {}
    for k, q in enumerate(use.effect.parameters):
        if not q.linear:
            low, high = search_range(q, natural)
            out[k] = min(low - use.p[k], 0.0), max(high - use.p[k], 0.0)
    return out


def step_within_limits(point: WorkingPoint, limits: Mapping[str, tuple[float, float]]) -> Array:
    """(k,) increments of the fit, scaled; those beyond a limit are held at the limit, and the others are refitted.

    limits : by name, least and largest increment in SI units.
    """
    fit = point.fit
    delta, covariance = fit.delta.copy(), fit.covariance.copy()
    loose = {k: np.divide(limits[name], fit.scales[k]) for k, name in enumerate(fit.names) if name in limits}
    while loose:
        beyond = {k: float(np.clip(delta[k], *allowed) - delta[k]) for k, allowed in loose.items()}
        worst = max(beyond, key=lambda k: abs(beyond[k]) / np.sqrt(covariance[k, k]))
        if beyond[worst] == 0.0:
            break
        gain = covariance[:, worst] / covariance[worst, worst]
        delta += gain * beyond[worst]
        covariance -= np.outer(gain, covariance[worst])
        del loose[worst]
    return delta


def _excitation_level(point: WorkingPoint) -> Array | None:
    """(places, blocks) power of the excitation over its mean along the record; None where it is even."""
    data, whitening = point.data, point.whitening
    if data.measured_force:
        return None

    def power(i: int) -> Array:
        own, noise = whitening.power(i, point.spectra[i]), point.S[i] * whitening.noise.share[i].sum()
        return np.asarray(np.maximum(own - noise, 0.1 * own))

    return relative_level(
        np.array(map_threads(power, range(len(data.places)))), data.start / data.rate_hz, data.bins.size
    )


def _out_of_band_sd(point: WorkingPoint) -> Array:
    """(places, 2) sd of displacement and velocity outside the band; the former value while kL or c is negative."""
    data = point.data
    kL, c = np.einsum("iik->ki", point.mean_tangent)
    if not (np.all(kL > 0.0) and np.all(c > 0.0)):
        return data.out_of_band_sd
    return _out_of_band_sd_at(data, c, kL, point.S)


def _out_of_band_sd_at(data: MotionRecord, c: Array, kL: Array, S: Array) -> Array:
    """(places, 2) sd of displacement and velocity outside the band at kL, c and S, (places,) each.

    Below the band a measured force may determine the motion.
    """
    below_band_psd = np.zeros_like(S) if data.below_band_force is None else data.measured_force_psd
    return out_of_band_sd(
        data.mass,
        c,
        kL,
        S + data.measured_force_psd - below_band_psd,
        data.band,
        data.rate_hz,
        data.kinds,
        below_band_psd,
    )


def _denoised(data: MotionRecord, nu: Array, S: Array) -> MotionRecord:
    """The record with its denoised displacement."""
    found = record_denoising_filter(data, nu, S)
    if found is None:
        return replace(data, denoise_correction=None, denoise_sd=0.0)
    return replace(data, denoise_correction=found.of(data.x, data.rate_hz).astype(np.float32), denoise_sd=found.doubt)


def record_denoising_filter(data: MotionRecord, nu: Array, S: Array) -> DenoisingFilter | None:
    """The filter of the displacement that laws see; None where the sensor noise is negligible.

    nu : (places,) sensor noise over S. S : (places,) N^2/Hz.
    """
    noise = noise_displacement_psd(data.kinds, data.f_hz, nu * S) * data.undone_noise_gain
    if noise_is_negligible(data.f_hz, noise, data.rms[0] ** 2):
        return None
    bins = np.arange(data.bins[0], data.bins[-1] + 1)  # also those that are left out: a disc rings there by its noise
    f_hz: Array = np.asarray(bins * (data.rate_hz / data.block), dtype=np.float64)
    smooth = noise * data.f_hz**4
    noise = np.array([np.interp(f_hz, data.f_hz, z) for z in smooth]) / f_hz**4
    return denoising_filter(f_hz, _displacement_psd(data, bins), noise)


def _displacement_psd(data: MotionRecord, bins: NDArray[np.int64]) -> Array:
    """(places, bins) one-sided PSD of the displacement, m^2/Hz, from some of the blocks."""
    some = data.x.reshape(len(data.places), data.blocks, -1)[:, :: max(1, data.blocks // LIMITS.spectrum_blocks)]
    return np.array([mean_psd(x.ravel(), data.block, data.rate_hz)[1][bins] for x in some])
