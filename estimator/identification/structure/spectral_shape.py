"""The spectrum of the residual force: shaped by the excitation, a sensor or a pedestal, or shared by two bearings.

A spectral shape does not depend on the state of the rotor, so none of these causes is a force law. The mean power of
the residual force in narrow cells is compared with each cause by the Whittle likelihood. Stiffness and damping are
fitted again with each cause, as they can hide a shape near the resonance.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from estimator.arrays import Array, Complexes
from estimator.effects import NAMED
from estimator.effects.excitation.correlated_force import CORRELATED_FORCE
from estimator.effects.excitation.pedestal import PEDESTAL
from estimator.effects.sensor.sensor_noise import SENSOR_NOISE
from estimator.effects.sensor.sensor_resonance import SENSOR_RESONANCE
from estimator.identification.finding import OTHER_BEARING, UNKNOWN_EFFECT, Finding, is_cause_of_spectrum
from estimator.likelihood.motion.known_spectra import excitation_shapes
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.whitening.sensor_noise import force_correlation
from estimator.model.rig import MOTION_UNITS, Model
from estimator.results import Parameter
from estimator.signals.channel_response import SHAPE_PARAMETERS, fitted_shape

from .spectral_models import (
    SpectralCells,
    base_model,
    cells_of,
    finite_exp,
    fit_base_model,
    fit_shape,
    mean_power,
    pedestal_at_limit,
    spectral_causes,
)
from .thresholds import LIMITS

ROLL_OFF_NOTE = "the channel rolls off towards the end of the band as behind an anti-alias filter: lower band.high"


def find_spectral_shapes(model: Model, point: WorkingPoint) -> list[Finding]:
    """Shaped excitation, sensor resonances, pedestals, noisy sensors and forces shared by two bearings."""
    data = point.data
    taken = {(u.name, place) for u in model.effects for place in u.parameters}
    out: list[Finding] = []
    noise = np.zeros(len(data.places))
    # shapes taken from the measured spectra, which the model does not have
    seen = data.excitation_shape / excitation_shapes(model, data.places, data.f_hz)
    shaped = set(np.flatnonzero(np.ptp(seen, axis=1) > LIMITS.shape_tolerance_rel * seen.mean(axis=1)).tolist())
    for i, place in enumerate(data.places):
        if data.measured_force_psd[i] > 0.0:  # the residual of a measured force is noise
            shaped.add(i)
            continue
        if point.kL[i] <= 0.0:  # a fit far from the rotor: no resonance to begin from
            continue
        c = cells_of(point, i)
        level, u, scale = fit_base_model(point, i, c)
        noise[i] = finite_exp(u[1])
        df = float(c.n.size - 4)
        off = np.average(np.log(c.power / base_model(c, u)) ** 2 - 1.0 / c.n, weights=c.n)  # without its own scatter
        depth = float(np.sqrt(max(float(off), 0.0)))
        least = LIMITS.max_background_depth_rms if data.background is not None else LIMITS.min_depth_rms
        plain_p = float(chdtrc(df, -2 * level)) * len(data.places)
        if plain_p > LIMITS.max_screened_p_value or depth < least:
            continue
        own = _shape_findings(point, i, c, u, level, scale, {e for e, p in taken if p in (place, place.split(".")[0])})
        if plain_p > LIMITS.max_shape_p_value and min((f.p_value for f in own), default=1.0) > LIMITS.max_shape_p_value:
            continue
        shaped.add(i)
        out += own or ([_unknown_finding(point, i, c, u, level)] if depth > LIMITS.min_unknown_depth_rms else [])
    out += find_noisy_sensors(model, point, noise, shaped)
    return out + _find_shared_force(model, point)


def nats_of_one_cause(model: Model, point: WorkingPoint, *, several_modes: bool) -> float | None:
    """Nats that one cause of the catalogue gains if it explains the spectral shapes of all locations; 0 if none does.

    None where no location has a spectral shape. several_modes : whether a cause that adds one mode is none.
    """
    found = find_spectral_shapes(model, point)
    shaped = {place for f in found for place in f.power_N2 if is_cause_of_spectrum(f.effect)}
    if not shaped:
        return None
    gains = [0.0]
    refused = {name for name, e in NAMED.items() if e.adds_resonance} if several_modes else set()
    for effect in {f.effect for f in found} - refused:
        own = [f for f in found if f.effect == effect and f.explained_share > LIMITS.explained_share]
        if {place for f in own for place in f.power_N2} >= shaped:
            gains.append(sum(f.gain_nats for f in own))
    return max(gains)


def _shape_findings(
    point: WorkingPoint, i: int, c: SpectralCells, u: Array, level: float, scale: Array, taken: set[str]
) -> list[Finding]:
    """Findings of all causes of the spectral shape at location i, except effects in `taken`.

    u, level, scale : numbers, log-likelihood and scales of the base model.
    """
    data = point.data
    place = data.places[i]
    out = []
    r = c.power / base_model(c, u)
    predictable = _predictable_power(point, i, c, r)
    for shape in spectral_causes(point, i):
        if shape.effect.name in taken:
            continue
        found, z, sd = fit_shape(c, shape, u, scale)
        gain = found - level
        if gain < LIMITS.min_explained_share * (-level - 0.5 * (c.n.size - 4)):
            continue
        if shape.effect is PEDESTAL and (pedestal_at_limit(z[4:]) or _bearing_drives_rotor(point, i, z, sd)):
            continue
        q = len(shape.effect.parameters)
        values = shape.values(z[4:])
        peaks = shape.effect is SENSOR_RESONANCE and values[1] >= LIMITS.min_peak_quality
        if peaks and values[0] < LIMITS.min_mounting_resonance_hz:
            continue
        spread = np.abs(shape.values(z[4:] + 1e-3) - values) / 1e-3 * sd[4:]
        settings = {
            own.name: replace(Parameter.from_estimate(float(v), float(s), own.unit), value=float(v), sd=float(s))
            for own, v, s in zip(shape.effect.parameters, values, spread, strict=True)
        }
        p = float(min(1.0, chdtrc(q, 2 * max(gain, 0.0)) * 3 * len(data.places) * len(shape.starts)))
        falls_only = values[0] > data.band[1] and values[1] < LIMITS.min_peak_quality
        no_peak = shape.effect is SENSOR_RESONANCE and falls_only
        out.append(
            Finding(
                effect=shape.effect.name,
                at=(place,),
                gain_nats=gain,
                dof=q + 2,
                p_value=p,
                power_N2={i: predictable},
                against="frequency",
                region=_misfit_region(c, r),
                explained_share=gain / max(-level - 0.5 * (c.n.size - 4), 1.0),
                settings={place: settings},
                note=ROLL_OFF_NOTE if no_peak else "",
            )
        )
    return out


def _bearing_drives_rotor(point: WorkingPoint, i: int, z: Array, sd: Array) -> bool:
    """Whether stiffness or damping of the bearing beside a cause is negative; the cause is then a peak of the force.

    z, sd : numbers of the base model with the cause, and their standard deviations.
    """
    k, c = point.kL[i] + z[2], point.c[i] + z[3]
    return bool(k < -LIMITS.negative_margin_sd * sd[2] or c < -LIMITS.negative_margin_sd * sd[3])


def _unknown_finding(point: WorkingPoint, i: int, c: SpectralCells, u: Array, level: float) -> Finding:
    """The finding of a spectral shape that no cause of the catalogue explains."""
    r, df = c.power / base_model(c, u), c.n.size - 4
    place = point.data.places[i]
    p = float(min(1.0, chdtrc(df, -2 * level) * len(point.data.places)))
    power = {i: _predictable_power(point, i, c, r)}
    return Finding(
        effect=UNKNOWN_EFFECT,
        at=(place,),
        gain_nats=-level - 0.5 * df,
        dof=df,
        p_value=p,
        power_N2=power,
        against="frequency",
        region=f"{place}: {_misfit_region(c, r)}",
    )


def _predictable_power(point: WorkingPoint, i: int, c: SpectralCells, r: Array) -> float:
    """Power (N^2) of the force at location i that is predictable from its past, with a spectrum as r (cells,)."""
    weight = c.n / c.n.sum()
    return float(1 - np.exp(weight @ np.log(r)) / (weight @ r)) * _force_variance(point, i)


def _force_variance(point: WorkingPoint, i: int) -> float:
    """Mean square of the force at location i within the band, N^2."""
    return float(mean_power(point, i).sum()) * point.data.rate_hz / point.data.block


def _misfit_region(c: SpectralCells, r: Array) -> str:
    """Where the spectrum differs most from the model, in words. r : (cells,) measured power over the model's."""
    k = int(np.argmax(np.abs(np.log(r)) * np.sqrt(c.n)))
    return f"force spectrum {'above' if r[k] > 1 else 'below'} the model near {c.w[k] / 2 / np.pi:.0f} Hz"


