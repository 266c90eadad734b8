"""Whether a law, fitted together with the model, explains what is missing: by itself, or beside a second one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.diagnosis.comparison.heldout import heldout_nll
from estimator.diagnosis.hypotheses import gate_shape, ranking
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.hypotheses.screen import Progress
from estimator.errors import NotFiniteError
from estimator.identification.residual import missing_force
from estimator.identification.residual.missing_force import MissingForce
from estimator.likelihood.fitting.fitted_values import fitted_parameters, unidentifiable_laws
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model
from estimator.results import Message

from . import gate_second_law

SAME_SHAPE = 0.2  # of the missing force (rms): more left than that in the same state means another law
SMEARED = 0.12  # the same of a law of two directions of which one is measured: Hertz contacts leave 0.00 to 0.14 so
NOTHING = 0.9  # the same, of a law of no single state: it is not the first of two that leaves nearly all
SMALL = 0.5  # of a part of the force in a spectrum (rms)
MORE = 1.5  # times what is missing: no law of no single state explains anything that leaves more than that
FAR = 2.0  # times what may be left, on part of the record, from which the whole is not asked
EARNED = 5.0  # nats held out, of a law where no force is missing: ln of what a search tries
IDLE = Message(
    "refused_idle",
    "refused: no force is missing there, and fitted with the model the effect is zero or does not improve prediction",
)
BENT = Message(
    "refused_small_in_spectrum",
    "refused: no state predicts a force there, and the effect is small beside a spectrum that nothing explains",
)
ASTRAY = Message("refused_far_from_rotor", "refused: a fit of the model with this effect diverges")
ROUND = "the friction step is not sharp, or another damping force acts too"


@dataclass(frozen=True, slots=True)
class Explained:
    """entry : fitted together with the model. left : of the missing force in its own state (rms); None where the entry
    is nothing. whole : whether that is no more than a law of the right shape may leave, or is another's, of another
    state."""

    entry: Entry
    left: float | None
    whole: bool = False


@dataclass(frozen=True, slots=True)
class Seen:
    """A law fitted together with the model to part of a record.

    missing : whether a force is, at its places. left : of it in the law's own state (rms); None for one of no single
    state. far : whether that is what the whole record would not mend. after : the fit, without rows unless it is far or
    the part is all of the record (`all`).
    """

    entry: Entry
    after: WorkingPoint
    missing: bool
    left: float | None
    far: bool
    all: bool


def seen(part: WorkingPoint, point: WorkingPoint, before: MissingForce, entry: Entry) -> Seen:
    """An entry on part of the record of a point. Raises NotFiniteError where the fit goes far from the rotor."""
    missing = bool(entry.places.intersection(before.places_found()))
    after = fit_model(part.data, [*part.placed, *entry.placed], start=part, rounds=2 if missing else 6)
    left = gate_shape.left(part, after, entry.effect, entry.places, least=_across(part, entry))
    far = missing and left is not None and left > FAR * _most_left(part, entry)
    needed = far or part is point
    return Seen(entry, after if needed else after.without_rows(), missing, left, far, part is point)


def fits(
    model: Model, point: WorkingPoint, before: MissingForce, entry: Entry, say: Progress,
    known: Seen | None = None,
) -> Explained:  # fmt: skip
    """What an entry explains. It is nothing, as laws that see noise as strong as the motion may seem to be something,
    where no force is missing at its places and it is not told from zero at any or predicts no better.

    known : what part of the record has shown, if of this law at these places.
    """
    try:
        return _fitted(model, point, before, entry, say, known)
    except NotFiniteError:
        return Explained(replace(entry, notes=(*entry.notes, ASTRAY)), None)


def _fitted(
    model: Model, point: WorkingPoint, before: MissingForce, entry: Entry, say: Progress, known: Seen | None
) -> Explained:  # fmt: skip
    """What an entry explains. Raises NotFiniteError where the fit with it goes far from the rotor."""
    if mimics_a_spectrum(point, before, entry):
        return Explained(replace(entry, notes=(*entry.notes, BENT)), None)
    if known is None or {u.key for u in known.entry.placed} != {u.key for u in entry.placed}:
        known = seen(point_on_part(point, missing_force.SURVEY_S), point, before, entry)
    after_point, smooth = known.after, known.left
    if not known.far:
        if not known.all:
            after_point = fit_model(point.data, list(after_point.placed), start=after_point, rounds=2)
        found = _told(point, entry, after_point, known.missing)
        if found is None:
            return Explained(replace(entry, notes=(*entry.notes, IDLE)), None)
        entry, after_point = found
        smooth = gate_shape.left(point, after_point, entry.effect, entry.places, least=_across(point, entry))
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
        more = 0.0 < MORE * entry.before_percent < entry.after_percent
        left = 1.0 if more else _same_state_left(before, after, entry)
    whole = left <= _most_left(point, entry)
    if not whole and not (smooth is None and left > NOTHING):
        say(0.93, "one effect or two?")
        whole = gate_second_law.another_explains(
            after_part, gate_second_law.others(model, after_part, after, entry), after, entry
        )
    if whole and left > gate_shape.MOST and entry.effect == "coulomb":
        note = Message("friction_not_sharp", f"{100 * left:.0f} % of the velocity-dependent force is left: {ROUND}")
        entry = replace(entry, notes=(*entry.notes, note))
    return Explained(entry, left, whole)


def _most_left(point: WorkingPoint, entry: Entry) -> float:
    """What a law of the right shape may leave. One that joins two directions is smeared by a motion across that is not
    measured, and one of velocity leaves what friction may beside it: that is judged as those of no single state."""
    most = gate_shape.most_left(entry.effect, SAME_SHAPE)
    if any(law.effect.one_direction and len(law.at) == 1 for law in entry.placed):
        return max(most, SMEARED)
    beside = gate_shape.STATES.get(entry.effect) is gate_shape.V and gate_shape.damping(point, entry.places)
    return max(most, SAME_SHAPE) if beside else most


def mimics_a_spectrum(point: WorkingPoint, before: MissingForce, entry: Entry) -> bool:
    """Whether a law with a memory, where no state predicts anything, is small beside a spectrum that nothing explains:
    it answers in the mean as a resonance does, and takes some of that."""
    places = entry.places
    if all(law.effect.kind != "memory" for law in entry.placed) or _by_state(before, places):
        return False
    return _power(point, entry) < SMALL**2 * sum(
        share.power_N2 for share in before.disturbances if share.place in places
    )


def _power(point: WorkingPoint, entry: Entry) -> float:
    """N^2 of the entry's own part of the force."""
    return float((entry.explained_percent / 100) ** 2 * np.sum(point.bearing_force[list(entry.places)] ** 2))


