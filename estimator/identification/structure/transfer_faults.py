"""Biased transfer functions from a measured force to a measured motion: a pedestal, or a faulty sensor.

Each cause biases the tangent of the rotor; stiffness and damping are fitted with it. The known mass identifies a sensor
gain: with gain 1 + error the mass appears as m / (1 + error), and no other cause does this.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import chdtrc

from estimator.arrays import Array, Complexes
from estimator.effects.excitation.pedestal import PEDESTAL
from estimator.effects.sensor.sensor_gain import SENSOR_GAIN
from estimator.effects.sensor.sensor_resonance import SENSOR_RESONANCE
from estimator.effects.sensor.sensor_skew import SENSOR_SKEW
from estimator.identification.finding import UNKNOWN_EFFECT, Finding
from estimator.identification.residual.missing_force import NEGLIGIBLE_FORCE_SHARE
from estimator.likelihood.fitting.transfer_function import (
    PathSpectra,
    Peak,
    clipped_exp,
    fit_linear_path,
    path_spectra_of,
    residual_and_noise,
    residual_power,
)
from estimator.likelihood.motion.harmonics import known_lines
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.parallel import map_processes
from estimator.signals.channel_response import measured_force_places

from .noisy_sensor import find_noisy_sensors_under_force
from .transfer_bias import TransferCause, cause_parameters, fit_cause, transfer_causes

MIN_EXPLAINED_SHARE = 0.5  # of the power that a free response explains, for a cause
MAX_FAULT_P_VALUE = 1e-2  # of a finding
MIN_BIAS_SD = 8.0  # gain of a free response in standard deviations, for a transfer function biased by unknown cause
MIN_CELLS = 100  # of a response that is judged
MIN_NOISE_SHARE = 1e-3  # of the force, in power: less noise biases nothing that would be claimed
DELAY_GAIN_REL = 0.99  # of the gain (nats) of the likeliest cause, that a delay must have
MIN_GAIN_ERROR_REL = 2e-3  # of a sensor gain: less is within any calibration and weighing of a cap
EFFECT_NOTES = {
    PEDESTAL.name: PEDESTAL.distinguish,
    SENSOR_GAIN.name: (
        "a cap mass in the rig file wrong by this factor, or a force channel by the inverse, looks the same"
    ),
    SENSOR_SKEW.name: (
        "a force channel that is early by as much looks the same: only the relative delay is identifiable"
    ),
    SENSOR_RESONANCE.name: SENSOR_RESONANCE.distinguish,
}


def find_transfer_faults(model: Model, point: WorkingPoint, lines: Collection[float] = ()) -> list[Finding]:
    """Pedestals and faulty sensors that the model lacks, at locations whose force is measured.

    lines : Hz of periodic forces in the residual, which are left out.
    """
    at = [i for i, place in enumerate(point.data.places) if place in measured_force_places(model) and point.kL[i] > 0.0]
    seen = map_processes([partial(_findings_at, model, point, i, lines) for i in at])
    heard = {i: own for i, (_, own) in zip(at, seen, strict=True) if own is not None}
    return [s for found, _ in seen for s in found] + find_noisy_sensors_under_force(model, point, heard)


def _findings_at(
    model: Model, point: WorkingPoint, i: int, lines: Collection[float]
) -> tuple[list[Finding], tuple[PathSpectra, Peak, Array] | None]:  # fmt: skip
    """Findings at location i, and the path spectra with their fit and scales if there is none."""
    r = path_spectra_of(point, i, lines)
    if r.n.size < MIN_CELLS:
        return [], None
    tried = likeliest_reading(model, point, i, r)
    found = _place_findings(model, point, i, tried)
    return found, None if found else (tried.response, tried.base, tried.scale)


@dataclass(frozen=True, slots=True)
class TriedCauses:
    """A location's transfer function without a cause and with each cause.

    Attributes
    ----------
    response : PathSpectra
        Spectra from force to motion.
    base : Peak
        The fit without a cause.
    scale : (4,) float64
        Scales of its numbers.
    causes : dict of TransferCause to Peak
        The fit with each cause.
    """

    response: PathSpectra
    base: Peak
    scale: Array
    causes: dict[TransferCause, Peak]

    @property
    def best(self) -> Peak:
        """The fit with the likeliest cause; without a cause if none is likelier."""
        return max(self.causes.values(), key=lambda peak: peak.nats, default=self.base)

    @property
    def late(self) -> bool:
        """Whether a delay is as likely as any cause; a resonance far above the band is hardly likelier."""
        gains = {cause.effect: peak.nats - self.base.nats for cause, peak in self.causes.items()}
        return gains.get(SENSOR_SKEW.name, 0.0) > DELAY_GAIN_REL * max(gains.values(), default=0.0)


def likeliest_reading(model: Model, point: WorkingPoint, i: int, r: PathSpectra) -> TriedCauses:
    """Causes tried with the remaining force read as sensor noise and unmeasured force in their likeliest shares.

    Sensor noise makes the rotor seem lighter and softer by its share of the power of the force.
    """
    noise, _ = fit_linear_path(point, i, r)
    if float(np.average(r.share(clipped_exp(noise.u[0])), weights=r.n)) >= MIN_NOISE_SHARE:
        r = replace(r, unmeasured=_unmeasured_share(point, i, r))
    return _try_causes(model, point, i, r)


def _unmeasured_share(point: WorkingPoint, i: int, r: PathSpectra) -> float:
    """Likeliest share of the remaining force that acts unmeasured beside the measured one.

    The rest is noise of the force sensor.
    """
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda share: -fit_linear_path(point, i, replace(r, unmeasured=float(share)))[0].nats, bounds=(0.0, 1.0),
        method="bounded", options={"xatol": 1e-3},
    )  # fmt: skip
    return float(found.x)


def has_unmeasured_force(model: Model, point: WorkingPoint) -> bool:
    """Whether at some location of known mass more of the remaining force is unmeasured force than sensor noise."""
    lines = known_lines(model)

    def at(i: int) -> bool:
        r = path_spectra_of(point, i, lines)
        return r.n.size >= MIN_CELLS and likeliest_reading(model, point, i, r).response.unmeasured > 0.5

    forced = measured_force_places(model)
    places = [
        i
        for i, place in enumerate(point.data.places)
        if place in forced and model.cap_mass(place) is not None and point.kL[i] > 0.0
    ]
    return any(map_processes([partial(at, i) for i in places]))


def _try_causes(model: Model, point: WorkingPoint, i: int, r: PathSpectra) -> TriedCauses:
    """Fits with every cause that the model lacks at location i."""
    place = point.data.places[i]
    base, scale = fit_linear_path(point, i, r)
    taken = {u.name for u in model.effects if place in u.parameters or place.split(".")[0] in u.parameters}
    taken |= {SENSOR_GAIN.name} if model.cap_mass(place) is None else set()
    causes = [c for c in transfer_causes(point, i, {}) if c.effect not in taken]
    tried = {c: fit_cause(point, i, r, c, base, scale, [np.array(z) for z in c.starts]) for c in causes}
    return TriedCauses(response=r, base=base, scale=scale, causes=tried)


def _place_findings(model: Model, point: WorkingPoint, i: int, at_place: TriedCauses) -> list[Finding]:
    """Findings at location i: the causes that explain the bias, or an unknown one."""
    r, base, tried = at_place.response, at_place.base, at_place.causes
    least = (NEGLIGIBLE_FORCE_SHARE * point.bearing_force[i]) ** 2
    judge = partial(_cause_finding, point, i, r, base, least)
    out = [f for cause, peak in tried.items() for f in judge(cause, peak)]
    late = next((peak for cause, peak in tried.items() if cause.effect == SENSOR_SKEW.name), base)
    if at_place.late and not _is_biased(r, late, least):
        out = [f for f in out if f.effect != SENSOR_RESONANCE.name]
    best = at_place.best
    if not _is_biased(r, best, least):
        gain = next((peak for cause, peak in tried.items() if cause.effect == SENSOR_GAIN.name), None)
        slight = gain is not None and abs(gain.u[4]) < MIN_GAIN_ERROR_REL and not _is_biased(r, gain, least)
        return [] if slight else out
    if out or not _is_biased(r, base, least):
        return out
    power, z = _coherent_power(r, base)
    return [
        Finding(
            effect=UNKNOWN_EFFECT,
            at=(point.data.places[i],),
            gain_nats=z * z / 2,
            dof=r.n.size,
            p_value=float(np.exp(-z * z / 2)),
            power_N2={i: power},
            against="frequency",
            region=_bias_region(r, residual_power(r, base.A), r.A - r.ra / r.aa),
        )
    ]


def _cause_finding(
    point: WorkingPoint, i: int, r: PathSpectra, base: Peak, least: float, cause: TransferCause, peak: Peak
) -> list[Finding]:
    """The finding of a cause at location i in a list, empty if the cause explains too little.

    base : fit without any cause. least : N^2 that matter. peak : fit with the cause.
    """
    before = residual_power(r, base.A)
    coherent = float(r.n @ (coherent_remainder(r, base)[0] / before)) - r.n.size  # beyond chance
    power = float(np.maximum(before - residual_power(r, peak.A), 0.0) @ r.hz)
    explained = float(r.n @ (1 - residual_power(r, peak.A) / before))
    if explained < MIN_EXPLAINED_SHARE * coherent or power < least:
        return []
    gain, q = peak.nats - base.nats, len(cause.names)
    p = float(min(1.0, chdtrc(q, 2 * max(gain, 0.0)) * 4 * len(point.data.places) * len(cause.starts)))
    if p > MAX_FAULT_P_VALUE:
        return []
    place = point.data.places[i]
    return [
        Finding(
            effect=cause.effect,
            at=(place,),
            gain_nats=gain,
            dof=q,
            p_value=p,
            power_N2={i: power},
            against="frequency",
            region=_bias_region(r, before, peak.A),
            settings={place: cause_parameters(cause, peak)},
            note=EFFECT_NOTES[cause.effect],
        )
    ]


def coherent_remainder(r: PathSpectra, peak: Peak) -> tuple[Array, Array]:
    """Power (cells,) of the residual force that is coherent with the motion beyond noise, and power that is not."""
    P, rest, s = residual_and_noise(r, peak.A, peak.u)
    N, Q, H = clipped_exp(peak.u[1]) * r.noise, clipped_exp(peak.u[0]), r.answer(peak.A).conj()
    odd = rest - peak.A * N - r.share(Q) * r.af.conj() - r.unmeasured * Q * H  # what Q is of the force, or moves
    # no more than is left: what is taken for a force beside the measured one may be none, and move nothing
    return np.minimum(np.abs(odd) ** 2 / r.aa, P), np.maximum(s, P - np.abs(rest) ** 2 / r.aa)


def _coherent_power(r: PathSpectra, peak: Peak) -> tuple[float, float]:
    """Power (N^2) of the residual force that is coherent with the motion, and its excess over chance, sd."""
    odd, noise = coherent_remainder(r, peak)
    z = float((r.n @ (odd / noise) - r.n.size) / np.sqrt(r.n.size))  # each an exponential variable of mean 1
    return float((odd - noise / r.n) @ r.hz), z


def _is_biased(r: PathSpectra, peak: Peak, least: float) -> bool:
    """Whether the transfer function is still biased, by more than `least` N^2 and beyond chance."""
    power, z = _coherent_power(r, peak)
    return power > least and z > MIN_BIAS_SD


def _bias_region(r: PathSpectra, before: Array, A: Complexes) -> str:
    """Where the motion deviates most from the response to the measured force, in words."""
    k = int(np.argmax(r.n * np.log(before / residual_power(r, A))))
    return f"the motion does not follow the measured force as the model predicts near {r.w[k] / 2 / np.pi:.0f} Hz"
