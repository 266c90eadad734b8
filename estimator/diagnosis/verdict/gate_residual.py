"""Gate of the residual: does a law, fitted together with the model, explain the missing force?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.diagnosis.comparison.heldout import heldout_nll
from estimator.diagnosis.hypotheses import gate_shape, ranking
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.hypotheses.screen import Progress
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.errors import NotFiniteError
from estimator.identification.residual import missing_force
from estimator.identification.residual.missing_force import MissingForce
from estimator.likelihood.fitting.fitted_values import fitted_parameters, unidentifiable_laws
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model
from estimator.results import Message

from . import gate_second_law

REFUSED_INSIGNIFICANT = Message(
    "refused_idle",
    "refused: no force is missing there, and fitted with the model the effect is zero or does not improve prediction",
)
REFUSED_IN_SPECTRUM = Message(
    "refused_small_in_spectrum",
    "refused: no state predicts a force there, and the effect is small beside a spectrum that nothing explains",
)
REFUSED_DIVERGES = Message("refused_far_from_rotor", "refused: a fit of the model with this effect diverges")
STEP_NOT_SHARP = "the friction step is not sharp, or another damping force acts too"


@dataclass(frozen=True, slots=True)
class GateResult:
    """What the gate says of a law.

    entry : the law fitted together with the model. misfit_rel : rms of the missing force left in its own state, over
    what was missing; None where the law is refused. passed : whether that is no more than the right law may leave, or
    belongs to another law of another state.
    """

    entry: Entry
    misfit_rel: float | None
    passed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class PartFit:
    """A law fitted together with the model to part of a record.

    entry : the law. after : the fit, without rows unless `far` or `is_whole_record`. force_missing : whether a force is
    missing at its places. misfit_rel : rms of the missing force left in its own state, over what was missing; None for
    a law of no single state. far : whether the misfit is so large that the rest of the record would not change the
    result. is_whole_record : whether the part is all of the record.
    """

    entry: Entry
    after: WorkingPoint
    force_missing: bool
    misfit_rel: float | None
    far: bool
    is_whole_record: bool


def fit_on_part(part: WorkingPoint, point: WorkingPoint, before: MissingForce, entry: Entry) -> PartFit:
    """A law fitted to part of the record of a working point. Raises NotFiniteError where the fit diverges."""
    missing = bool(entry.places.intersection(before.places_found()))
    after = fit_model(part.data, [*part.placed, *entry.placed], start=part, rounds=2 if missing else 6)
    left = gate_shape.misfit_rel(part, after, entry.law, entry.places, least=_across(part, entry))
    far = missing and left is not None and left > THRESHOLDS.part_misfit_ratio * _max_misfit_rel(part, entry)
    needed = far or part is point
    return PartFit(
        entry=entry, after=after if needed else after.without_rows(), force_missing=missing, misfit_rel=left, far=far,
        is_whole_record=part is point,
    )  # fmt: skip


def residual_gate(
    model: Model, point: WorkingPoint, before: MissingForce, entry: Entry, say: Progress,
    known: PartFit | None = None,
) -> GateResult:  # fmt: skip
    """Whether a law explains the missing force.

    A law is refused where no force is missing at its places and it cannot be distinguished from zero at any of them or
    does not improve the held-out likelihood: noise as strong as the motion makes such laws seem significant.

    known : the fit to part of the record, if it is of this law at these places.
    """
    try:
        return _gate_result(model, point, before, entry, say, known)
    except NotFiniteError:
        return GateResult(replace(entry, notes=(*entry.notes, REFUSED_DIVERGES)), None)


def _gate_result(
    model: Model, point: WorkingPoint, before: MissingForce, entry: Entry, say: Progress, known: PartFit | None
) -> GateResult:  # fmt: skip
    """Result of the gate. Raises NotFiniteError where the fit with the law diverges."""
    if mimics_a_spectrum(point, before, entry):
        return GateResult(replace(entry, notes=(*entry.notes, REFUSED_IN_SPECTRUM)), None)
    if known is None or {u.key for u in known.entry.placed} != {u.key for u in entry.placed}:
        known = fit_on_part(point_on_part(point, missing_force.SURVEY_S), point, before, entry)
    after_point, smooth = known.after, known.misfit_rel
    if not known.far:
        if not known.is_whole_record:
            after_point = fit_model(point.data, list(after_point.placed), start=after_point, rounds=2)
        found = _if_significant(point, entry, after_point, known.force_missing)
        if found is None:
            return GateResult(replace(entry, notes=(*entry.notes, REFUSED_INSIGNIFICANT)), None)
        entry, after_point = found
        smooth = gate_shape.misfit_rel(point, after_point, entry.law, entry.places, least=_across(point, entry))
    del known
    joint = fitted_parameters(
        after_point
    )  # standard deviations by the curvature of the likelihood, gaps and corners too
    after_part = point_on_part(after_point, missing_force.SURVEY_S)
    del after_point
    after = missing_force.survey(after_part, model, only=before.places_found())
    values = {k: joint.get(k, p) for k, p in entry.parameters.items()}
    entry = replace(entry, after_percent=after.percent(after_part), parameters=values)
    left = smooth
    if left is None:  # other numbers of the model may go far with such a law
        more = 0.0 < THRESHOLDS.stateless_growth_max * entry.before_percent < entry.after_percent
        left = 1.0 if more else _own_state_misfit_rel(before, after, entry)
    whole = left <= _max_misfit_rel(point, entry)
    if not whole and not (smooth is None and left > THRESHOLDS.stateless_nothing_rel):
        say(0.93, "one effect or two?")
        whole = gate_second_law.another_explains(
            after_part, gate_second_law.others(model, after_part, after, entry), after, entry
        )
    if whole and left > THRESHOLDS.misfit_max_rel and entry.law is not None and entry.law.steps_at_rest:
        note = Message(
            "friction_not_sharp", f"{100 * left:.0f} % of the velocity-dependent force is left: {STEP_NOT_SHARP}"
        )
        entry = replace(entry, notes=(*entry.notes, note))
    return GateResult(entry, left, whole)


def _max_misfit_rel(point: WorkingPoint, entry: Entry) -> float:
    """Largest misfit of the right law at the places of an entry.

    A law of two directions leaves more where one of them is not measured. So does a law of velocity together with
    another law of velocity in the model.
    """
    most = gate_shape.max_misfit_rel(entry.law, THRESHOLDS.stateless_misfit_max_rel)
    if any(law.effect.one_direction and len(law.at) == 1 for law in entry.placed):
        return max(most, THRESHOLDS.one_direction_misfit_max_rel)
    of_velocity = entry.law is not None and entry.law.state == "velocity"
    beside = of_velocity and gate_shape.damping_laws(point, entry.places)
    return max(most, THRESHOLDS.stateless_misfit_max_rel) if beside else most


def mimics_a_spectrum(point: WorkingPoint, before: MissingForce, entry: Entry) -> bool:
    """Whether a law with memory only takes part of a spectrum that nothing explains.

    Its mean response is that of a resonance. So where no state predicts a force, a memory law that is small compared
    with such a spectrum is refused.
    """
    places = entry.places
    if all(law.effect.kind != "memory" for law in entry.placed) or _power_by_state(before, places):
        return False
    return _power(point, entry) < THRESHOLDS.memory_law_min_rel**2 * sum(
        share.power_N2 for share in before.disturbances if share.place in places
    )


def _power(point: WorkingPoint, entry: Entry) -> float:
    """N^2 of the entry's own part of the force."""
    return float((entry.explained_percent / 100) ** 2 * np.sum(point.bearing_force[list(entry.places)] ** 2))


