"""The gates that a candidate passes before it is named: one function and one threshold each.

No gate knows an effect by name. A gate that does not concern a candidate lets it pass. They are asked in order, the
cheap ones first, and the first that refuses ends the questions.

A candidate fitted together with the model, and what it leaves of what it was to explain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.comparison.heldout import heldout_nll
from estimator.diagnosis.comparison.survey import BearingSurvey
from estimator.diagnosis.hypotheses import gate_amplitude, ranking
from estimator.diagnosis.hypotheses.ranking import Entry, GateResult
from estimator.diagnosis.hypotheses.screen import Progress
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import NAMED
from estimator.errors import DataError, NotFiniteError
from estimator.identification.batch.disturbance_numbers import with_found_effects
from estimator.identification.batch.full_fit import FullFit, fit_all_effects
from estimator.identification.finding import is_cause_of_spectrum
from estimator.identification.residual import missing_force
from estimator.identification.residual.harmonic_fit import fit_found_harmonics
from estimator.identification.residual.missing_force import MissingForce
from estimator.identification.residual.thresholds import LIMITS as RESIDUAL_LIMITS
from estimator.identification.search import search
from estimator.likelihood.fitting.fitted_values import fitted_parameters, unidentifiable_laws
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model
from estimator.results import Message


@dataclass(frozen=True, slots=True, kw_only=True)
class JointFit:
    """A candidate fitted together with the model.

    Parameters
    ----------
    entry : Entry
        The candidate with the numbers of this fit.
    left_rel : float or None
        Left of what the candidate was to explain: rms of a force in its state, power of a spectrum. None where that is
        not measured.
    least_left_rel : float or None
        Its lower 95 % limit; None where that is not known.
    gain_nats : float or None
        Held-out gain of the fit; None where the likelihoods are not of the same data.
    whole : FullFit or None
        The model with the candidate, where that is a spectral shape.
    """

    entry: Entry
    left_rel: float | None = None
    least_left_rel: float | None = None
    gain_nats: float | None = None
    whole: FullFit | None = None


def joint_fit(model: Model, point: WorkingPoint, y: Array, survey: BearingSurvey, entry: Entry) -> JointFit:
    """The fit of a candidate together with the model.

    Parameters
    ----------
    model, point : Model, WorkingPoint
        The model as it is, fitted to the record.
    y : (n, channels) float64
        Samples, SI.
    survey : BearingSurvey
        What that model leaves over.
    entry : Entry
        The candidate.
    """
    if entry.placed:
        return _law_fit(model, survey, entry)
    if entry.effect in PERIODIC_EFFECTS:
        return _harmonic_fit(model, point, survey, entry)
    return (
        _nuisance_fit(model, point, y, survey, entry) if is_cause_of_spectrum(entry.effect) else JointFit(entry=entry)
    )


def _law_fit(model: Model, survey: BearingSurvey, entry: Entry) -> JointFit:
    """A force law and the model, fitted to the part of the record that was surveyed."""
    part = survey.part
    try:
        after = fit_model(part.data, [*part.placed, *entry.placed], start=part, rounds=THRESHOLDS.law_fit_rounds)
    except NotFiniteError:  # far from the rotor
        return JointFit(entry=entry, left_rel=1.0, gain_nats=-np.inf)
    entry, after = at_identifiable_bearings(part, entry, after)
    before = part
    if after.data.bins.size < part.data.bins.size:  # beside a law of the shaft bins are left out
        before = fit_model(after.data, list(part.placed), start=part)
    samples = after.data.blocks * after.data.block
    gain = (heldout_nll(before) - heldout_nll(after)) * samples
    if {law.key for law in entry.placed}.issubset(unidentifiable_laws(after)):
        return JointFit(entry=entry, gain_nats=min(gain, 0.0))
    left = missing_force.survey(after, model, only=survey.missing.places_found())
    known = fitted_parameters(after)
    values = {name: known.get(name, p) for name, p in entry.parameters.items()}
    entry = replace(entry, after_percent=left.interval(tuple(sorted(entry.places)))[0], parameters=values)
    left_rel, least = left_of_own_state(survey.missing, left, entry)
    return JointFit(entry=entry, left_rel=left_rel, least_left_rel=least, gain_nats=gain)


def left_of_own_state(before: MissingForce, after: MissingForce, entry: Entry) -> tuple[float, float]:
    """rms left over rms before, in the state where a law explains most, and its lower 95 % limit.

    0 if the law has the right shape. States that it does not touch belong to something else that is missing too. Where
    no state shows a missing force, the law leaves all.
    """
    was, rest = _power_by_state(before, entry), _power_by_state(after, entry)
    if not was:
        return 1.0, 1.0
    state = max(was, key=lambda group: was[group] - rest.get(group, 0.0))
    sd = float(np.sqrt(sum(r.power_sd_N2**2 for r in after.residuals if r.place in entry.places)))
    powers = np.array([rest.get(state, 0.0), rest.get(state, 0.0) - THRESHOLDS.normal_95 * sd])
    left, least = np.sqrt(np.clip(powers / was[state], 0.0, 1.0)) if was[state] > 0 else (0.0, 0.0)
    return float(left), float(least)


def _power_by_state(found: MissingForce, entry: Entry) -> dict[str, float]:
    """N^2 of every group found at the places of a law."""
    out: dict[str, float] = {}
    for r in found.residuals:
        for group in r.found if r.place in entry.places else ():
            out[group.group] = out.get(group.group, 0.0) + group.power_N2
    return out


def at_identifiable_bearings(
    point: WorkingPoint, entry: Entry, after: WorkingPoint
) -> tuple[Entry, WorkingPoint]:  # fmt: skip
    """The entry and its fit, without bearings at which the law is not significant.

    Fitted at all bearings together, the law cannot be distinguished from zero there and does not improve the held-out
    likelihood. Such a bearing was named because its force is coherent with that of the bearing that has the law.
    """
    silent = set(unidentifiable_laws(after))
    idle = [n for n in entry.at if all(use.key in silent for use in entry.placed if use.key.split(".")[0] == n)]
    if not idle or len(idle) == len(entry.at):
        return entry, after
    fewer = ranking.without_nodes(entry, idle)
    less = fit_model(point.data, [*point.placed, *fewer.placed], start=point, rounds=THRESHOLDS.law_fit_rounds)
    samples = point.data.blocks * point.data.block
    if heldout_nll(less) > heldout_nll(after) + THRESHOLDS.min_gain_nats / samples:
        return entry, after
    return fewer, less


def _harmonic_fit(model: Model, point: WorkingPoint, survey: BearingSurvey, entry: Entry) -> JointFit:
    """A periodic force and the model: near a resonance the force had biased the fit."""
    settings, after = fit_found_harmonics(model, point, entry.settings)
    part = point_on_part(after, missing_force.survey_seconds(point.data.rate_hz))
    left = missing_force.survey(part, model, only=survey.missing.places_found())
    return JointFit(entry=replace(ranking.with_settings(entry, settings), after_percent=left.interval()[0]))


def _nuisance_fit(model: Model, point: WorkingPoint, y: Array, survey: BearingSurvey, entry: Entry) -> JointFit:
    """A spectral shape and the model, fitted to part of the record, with noise of the sensors where that is seen too.

    In the residual of a model without the shape another shape may pass for the right one.
    """
    part = y[: int(missing_force.survey_seconds(point.data.rate_hz) * point.data.rate_hz)]

    def fitted(one: Entry) -> tuple[JointFit, dict[str, ranking.Settings]] | None:
        try:
            whole = fit_all_effects(with_found_effects(model, one.settings), part, point.data.rate_hz)
        except DataError:
            return None
        beside = search(whole.model, whole.point, part)
        after = missing_force.survey(whole.point, whole.model, only=survey.missing.places_found(), others=beside)
        places = tuple(sorted({whole.point.data.places.index(p) for own in one.settings.values() for p in own}))
        was, rest = (
            sum(share.power_N2 for share in it.disturbances if share.place in places) for it in (survey.missing, after)
        )
        noisy: dict[str, ranking.Settings] = {}
        for found in beside:
            if NAMED[found.effect].adds_noise if found.effect in NAMED else False:
                noisy.setdefault(found.effect, {}).update(found.settings)
        one = replace(one, after_percent=after.interval(places)[0])
        return JointFit(entry=one, left_rel=rest / max(was, 1e-300), whole=whole), noisy

    if (found := fitted(entry)) is None:
        return JointFit(entry=entry)
    alone, noisy = found
    if alone.left_rel is None or alone.left_rel <= THRESHOLDS.max_left_rel or not noisy:
        return alone
    both = fitted(replace(entry, settings={**entry.settings, **noisy}))
    if both is None or both[0].left_rel is None or both[0].left_rel > THRESHOLDS.max_left_rel:
        return alone
    at = ", ".join(place for own in noisy.values() for place in own)
    note = Message("sensor_noise_too", f"together with noise of the sensor at {at} it explains the whole spectrum")
    return replace(both[0], entry=replace(both[0].entry, notes=(*entry.notes, note)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Context:
    """What the gates may look at.

    Parameters
    ----------
    model, point : Model, WorkingPoint
        The model as it is, fitted to the record.
    y : (n, channels) float64
        Samples, SI.
    survey : BearingSurvey
        What the model leaves over.
    say : callable
        Progress.
    fits : dict of str to JointFit
        Candidates that were fitted together with the model, by effect.
    """

    model: Model
    point: WorkingPoint
    y: Array
    survey: BearingSurvey
    say: Progress
    fits: dict[str, JointFit] = field(default_factory=dict)

    def fitted(self, entry: Entry) -> JointFit:
        """The candidate fitted together with the model."""
        if entry.effect not in self.fits:
            self.say(0.85, f"does {entry.effect} explain it?")
            self.fits[entry.effect] = joint_fit(self.model, self.point, self.y, self.survey, entry)
        return self.fits[entry.effect]


Gate = Callable[[Entry, Context], GateResult]


def significant(entry: Entry, context: Context) -> GateResult:
    """The p-value pays for everything that was tried."""
    p, most = entry.p_value, THRESHOLDS.max_p_value
    return GateResult(gate="significant", passed=p <= most, measured=p, limit=most, text="p-value")


def large_enough(entry: Entry, context: Context) -> GateResult:
    """The force is larger than the errors of a simulation or a filter."""
    least = 100 * RESIDUAL_LIMITS.negligible_force_share
    force, text = entry.explained_percent, "force, % of the bearing force"
    return GateResult(gate="large enough", passed=force >= least, measured=force, limit=least, text=text)


def inside_limits(entry: Entry, context: Context) -> GateResult:
    """No tone outside the band, no mode above half the rate, and no gap wider than the motion."""
    data = context.point.data
    hz = [p.value for p in entry.parameters.values() if p.unit == "Hz" and p.value is not None]
    for tone_hz in hz if entry.effect in PERIODIC_EFFECTS else ():
        edge_hz = float(np.clip(tone_hz, *data.band))
        if tone_hz != edge_hz:
            text = "frequency outside the band"
            return GateResult(gate="inside limits", passed=False, measured=tone_hz, limit=edge_hz, text=text)
    most = THRESHOLDS.max_frequency_over_rate
    highest = max(hz, default=0.0) / data.rate_hz
    if highest > most:
        text = "frequency over the rate"
        return GateResult(gate="inside limits", passed=False, measured=highest, limit=most, text=text)
    gaps = [
        law.p[k] / np.sqrt(np.sum(np.max(np.abs(data.x[list(law.at)]), axis=1) ** 2))
        for law in entry.placed for k, q in enumerate(law.effect.parameters)
        if not q.linear and q.scale == "x" and q.low >= 0.0
    ]  # fmt: skip
    if not gaps:
        return GateResult(gate="inside limits", passed=True)
    widest, most = float(min(gaps)), THRESHOLDS.max_gap_over_motion
    text = "gap over the largest motion"
    return GateResult(gate="inside limits", passed=widest <= most, measured=widest, limit=most, text=text)


def gains_in_folds(entry: Entry, context: Context) -> GateResult:
    """The candidate predicts in all but one of the held-out time folds."""
    if not entry.folds:
        return GateResult(gate="gains in folds", passed=True)
    gained, least = sum(g > 0.0 for g in entry.folds), len(entry.folds) - THRESHOLDS.max_lost_folds
    return GateResult(
        gate="gains in folds", passed=gained >= least, measured=gained, limit=least, text="held-out folds gained"
    )


def holds_at_large_amplitudes(entry: Entry, context: Context) -> GateResult:
    """A law of displacement fitted to the smaller motion predicts the largest."""
    concerned = gate_amplitude.is_displacement_law(entry.law)
    told = gate_amplitude.extrapolated(context.survey.part, entry.placed) if concerned else None
    gate = ranking.LARGE_AMPLITUDES
    if told is None:
        return GateResult(gate=gate, passed=True)
    return GateResult(gate=gate, passed=not told.refused, measured=told.gain, limit=-told.allowed, text="nats gained")


def told_from_zero(entry: Entry, context: Context) -> GateResult:
    """Fitted together with the model, the candidate is told from zero and predicts held-out data."""
    gain, least = context.fitted(entry).gain_nats, THRESHOLDS.min_gain_nats
    if gain is None:
        return GateResult(gate="told from zero", passed=True)
    text = "held-out nats, fitted with the model,"
    return GateResult(gate="told from zero", passed=gain >= least, measured=gain, limit=least, text=text)


def leaves_little(entry: Entry, context: Context) -> GateResult:
    """The candidate leaves at most a fifth of what it was to explain, within the uncertainty of what is left."""
    fit, most = context.fitted(entry), THRESHOLDS.max_left_rel
    left = fit.left_rel
    if left is None:
        return GateResult(gate="leaves little", passed=True)
    least = left if fit.least_left_rel is None else fit.least_left_rel
    limit = f" (lower 95 % limit {least:.2f})" if least < most < left else ""
    text = f"share left of what it was to explain{limit}"
    return GateResult(gate="leaves little", passed=least <= most, measured=left, limit=most, text=text)


NAMING_GATES: tuple[Gate, ...] = (
    significant, large_enough, inside_limits, gains_in_folds, holds_at_large_amplitudes, told_from_zero, leaves_little,
)  # fmt: skip


def judged(entry: Entry, context: Context) -> Entry:
    """The candidate with what the gates say, and with the numbers of its joint fit if it came so far."""
    said: list[GateResult] = []
    for gate in NAMING_GATES:
        said.append(gate(entry, context))
        if not said[-1].passed:
            break
    known = context.fits.get(entry.effect)
    return replace(entry if known is None else known.entry, gates=tuple(said))