def _find_shared_force(model: Model, point: WorkingPoint) -> list[Finding]:
    """Forces shared by the two bearings, from the coherence of their residual forces, by direction."""
    data = point.data
    out = []
    have = {p for u in model.effects if u.name == CORRELATED_FORCE.name for p in u.parameters}
    for i, place in enumerate(data.places):
        j = data.opposite(i)
        if j is None or j < i or place in have or data.measured_force_psd[i] > 0.0 or data.measured_force_psd[j] > 0.0:
            continue
        noise, (a, b) = point.whitening.noise, (point.spectra[k].view(np.complex64) for k in (i, j))
        shape = force_correlation(data, noise.weight, i, j)
        own = np.broadcast_to(noise.correlation(i, j), shape.shape)
        both = np.einsum("bk,bk->k", a, b.conj()) / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real) * shape.size
        square = float(np.vdot(shape, shape).real)
        rho = float(np.vdot(shape, both - own).real) / square
        n = len(a) * square
        gain = -n * float(np.log(max(1 - rho**2, 1e-12)))
        p = float(min(1.0, chdtrc(1, 2 * gain) * len(data.places)))
        if p > LIMITS.max_shape_p_value or abs(rho) < 0.02:
            continue
        power = {k: rho**2 * _force_variance(point, k) for k in (i, j)}
        sd = (1 - rho**2) / np.sqrt(2 * n)
        out.append(
            Finding(
                effect=CORRELATED_FORCE.name,
                at=(place,),
                gain_nats=gain,
                dof=1,
                p_value=p,
                power_N2=power,
                against=OTHER_BEARING,
                region=f"the forces at {place} and {data.places[j]} are correlated by {100 * rho:.0f} %",
                settings={place: {"rho": Parameter(rho, float(sd), "1")}},
                note=CORRELATED_FORCE.distinguish,
                detectable=(float(5 / np.sqrt(2 * n)), "1"),
                folds=_gain_by_part(a, b, shape, own),
            )
        )
    return out


