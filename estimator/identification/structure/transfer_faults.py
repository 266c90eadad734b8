"""What bends the path from a measured force to a measured motion: a pedestal, or a sensor that is wrong.

Each is tried as the A' of transfer_function.py, stiffness and damping fitted beside it. The known mass is what tells
a gain: measured with the gain 1 + error, the rotor's mass seems to be m / (1 + error), and nothing else changes that.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from estimator.arrays import Array, Complexes
from estimator.effects import CATALOGUE
from estimator.identification.finding import UNKNOWN_EFFECT, Finding
from estimator.identification.residual.missing_force import NEGLIGIBLE_FORCE_SHARE
from estimator.likelihood.fitting.folded_force import of_late_sensor
from estimator.likelihood.fitting.path_spectra import PathSpectra
from estimator.likelihood.fitting.transfer_function import (
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
from .transfer_bias import CAUSE_NUMBERS, Cause, cause_parameters, fit_cause, transfer_causes

MIN_EXPLAINED_SHARE = 0.5  # of the power that a free response explains, for a cause
MAX_FAULT_P_VALUE = 1e-2  # of a finding
MAX_PAIR_LEFT_REL = 0.5  # power left by two causes together over that left by the best one
MIN_BIAS_SD = 8.0  # gain of a free response in standard deviations, for a transfer function biased by unknown cause
MIN_CELLS = 100  # of a response that is judged
MIN_NOISE_SHARE = 1e-3  # of the force, in power: less noise biases nothing that would be claimed
# A gain makes a wrong reading of the noise likelier than the right one, by half of p in each cell, as |f|^2 is noisy
# there: 14 to 197 nats in records with 2 to 30 % of noise, whatever their length.
MIN_CAUSE_GAIN_NATS = 250.0
READING_TOLERANCE_NATS = 10.0  # within which the remaining force is read as sensor noise
DELAY_GAIN_REL = 0.99  # of the gain (nats) of the likeliest cause, that a delay must have
MIN_GAIN_ERROR_REL = 2e-3  # of a sensor gain: less is within any calibration and weighing of a cap
EFFECT_NOTES = {
    "pedestal": CATALOGUE["pedestal"].distinguish,
    "sensor_gain": "a cap mass in the rig file wrong by this factor, or a force channel by the inverse, looks the same",
    "sensor_skew": "a force channel that is early by as much looks the same: only the relative delay is identifiable",
    "sensor_resonance": CATALOGUE["sensor_resonance"].distinguish,
}


def find_transfer_faults(model: Model, point: WorkingPoint, lines: Collection[float] = ()) -> list[Finding]:
    """Pedestals and faulty sensors that the model does not have, at places whose force is measured.

    lines : Hz of what is periodic in the residual, which is left out.
    """
    at = [i for i, place in enumerate(point.data.places) if place in measured_force_places(model) and point.kL[i] > 0.0]
    seen = map_processes([partial(_findings_at, model, point, i, lines) for i in at])
    heard = {i: own for i, (_, own) in zip(at, seen, strict=True) if own is not None}
    return [s for found, _ in seen for s in found] + find_noisy_sensors_under_force(model, point, heard)


def _findings_at(
    model: Model, point: WorkingPoint, i: int, lines: Collection[float]
) -> tuple[list[Finding], tuple[PathSpectra, Peak, Array] | None]:  # fmt: skip
    """What bends the path at a place; the response as it is without, where nothing does."""
    r = path_spectra_of(point, i, lines)
    if r.n.size < MIN_CELLS:
        return [], None
    tried = likeliest_reading(model, point, i, r)
    if (beside := _with_rival_folding(model, point, i, tried)) is not None:
        tried = beside
    elif late := of_late_sensor(r, point.data.rate_hz):
        delayed = likeliest_reading(model, point, i, late)
        tried = delayed if delayed.late and delayed.nats > tried.nats else tried
    found = _place_findings(model, point, i, tried)
    return found, None if found else (tried.response, tried.base, tried.scale)


def _with_rival_folding(model: Model, point: WorkingPoint, i: int, tried: TriedCauses) -> TriedCauses | None:
    """The same beside what is folded back, where that and noise of the sensor are as likely by their coherence with the
    motion: where no cause explains what bends the path, it is the one beside which nothing does."""
    r, least = tried.response, (NEGLIGIBLE_FORCE_SHARE * point.bearing_force[i]) ** 2
    if r.fold is None or r.fold.rival is None:
        return None
    if not all(_is_biased(r, peak, least) for peak in (tried.base, tried.best)):
        return None
    beside = likeliest_reading(model, point, i, r.less(replace(r.fold, density=r.fold.rival)))
    return None if _is_biased(beside.response, beside.base, least) else replace(beside, causes={})


@dataclass(frozen=True, slots=True)
class TriedCauses:
    """A place without a cause, `base`, and with each. likely : nats of the best, less what it is to bring."""

    response: PathSpectra
    base: Peak
    scale: Array
    causes: dict[Cause, Peak]

    @property
    def best(self) -> Peak:
        """With the likeliest cause."""
        return max(self.causes.values(), key=lambda peak: peak.nats, default=self.base)

    @property
    def nats(self) -> float:
        return max(self.base.nats, self.best.nats)

    @property
    def late(self) -> bool:
        """Whether a delay is as likely as any cause; a resonance far above the band is hardly likelier."""
        gains = {cause.effect: peak.nats - self.base.nats for cause, peak in self.causes.items()}
        return gains.get("sensor_skew", 0.0) > DELAY_GAIN_REL * max(gains.values(), default=0.0)

    @property
    def likely(self) -> float:
        return max(self.base.nats, self.best.nats - MIN_CAUSE_GAIN_NATS) - READING_TOLERANCE_NATS * (
            self.response.unmeasured > 0.0
        )


def likeliest_reading(model: Model, point: WorkingPoint, i: int, r: PathSpectra) -> TriedCauses:
    """What is left of the force at a place, where it is enough to matter, read as noise of its sensor, as a force that
    acts beside it, or as both. The first makes the rotor seem lighter and softer by its share of the force, in power.
    """
    noise = _try_causes(model, point, i, r)
    if float(np.average(r.share(clipped_exp(noise.base.u[0])), weights=r.n)) < MIN_NOISE_SHARE:
        return noise
    beside = _try_causes(model, point, i, replace(r, unmeasured=1.0), noise.causes)
    either = noise, beside
    share = _unmeasured_share(point, i, r)
    both = fit_linear_path(point, i, replace(r, unmeasured=share))[0].nats
    if both < max(tried.base.nats for tried in either) + READING_TOLERANCE_NATS:
        return max(either, key=lambda tried: tried.likely)
    mixed = _try_causes(model, point, i, replace(r, unmeasured=share), noise.causes)
    return max(*either, mixed, key=lambda tried: tried.likely)


def _unmeasured_share(point: WorkingPoint, i: int, r: PathSpectra) -> float:
    """Of what is left, the likeliest share that acts beside the measured force; the rest is noise of its sensor."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda share: -fit_linear_path(point, i, replace(r, unmeasured=float(share)))[0].nats, bounds=(0.0, 1.0),
        method="bounded", options={"xatol": 1e-3},
    )  # fmt: skip
    return float(found.x)