def _across(point: WorkingPoint, entry: Entry) -> float:
    """N^2 of the force of a law of two directions, 0 for any other law."""
    return _power(point, entry) if all(len(law.at) > 1 for law in entry.placed) else 0.0


def _if_significant(
    point: WorkingPoint, entry: Entry, after_point: WorkingPoint, missing: bool
) -> tuple[Entry, WorkingPoint] | None:  # fmt: skip
    """The entry and its fit; None where the law is not significant. missing : whether a force is missing there."""
    samples = point.data.blocks * point.data.block
    if not missing and (
        {use.key for use in entry.placed}.issubset(unidentifiable_laws(after_point))
        or heldout_nll(after_point) > heldout_nll(point) - THRESHOLDS.min_gain_nats / samples
    ):
        return None
    return at_identifiable_bearings(point, entry, after_point)


def at_identifiable_bearings(
    point: WorkingPoint, entry: Entry, after_point: WorkingPoint
) -> tuple[Entry, WorkingPoint]:
    """The entry and its fit, without bearings at which the law is not significant.

    Fitted at all bearings together, the law cannot be distinguished from zero there and does not improve the held-out
    likelihood. Such a bearing was named because its force is coherent with that of the bearing that has the law.
    """
    silent = set(unidentifiable_laws(after_point))
    idle = [n for n in entry.at if all(use.key in silent for use in entry.placed if use.key.split(".")[0] == n)]
    if not idle or len(idle) == len(entry.at):
        return entry, after_point
    fewer = ranking.without_nodes(entry, idle)
    less = fit_model(point.data, [*point.placed, *fewer.placed], start=point, rounds=6)
    samples = point.data.blocks * point.data.block
    if heldout_nll(less) > heldout_nll(after_point) + THRESHOLDS.min_gain_nats / samples:
        return entry, after_point
    return fewer, less


def _own_state_misfit_rel(before: MissingForce, after: MissingForce, best: Entry) -> float:
    """rms left over rms before, in the state where the effect explains most: 0 if its law has the right shape.

    States that it does not touch belong to something else that is missing too.
    """
    was, rest = _power_by_state(before, best.places), _power_by_state(after, best.places)
    if not was:
        return 0.0
    state = max(was, key=lambda g: was[g] - rest.get(g, 0.0))
    return float(np.sqrt(min(max(rest.get(state, 0.0), 0.0) / was[state], 1.0))) if was[state] > 0 else 0.0


def _power_by_state(found: MissingForce, places: set[int]) -> dict[str, float]:
    out: dict[str, float] = {}
    for r in found.residuals:
        for f in r.found if r.place in places else ():
            out[f.group] = out.get(f.group, 0.0) + f.power_N2
    return out