def _gain_by_part(
    a: NDArray[np.complexfloating], b: NDArray[np.complexfloating], shape: Complexes, noise: Complexes
) -> tuple[float, ...]:
    """Nats gained in each part of the band by the correlation of two forces that the other parts show.

    A shared white force has one correlation in all of the band. A wrong model of the structure has one where it is
    wrong.

    a, b : (blocks, bins) spectra of the forces. shape : (bins,) correlation by bin where they are one. own : (bins,)
    that of the noise.
    """
    seen, weight = np.zeros(LIMITS.band_parts), np.zeros(LIMITS.band_parts)
    for k, part in enumerate(np.array_split(np.arange(shape.size), LIMITS.band_parts)):
        x, y, s = a[:, part], b[:, part], shape[part]
        both = np.einsum("bk,bk->k", x, y.conj()) / np.sqrt(np.vdot(x, x).real * np.vdot(y, y).real) * part.size
        seen[k], weight[k] = np.vdot(s, both - noise[part]).real, np.vdot(s, s).real
    others = (seen.sum() - seen) / (weight.sum() - weight)
    return tuple((len(a) * (2.0 * others * seen - others**2 * weight)).tolist())


def find_noisy_sensors(model: Model, point: WorkingPoint, noise: Array, shaped: Collection[int]) -> list[Finding]:
    """Sensors whose noise exceeds that of other sensors of the same kind.

    noise : (places,) PSD of the sensors' noise in their own unit. shaped : locations whose spectrum differs from that
    of white force and white noise: their noise is not known. A location whose spectral shape the model has is no
    reference for others, as the two numbers of the shape take up the noise.
    """
    data = point.data
    out, noise_gain = [], data.noise_referred_to_force(point.A)
    have = {place for u in model.effects if u.name == SENSOR_NOISE.name for place in u.parameters}
    known = [k for k in range(len(data.places)) if k not in shaped]
    plain = [k for k in known if not any(fitted_shape(model, data.places[k], name) for name in SHAPE_PARAMETERS)]
    for i in known:
        place, kind = data.places[i], data.kinds[i]
        of_others = noise[[k for k in plain if k != i and data.kinds[k] == kind]]
        if of_others.size == 0 or place in have:
            continue
        # noise counts where it is loudest: that of an accelerometer low in the band, that of displacement at its top
        floor = max(float(np.median(of_others)), 0.2 * point.S[i] / float(noise_gain[i].max()))
        if noise[i] < LIMITS.min_noise_ratio_to_others * floor:
            continue
        rms = float(np.sqrt(noise[i] * data.rate_hz / 2))
        gain = 0.5 * data.blocks * float(np.sum(np.log1p(noise[i] * noise_gain[i] / point.S[i]) ** 2) / 2)
        sd, ratio = rms / np.sqrt(2 * max(gain, 1.0)), np.sqrt(noise[i] / floor)
        name, unit = next(c.name for c in model.channels if c.place == place), MOTION_UNITS[data.kinds[i]]
        out.append(
            Finding(
                effect=SENSOR_NOISE.name,
                at=(place,),
                gain_nats=gain,
                dof=1,
                p_value=float(np.exp(-min(gain, 700.0))),
                power_N2={i: float(noise[i] * np.mean(noise_gain[i]) * (data.band[1] - data.band[0]))},
                against="frequency",
                region=f"noise of {name}: {rms:.2g} {unit} rms, over {ratio:.1f} times that of its neighbours",
                settings={place: {"rms": Parameter(rms, float(sd), unit)}},
            )
        )
    return out


def sensor_noise_rms(point: WorkingPoint, i: int) -> Parameter:
    """Rms of the noise of a location's sensor over the whole band, if the noise is white, in the sensor's unit."""
    data = point.data
    density = point.nu[i] * point.S[i]
    floor = density * data.noise_referred_to_force(point.A)[i]
    share = floor / (point.S[i] * data.excitation_shape[i] + floor)
    sd = 1.0 / np.sqrt(max(data.blocks * float(np.sum(share**2)), 1e-300))  # of ln(density), by the Whittle likelihood
    rms = float(np.sqrt(density * data.rate_hz / 2))
    return Parameter.from_estimate(rms, 0.5 * rms * sd, MOTION_UNITS[data.kinds[i]])