def has_unmeasured_force(model: Model, point: WorkingPoint) -> bool:
    """Whether somewhere more of what is left acts beside the measured force than is noise of its sensor, as far as the
    known mass tells."""
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


def _try_causes(
    model: Model, point: WorkingPoint, i: int, r: PathSpectra, about: Mapping[Cause, Peak] | None = None
) -> TriedCauses:  # fmt: skip
    """Every cause that the model does not have at a place. about : where they are by another reading of what is left,
    which moves them little."""
    place = point.data.places[i]
    base, scale = fit_linear_path(point, i, r)
    taken = {u.name for u in model.effects if place in u.parameters or place.split(".")[0] in u.parameters}
    taken |= {"sensor_gain"} if model.cap_mass(place) is None else set()
    if about is None:
        starts = {c: [np.array(z) for z in c.starts] for c in transfer_causes(point, i, {}) if c.effect not in taken}
    else:
        starts = {cause: [peak.u[CAUSE_NUMBERS]] for cause, peak in about.items()}
    tried = {cause: fit_cause(point, i, r, cause, base, scale, own) for cause, own in starts.items()}
    return TriedCauses(r, base, scale, tried)


def _place_findings(model: Model, point: WorkingPoint, i: int, at_place: TriedCauses) -> list[Finding]:
    """Findings at a place: one cause, two together where one leaves much, or a transfer function of unknown cause."""
    r, base, scale, tried = at_place.response, at_place.base, at_place.scale, at_place.causes
    least = (NEGLIGIBLE_FORCE_SHARE * point.bearing_force[i]) ** 2
    judge = partial(_cause_finding, point, i, r, base, least)
    out = [f for cause, peak in tried.items() for f in judge(cause, CAUSE_NUMBERS, peak, base)]
    late = next((peak for cause, peak in tried.items() if cause.effect == "sensor_skew"), base)
    if at_place.late and not _is_biased(r, late, least):
        out = [f for f in out if f.effect != "sensor_resonance"]
    best = at_place.best
    if not _is_biased(r, best, least):
        gain = next((peak for cause, peak in tried.items() if cause.effect == "sensor_gain"), None)
        slight = gain is not None and abs(gain.u[4]) < MIN_GAIN_ERROR_REL and not _is_biased(r, gain, least)
        return [] if slight else out
    near = {(a, b): _fit_two_causes(point, i, r, a, b, tried, scale).nats for a, b in combinations(tried, 2)}
    if near:
        a, b = max(near, key=lambda pair: near[pair])
        peak = _fit_two_causes(point, i, r, a, b, tried, scale, everywhere=True)
        k = 4 + len(a.names)
        two = judge(a, slice(4, k), peak, tried[b]) + judge(b, slice(k, None), peak, tried[a])
        if two and float(residual_power(r, peak.A) @ r.hz) < MAX_PAIR_LEFT_REL * float(
            residual_power(r, best.A) @ r.hz
        ):
            return two
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
    point: WorkingPoint, i: int, r: PathSpectra, base: Peak, least: float, cause: Cause, part: slice, peak: Peak,
    without: Peak,
) -> list[Finding]:  # fmt: skip
    """The finding of a cause at a place, empty if it explains too little.

    base : without any cause. least : N^2 that matter. part : where the numbers of the cause are in the peak. without :
    the peak that its gain is counted from.
    """
    before = residual_power(r, base.A)
    coherent = float(r.n @ (coherent_remainder(r, base)[0] / before)) - r.n.size  # beyond chance
    power = float(np.maximum(before - residual_power(r, peak.A), 0.0) @ r.hz)
    explained = float(r.n @ (1 - residual_power(r, peak.A) / before))
    if explained < MIN_EXPLAINED_SHARE * coherent or power < least:
        return []
    gain, q = peak.nats - without.nats, len(cause.names)
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
            settings={place: cause_parameters(cause, peak, part)},
            note=EFFECT_NOTES[cause.effect],
        )
    ]


