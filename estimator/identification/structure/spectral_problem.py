"""The spectral problem of the caps of one direction at a fitted model: spectra, dynamic stiffness, start values.

And values whose modes have other forms, which move the cap alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.errors import ModelError
from estimator.likelihood.motion.known_spectra import excitation_shapes, shaft_response
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.background import Background, all_under_bearing
from estimator.model.rig import Model

from .cross_spectra import CrossSpectra, cross_spectra
from .joint_spectrum import MASS_RATIO_LIMITS, JointSpectrum, JointValues, ModePlace, Solution
from .thresholds import LIMITS


def caps_by_direction(places: Sequence[str]) -> list[tuple[int, ...]]:
    """Indices of the places of each direction, such as "bearing1.x" and "bearing2.x": these caps respond together."""
    directions = dict.fromkeys(place[-1] for place in places)
    return [tuple(i for i, place in enumerate(places) if place[-1] == direction) for direction in directions]


def measured_spectra(model: Model, point: WorkingPoint, places: tuple[int, ...]) -> CrossSpectra:
    """The spectral matrices of the caps at some places: of the measured velocity, or of the residual force of laws.

    Where laws act, the residual force and the linearised rotor give the spectra without the harmonics of the laws.
    """
    if point.placed or point.data.background is not None:
        return cross_spectra(
            point.data, point.force, places, lambda f_hz: _acceleration_per_force(model, point, places, f_hz)
        )

    def acceleration_per_velocity(f_hz: Array) -> Complexes:
        return np.asarray(2j * np.pi * f_hz[:, None, None] * np.eye(len(places)), np.complex128)

    return cross_spectra(point.data, point.data.v, places, acceleration_per_velocity)


def spectral_problem(
    model: Model, point: WorkingPoint, spectra: CrossSpectra, channel_of: tuple[int, ...] | None = None,
    loose: tuple[int, ...] = (),
) -> JointSpectrum:  # fmt: skip
    """The spectral problem of the caps of one direction at the mean tangents of a working point.

    channel_of : by place, the place whose channel is there in truth, and with it the tangents; None: its own.
    loose : numbers of the caps among those of the spectra whose mass is fitted.
    """
    data, own = point.data, list(spectra.places)
    tangents_of = own if channel_of is None else [channel_of[i] for i in own]
    s = 2j * np.pi * spectra.f_hz
    across = point.mean_tangent[own][:, own] * (1.0 - np.eye(len(own)))[..., None]
    shaft = _shaft_at(model, point, own, spectra.f_hz)
    Z0 = shaft - _inertia(model, point, own, spectra.f_hz) + across[..., 0] + s[:, None, None] * across[..., 1]
    laws = _law_response(point, spectra.f_hz)[:, tangents_of]
    shape = excitation_shapes(model, data.places, spectra.f_hz)[own].T
    mass = cap_masses(model, point)[own]
    _, c = _start_stiffness_and_damping(point)
    damping0 = np.log(c[tangents_of] * mass / data.mass[tangents_of])
    return JointSpectrum(
        spectra=spectra, Z0=Z0, laws=laws, mass=mass, shape=shape, damping0=damping0, loose=loose, shaft=shaft
    )  # fmt: skip


def cap_masses(model: Model, point: WorkingPoint) -> Array:
    """(places,) kg of the caps; of the working point where the model has none."""
    data = point.data
    return np.array([model.cap_mass(place) or data.mass[i] for i, place in enumerate(data.places)])


def _acceleration_per_force(model: Model, point: WorkingPoint, places: tuple[int, ...], f_hz: Array) -> Complexes:
    """(f, caps, caps) 1/kg, acceleration of the caps at some places per force there, of the linearised rotor."""
    data, own, s = point.data, list(places), 2j * np.pi * f_hz
    D = point.mean_tangent[own][:, own]
    bearings = D[..., 0] + s[:, None, None] * D[..., 1]
    np.einsum("fii->fi", bearings)[...] = point.kL[own] + s[:, None] * point.c[own] + _law_response(point, f_hz)[:, own]
    Z = _shaft_at(model, point, own, f_hz) - _inertia(model, point, own, f_hz)
    if data.background is not None:
        bearings *= data.background.deflections(data.places, s)[:, None, own]
        np.einsum("fii->fi", Z)[...] += data.background.attached_stiffness(data.places, s)[:, own]
    return np.asarray((s * s)[:, None, None] * np.linalg.inv(Z + bearings), np.complex128)


def _shaft_at(model: Model, point: WorkingPoint, own: list[int], f_hz: Array) -> Complexes:
    """(f, caps, caps) N/m, dynamic stiffness of shaft and disc at some places."""
    return np.asarray(shaft_response(model, point.data.places, f_hz)[:, own][:, :, own], np.complex128)


def _inertia(model: Model, point: WorkingPoint, own: list[int], f_hz: Array) -> Array:
    """(f, caps, caps) N/m, inertia force of the caps at some places per displacement."""
    return np.asarray(((2.0 * np.pi * f_hz) ** 2)[:, None, None] * np.diag(cap_masses(model, point)[own]), np.float64)


def _law_response(point: WorkingPoint, f_hz: Array) -> Complexes:
    """(f, places) N/m, mean response of the laws at each place to the deflection of its bearing, without kL and c."""
    if not point.placed:
        return np.zeros((f_hz.size, len(point.data.places)), np.complex128)
    data, s = point.data, 2j * np.pi * point.data.f_hz
    total = -(s * s)[:, None] * (data.mass - np.einsum("fii->fi", point.A)) - np.einsum("fii->fi", data.shaft)
    if data.background is not None:
        total = total / data.background.deflections(data.places, s)
    laws = (total - point.kL - s[:, None] * point.c).T
    return np.array([np.interp(f_hz, data.f_hz, z.real) + 1j * np.interp(f_hz, data.f_hz, z.imag) for z in laws]).T


def start_values(problem: JointSpectrum, point: WorkingPoint) -> JointValues:
    """Values of the fitted model; of a resonance at the middle of the band where the fit has none below its top."""
    own = list(problem.spectra.places)
    power = np.einsum("fii->fi", problem.spectra.psd).real
    least = LIMITS.start_noise_rel * np.min(power / problem.spectra.noise, axis=0)
    noise = np.where(_resonates_below_top(point), point.nu * point.S, 0.0)[own]
    return JointValues(
        force=np.log(point.S[own])[:, None] * problem.flat,
        noise=np.log(np.maximum(noise, least)),
        stiffness=np.log(_start_stiffness_and_damping(point)[0][own]),
        damping=problem.damping0.copy(),
    )


def _start_stiffness_and_damping(point: WorkingPoint) -> tuple[Array, Array]:
    """(places,) N/m and N s/m of the fit; of the middle of the band where the fit has no resonance below its top."""
    low, high = 2.0 * np.pi * np.asarray(point.data.band)
    resonates = _resonates_below_top(point)
    k = np.where(resonates, point.kL, point.data.mass * low * high)
    critical = 2.0 * np.sqrt(k * point.data.mass)
    c = np.where(resonates, point.c, LIMITS.start_damping_ratio * critical)
    return k, np.maximum(c, LIMITS.min_start_damping_ratio * critical)


def _resonates_below_top(point: WorkingPoint) -> NDArray[np.bool_]:
    """(places,) whether a cap alone on its bearing resonates below the top of the band, in the fit."""
    top = point.data.mass * (2.0 * np.pi * point.data.band[1]) ** 2
    return np.asarray((point.kL > LIMITS.min_stiffness_rel * top) & (point.kL < top))


def with_known_background(problem: JointSpectrum, point: WorkingPoint, known: Background | None) -> Solution | None:
    """The problem and its point from a fitted model and a background; None where no cap has one."""
    own = {c: point.data.places[i] for c, i in enumerate(problem.spectra.places)}
    there = {} if known is None else {c: b for c, p in own.items() if (b := known.at.get(p))}
    if not there:
        return None
    octaves, fall = min(b.knot_octaves for b in there.values()), max(b.fall_power for b in there.values())
    problem = replace(problem, octaves=octaves, fall_power=fall)
    values = start_values(problem, point)
    for cap, background in there.items():
        ln_psd = np.log(background.force_shape(problem.spectra.f_hz))
        values.force[cap] += np.linalg.lstsq(problem.basis, ln_psd, rcond=None)[0]
        for m in background.modes:
            q = np.log([m.frequency_hz, m.damping, m.mass / problem.mass[cap]])
            values = values.with_mode(ModePlace(cap, m.form), q)
    return problem, problem.maximised(values)


def smooth_start(
    problem: JointSpectrum, point: WorkingPoint, fall_powers: Sequence[int] = LIMITS.fall_powers
) -> Solution:
    """The likeliest problem with smooth spectra of the forces, and its point without modes at the best of a scan.

    fall_powers : of the frequency in ln S, that are tried.
    """
    tried = [replace(problem, octaves=LIMITS.plain_octaves, fall_power=power) for power in fall_powers]
    values = _with_scanned_stiffness(tried[0], start_values(tried[0], point))
    found = []
    for smooth in tried:
        own = smooth.respaced(values, tried[0])
        own = replace(own, force=own.force + _shape_misfit(smooth, own)[1])
        found.append((smooth, smooth.maximised(own, tolerance_nats=LIMITS.tried_tolerance_nats)))
    return max(found, key=lambda one: one[1].log_likelihood)


def _with_scanned_stiffness(problem: JointSpectrum, values: JointValues) -> JointValues:
    """Values with the stiffness of all bearings, then of each, at which the spectra differ least from their shapes.

    Each cap alone on its bearing resonates in the band.
    """
    part = _thinned(problem, LIMITS.scanned_each)
    low, high = np.log(part.spectra.f_hz[[0, -1]] * LIMITS.scanned_band_rel)
    f = np.linspace(low, high, int((high - low) * LIMITS.scanned_per_e_fold))
    ln_k = np.log(problem.mass)[:, None] + 2.0 * (np.log(2.0 * np.pi) + f)
    caps = range(problem.mass.size)
    for moved in (list(caps), *([cap] for cap in caps), *([cap] for cap in caps)):
        tried = [values, *(_with_stiffness(values, moved, k) for k in ln_k[moved].T)]
        values = tried[int(np.argmin([_shape_misfit(part, v)[0] for v in tried]))]
    return values


def _with_stiffness(values: JointValues, caps: list[int], ln_k: Array) -> JointValues:
    """Values with other stiffness of the bearings of some caps, in logarithms."""
    stiffness = values.stiffness.copy()
    stiffness[caps] = ln_k
    return replace(values, stiffness=stiffness)


def _thinned(problem: JointSpectrum, step: int) -> JointSpectrum:
    """The problem with one of `step` cells, and the last one: the splines depend on the band."""
    last = problem.spectra.f_hz.size - 1
    kept = np.append(np.arange(0, last, step), last)
    cells = {name: getattr(problem.spectra, name)[kept] for name in ("f_hz", "psd", "n", "noise")}
    rotor = {name: getattr(problem, name)[kept] for name in ("Z0", "laws", "shape", "shaft")}
    return replace(problem, spectra=replace(problem.spectra, **cells), **rotor)


def _shape_misfit(problem: JointSpectrum, values: JointValues) -> tuple[float, Array]:
    """Variance of ln(measured / model) that no spectra of the forces explain, summed over caps; infinite for no model.

    And (caps, splines) the change of these spectra that explains the rest.
    """
    problem.work.add(values.force.size)
    try:
        point = problem.at(values)
    except np.linalg.LinAlgError:
        return np.inf, np.zeros_like(values.force)
    ln_power = np.log(np.einsum("fii->fi", point.signal).real + point.N)
    ln_ratio = np.log(np.einsum("fii->fi", problem.spectra.psd).real) - ln_power
    change = np.linalg.lstsq(problem.basis, ln_ratio, rcond=None)[0]
    return float(np.sum(np.var(ln_ratio - problem.basis @ change, axis=0))), np.asarray(change.T)


def in_other_form(problem: JointSpectrum, values: JointValues, k: int) -> JointValues:
    """Values with mode k under the bearing instead of on the cap, or on the cap instead of under the bearing.

    To first order in damping both forms give the same motion of the cap where, of the attached form A and the support
    form B, D_B = D_A + M_A (w_A^2 + 2 zeta_A w_A s), den_A = den_B + D_B / M_B and M_B M_A w_A^4 = kL_B^2.
    """
    cap, form = values.modes[k].cap, values.modes[k].form
    f, zeta, ratio = np.exp(values.q[k])
    kL, c = np.exp(values.stiffness[cap]), np.exp(values.damping[cap])
    M, w2, damp = ratio * problem.mass[cap], (2.0 * np.pi * f) ** 2, 4.0 * np.pi * zeta * f
    if form == "support":
        new_w2, new_damp = w2 + kL / M, damp + c / M
        new_mass = kL**2 / (M * new_w2**2)
        new_kL, new_c = kL - new_mass * new_w2, c - new_mass * new_damp
    else:
        new_kL, new_c = kL + M * w2, c + M * damp
        new_mass = new_kL**2 / (M * w2**2)
        new_w2, new_damp = w2 - new_kL / new_mass, damp - new_c / new_mass
    modes, q = list(values.modes), values.q.copy()
    modes[k] = ModePlace(cap, "attached" if form == "support" else "support")
    q[k] = _mode_values(problem, modes[k], np.sqrt(new_w2) / (2.0 * np.pi), 0.5 * new_damp / np.sqrt(new_w2), new_mass)
    return replace(values.with_bearing(cap, new_kL, max(new_c, LIMITS.min_damping_rel * c)), modes=tuple(modes), q=q)


def under_bearing(problem: JointSpectrum, values: JointValues, cap: int) -> Iterator[JointValues]:
    """Values with all modes of a cap under its bearing, and with all but one of those on it, where that exists.

    A mode on the cap that stays there changes nothing of the others.
    """
    there = {k: mode for k, (at, mode) in enumerate(problem.modes(values)) if at == cap}
    on = [k for k, mode in there.items() if mode.form == "attached"]
    bearing = float(np.exp(values.stiffness[cap])), float(np.exp(values.damping[cap]))
    place = ModePlace(cap, "support")
    for kept in (None, *on) if len(on) > 1 else (None,) * len(on):
        moved = [k for k in there if k != kept]
        try:
            kL, c, under = all_under_bearing(*bearing, [there[k] for k in moved])
        except ModelError:
            continue
        other = values
        for k in reversed(moved):
            other = other.without_mode(k)
        for m in under:
            other = other.with_mode(place, _mode_values(problem, place, m.frequency_hz, m.damping, m.mass))
        yield other.with_bearing(cap, kL, c)


def _mode_values(problem: JointSpectrum, place: ModePlace, f_hz: float, damping: float, mass: float) -> Array:
    """(3,) values of a mode in logarithms, damping ratio and mass (kg) within their limits."""
    ratio = np.clip(mass / problem.mass[place.cap], *MASS_RATIO_LIMITS[place.form])
    return np.log([f_hz, np.clip(damping, *LIMITS.damping_ratio_limits), ratio])
