"""A candidate fitted together with the model, and what it leaves of what it was to explain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.comparison.heldout import heldout_gain_nats
from estimator.diagnosis.comparison.survey import BearingSurvey, has_impossible_amplitude
from estimator.diagnosis.hypotheses import ranking
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import NAMED
from estimator.errors import DataError, NotFiniteError
from estimator.identification.batch.disturbance_numbers import with_found_effects
from estimator.identification.batch.full_fit import FullFit, fit_all_effects
from estimator.identification.finding import OTHER_BEARING, is_cause_of_spectrum
from estimator.identification.residual import missing_force
from estimator.identification.residual.harmonic_fit import fit_found_harmonics
from estimator.identification.residual.missing_force import MissingForce
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
    """The fit of a force law and the model to the part of the record that was surveyed."""
    part = survey.part
    try:
        after = fit_model(part.data, [*part.placed, *entry.placed], start=part, rounds=THRESHOLDS.law_fit_rounds)
    except NotFiniteError:  # far from the rotor
        return JointFit(entry=entry, left_rel=1.0, gain_nats=-np.inf)
    entry, after = at_identifiable_bearings(part, entry, after)
    if has_impossible_amplitude(entry, after):
        return JointFit(entry=entry, left_rel=1.0, gain_nats=-np.inf)
    gain = heldout_gain_nats(part, after)
    left = missing_force.survey(after, model, only=survey.missing.places_found())
    known = fitted_parameters(after)
    values = {name: known.get(name, p) for name, p in entry.parameters.items()}
    entry = replace(entry, after_percent=left.interval(tuple(sorted(entry.places)))[0], parameters=values)
    left_rel, least = left_of_own_state(survey.missing, left, entry)
    return JointFit(entry=entry, left_rel=left_rel, least_left_rel=least, gain_nats=gain)


def left_of_own_state(before: MissingForce, after: MissingForce, entry: Entry) -> tuple[float, float]:
    """Residual rms over the rms before, in the state where a law explains most, and its lower 95 % limit.

    0 if the law has the right shape. States that it does not touch belong to something else that is missing too. Where
    no state shows a missing force, or more force is missing with the law, it leaves all.
    """
    was, rest = _power_by_state(before, entry), _power_by_state(after, entry)
    if not (was or rest or before.any_found()):  # only the law itself shows what is missing
        return 0.0, 0.0
    sd = float(np.sqrt(sum(r.power_sd_N2**2 for r in after.residuals if r.place in entry.places)))
    if not was or sum(rest.values()) - THRESHOLDS.normal_95 * sd > sum(was.values()):
        return 1.0, 1.0
    state = max(was, key=lambda group: was[group] - rest.get(group, 0.0))
    powers = np.array([rest.get(state, 0.0), rest.get(state, 0.0) - THRESHOLDS.normal_95 * sd])
    left, least = np.sqrt(np.clip(powers / was[state], 0.0, 1.0)) if was[state] > 0 else (0.0, 0.0)
    return float(left), float(least)


def left_of_states(before: MissingForce, after: MissingForce) -> float:
    """Residual rms over the rms before, of all force that follows a state of its own bearing."""

    def power(found: MissingForce) -> float:
        return sum(g.power_N2 for r in found.residuals for g in r.found if g.group != OTHER_BEARING)

    return float(np.sqrt(max(power(after), 0.0) / was)) if (was := power(before)) > 0.0 else 1.0


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
    if heldout_gain_nats(less, after) > THRESHOLDS.min_gain_nats:
        return entry, after
    return fewer, less


def _harmonic_fit(model: Model, point: WorkingPoint, survey: BearingSurvey, entry: Entry) -> JointFit:
    """The fit of a periodic force and the model: near a resonance the force had biased the fit."""
    settings, after = fit_found_harmonics(model, point, entry.settings)
    part = point_on_part(after, missing_force.survey_seconds(point.data.rate_hz))
    left = missing_force.survey(part, model, only=survey.missing.places_found())
    return JointFit(entry=replace(ranking.with_settings(entry, settings), after_percent=left.interval()[0]))


def _nuisance_fit(model: Model, point: WorkingPoint, y: Array, survey: BearingSurvey, entry: Entry) -> JointFit:
    """The fit of a spectral shape and the model to part of the record, with sensor noise where that is found too.

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
        return JointFit(entry=entry, left_rel=1.0)
    alone, noisy = found
    if alone.left_rel is None or alone.left_rel <= THRESHOLDS.max_left_rel or not noisy:
        return alone
    both = fitted(replace(entry, settings={**entry.settings, **noisy}))
    if both is None or both[0].left_rel is None or both[0].left_rel > THRESHOLDS.max_left_rel:
        return alone
    at = ", ".join(place for own in noisy.values() for place in own)
    note = Message("sensor_noise_too", f"together with noise of the sensor at {at} it explains the whole spectrum")
    return replace(both[0], entry=replace(both[0].entry, notes=(*entry.notes, note)))