def _fit_two_causes(
    point: WorkingPoint, i: int, r: PathSpectra, a: Cause, b: Cause, alone: Mapping[Cause, Peak], scale: Array,
    everywhere: bool = False,
) -> Peak:  # fmt: skip
    """The likeliest numbers of two causes together, begun where each is by itself; everywhere : or where the one is and
    the other at its starts."""
    k = len(a.names)

    def apart(of_a: Callable[[Array], Array], of_b: Callable[[Array], Array]) -> Callable[[Array], Array]:
        return lambda z: np.concatenate([of_a(z[:k]), of_b(z[k:])])

    def bend(r: PathSpectra, A: Complexes, kL: float, c: float, p: Array) -> Complexes:
        return b.bend(r, a.bend(r, A, kL, c, p[:k]), kL, c, p[k:])

    pair = Cause(a.effect, (), apart(a.values, b.values), apart(a.free, b.free), bend)

    def begun(first: Peak, *starts: tuple[Array, Array]) -> Peak:
        return fit_cause(point, i, r, pair, first, scale, [np.concatenate(start) for start in starts])

    at_a, at_b = alone[a].u[CAUSE_NUMBERS], alone[b].u[CAUSE_NUMBERS]
    if not everywhere:
        return begun(alone[a], (at_a, at_b))
    beside_a = begun(alone[a], *((at_a, np.array(z)) for z in b.starts))
    beside_b = begun(alone[b], *((np.array(z), at_b) for z in a.starts))
    return max(beside_a, beside_b, key=lambda peak: peak.nats)


def coherent_remainder(r: PathSpectra, peak: Peak) -> tuple[Array, Array]:
    """(cells,) of the power that is left what is coherent with the motion beyond the noise in both, and what is not."""
    P, rest, s = residual_and_noise(r, peak.A, peak.u)
    N, Q, H = clipped_exp(peak.u[1]) * r.noise, clipped_exp(peak.u[0]), r.answer(peak.A).conj()
    odd = rest - peak.A * N - r.share(Q) * r.af.conj() - r.unmeasured * Q * H  # what Q is of the force, or moves
    odd -= (peak.A - r.alike) * (1 - H * np.conj(r.alike)) * r.folded
    # no more than is left: what is taken for a force beside the measured one may be none, and move nothing
    return np.minimum(np.abs(odd) ** 2 / r.aa, P), np.maximum(s, P - np.abs(rest) ** 2 / r.aa)


def _coherent_power(r: PathSpectra, peak: Peak) -> tuple[float, float]:
    """N^2 that is coherent with the motion still, and by how many standard deviations it is more than chance."""
    odd, noise = coherent_remainder(r, peak)
    z = float((r.n @ (odd / noise) - r.n.size) / np.sqrt(r.n.size))  # each an exponential variable of mean 1
    return float((odd - noise / r.n) @ r.hz), z


def _is_biased(r: PathSpectra, peak: Peak, least: float) -> bool:
    power, z = _coherent_power(r, peak)
    return power > least and z > MIN_BIAS_SD


def _bias_region(r: PathSpectra, before: Array, A: Complexes) -> str:
    k = int(np.argmax(r.n * np.log(before / residual_power(r, A))))
    return f"the motion does not follow the measured force as the model predicts near {r.w[k] / 2 / np.pi:.0f} Hz"