def _across(point: WorkingPoint, entry: Entry) -> float:
    """The same of a law that joins two directions, 0 of any other."""
    return _power(point, entry) if all(len(law.at) > 1 for law in entry.placed) else 0.0


def _told(
    point: WorkingPoint, entry: Entry, after_point: WorkingPoint, missing: bool
) -> tuple[Entry, WorkingPoint] | None:  # fmt: skip
    """The entry and its fit where it is told; None where it is nothing."""
    samples = point.data.blocks * point.data.block
    if not missing and (
        {use.key for use in entry.placed}.issubset(unidentifiable_laws(after_point))
        or heldout_nll(after_point) > heldout_nll(point) - EARNED / samples
    ):
        return None
    return at_identifiable_bearings(point, entry, after_point)


def at_identifiable_bearings(
    point: WorkingPoint, entry: Entry, after_point: WorkingPoint
) -> tuple[Entry, WorkingPoint]:
    """The entry and its fit without bearings where the law, fitted at all of them together, is not told from zero and
    predicts no better: on trial by themselves they win by what they share with the one that has it, as where the
    forces at the two are coherent."""
    silent = set(unidentifiable_laws(after_point))
    idle = [n for n in entry.at if all(use.key in silent for use in entry.placed if use.key.split(".")[0] == n)]
    if not idle or len(idle) == len(entry.at):
        return entry, after_point
    fewer = ranking.without(entry, idle)
    less = fit_model(point.data, [*point.placed, *fewer.placed], start=point, rounds=6)
    samples = point.data.blocks * point.data.block
    if heldout_nll(less) > heldout_nll(after_point) + EARNED / samples:
        return entry, after_point
    return fewer, less


def _same_state_left(before: MissingForce, after: MissingForce, best: Entry) -> float:
    """rms left over rms before, in the state where the effect explains most: 0 if its law has the right shape.

    States that it does not touch belong to something else that is missing too.
    """
    was, rest = _by_state(before, best.places), _by_state(after, best.places)
    if not was:
        return 0.0
    state = max(was, key=lambda g: was[g] - rest.get(g, 0.0))
    return float(np.sqrt(min(max(rest.get(state, 0.0), 0.0) / was[state], 1.0))) if was[state] > 0 else 0.0


def _by_state(found: MissingForce, places: set[int]) -> dict[str, float]:
    out: dict[str, float] = {}
    for r in found.residuals:
        for f in r.found if r.place in places else ():
            out[f.group] = out.get(f.group, 0.0) + f.power_N2
    return out
