"""Which effect is missing: what the ranking of all that could be (screen.py) comes to, with honest odds."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.comparison.shape import Shape, shape_of
from estimator.diagnosis.hypotheses import gate_shape
from estimator.diagnosis.hypotheses import ranking as evidence
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.hypotheses.screen import FOREMOST, SIGNIFICANT, Progress, extrapolating, on_whole, ranked
from estimator.errors import DataError, NotFiniteError
from estimator.identification.batch.disturbance_numbers import with_found_effects
from estimator.identification.batch.full_fit import FullFit, fit_all_effects
from estimator.identification.finding import Finding
from estimator.identification.machine.harmonic_fit import fit_found_harmonics
from estimator.identification.residual import missing_force
from estimator.identification.residual.missing_force import MissingForce
from estimator.identification.search import search
from estimator.identification.structure import spectral_shape
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.known_spectra import SPECTRAL_SHAPES
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model
from estimator.results import Message, messages_json

from . import gate_residual, gate_second_law

CLOSE = 10.0  # nats behind the first of the ranking, where the shape of what is left decides
LEAVES = 1 / 3  # of a force in a spectrum (rms): a shape that leaves more is none of the catalogue
SURE = 30.0  # nats, from which a shaft that is not the rig file's is told
CAPS_COUPLED = Message(
    "caps_coupled_otherwise",
    "the bearings respond to each other through the shaft differently from what the rig file predicts: correct the "
    "shaft stiffness or the disc mass there, or check the sensors for a wrong gain or a delay",
)
SPECTRUM = Message(
    "spectrum_unexplained",
    "the missing force depends on no state, and no cause of the catalogue has its spectrum: check what excites the "
    "rotor at these frequencies, and the sensor",
)
SHAFT_DIFFERS = "shaft_differs"  # code: softer or stiffer than the rig file says
# codes of messages that lay what is missing to the rig file's shaft, a sensor or the excitation, and to no bearing
NO_LAW_CODES = frozenset({CAPS_COUPLED.code, SPECTRUM.code, SHAFT_DIFFERS})


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """verdict : an effect's name, "complete" or "unknown". ranking : best first. shape : where verdict is "unknown"."""

    verdict: str
    ranking: tuple[Entry, ...]
    shape: Shape | None = None
    separates: str = ""
    messages: tuple[Message, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As schemas/diagnose.json, with `separates` and `messages`."""
        out: dict[str, Any] = {
            "schema": 1,
            "verdict": self.verdict,
            "ranking": [e.to_json() for e in self.ranking],
            "separates": self.separates,
        } | messages_json(self.messages)
        return out if self.shape is None else out | {"shape": self.shape.to_json()}


def quiet(fraction: float, text: str) -> None:
    """No progress shown."""


def diagnose(model: Model, y: Array, rate_hz: float, progress: Progress | None = None) -> Diagnosis:
    """Name what the model lacks on a record y (n, channels of the model), SI, NaN where missing.

    Raises DataError if the record cannot answer.
    """
    say = progress or quiet
    say(0.0, "fit of the model as it is")
    whole = fit_all_effects(model, y, rate_hz)
    found = diagnose_point(whole.model, whole.point, y, say)
    return replace(found, messages=(*found.messages, *whole.messages))


def diagnose_point(model: Model, point: WorkingPoint, y: Array, say: Progress = quiet) -> Diagnosis:
    """The same from a model already fitted."""
    before, entries, known = _ranked(model, point, y, say)
    law = max((entry.gain for entry in entries), default=0.0)
    if before.disturbances and (as_it_is := spectral_shape.refit_with_seen_spectra(model, point, law)) is not None:
        point, shares = as_it_is, before.disturbances
        before, entries, known = _ranked(model, point, y, say)
        before = replace(before, disturbances=shares)
    found = verdict_of_ranking(model, point, before, entries, say, known)
    if found.verdict in SPECTRAL_SHAPES:
        say(0.9, f"does {found.verdict} explain it?")
        return _coloured(model, point, y, before, found)
    return _restored(model, point, y, before, found) if found.verdict == "sensor_clipping" else found


def _ranked(
    model: Model, point: WorkingPoint, y: Array, say: Progress
) -> tuple[MissingForce, list[Entry], gate_residual.Seen | None]:  # fmt: skip
    """What is missing, what could be it, and what part of the record shows of the likeliest law. The rest of it is
    asked where the law may have the shape of what is missing, or a spectrum is to be told from it."""
    found = ranked(model, point, y, say)
    say(0.58, "largest amplitudes")
    entries, known = extrapolating(found), None
    if _is_claimed(entries) and entries[0].effect in gate_shape.STATES:
        say(0.6, f"does {entries[0].effect} explain it?")
        with suppress(NotFiniteError):  # where it goes far from the rotor: said once it is asked of the whole
            known = gate_residual.seen(found.part, point, found.before, entries[0])
    if found.part is not point and (known is None or not known.far or found.before.disturbances):
        entries = extrapolating(on_whole(model, point, found, say))
    return found.before, entries, known


def verdict_of_ranking(
    model: Model, point: WorkingPoint, before: MissingForce, entries: list[Entry], say: Progress,
    known: gate_residual.Seen | None = None,
) -> Diagnosis:  # fmt: skip
    """What the ranking comes to."""
    if not _is_claimed(entries) or _negligible(point, entries[0]):
        return verdict_without_law(point, before, tuple(entries))
    best = entries[0]
    if best.placed and best.effect != "crack" and _loss(entries)[1] > best.gain:
        return verdict_without_law(point, before, tuple(entries))
    if not best.placed:
        if best.effect in PERIODIC_EFFECTS:
            say(0.85, f"{best.effect} and the model fitted together")
            entries[0] = _beside(model, point, before, best)
        return Diagnosis(best.effect, tuple(entries), separates=evidence.separates(entries), messages=best.notes)
    return verdict_of_laws(model, point, before, entries, say, known)


def _added(model: Model, y: Array, rate_hz: float, best: Entry) -> tuple[FullFit, Array] | None:
    """The model with what was found, fitted to the first part of the record, and that; None where too little of it is
    whole."""
    part = y[: int(missing_force.SURVEY_S * rate_hz)]
    try:
        return fit_all_effects(with_found_effects(model, best.settings), part, rate_hz), part
    except DataError:
        return None


def _restored(model: Model, point: WorkingPoint, y: Array, before: MissingForce, found: Diagnosis) -> Diagnosis:
    """The finding of clipped channels with what is missing once what lies beyond their level is drawn."""
    best, *others = found.ranking
    if (added := _added(model, y, point.data.rate_hz, best)) is None:
        return found
    whole, _ = added
    after = missing_force.survey(whole.point, whole.model, only=before.places_found())
    return replace(found, ranking=(replace(best, after_percent=after.percent(whole.point)), *others))


def _coloured(model: Model, point: WorkingPoint, y: Array, before: MissingForce, found: Diagnosis) -> Diagnosis:
    """The finding of a shape of the spectrum, fitted together with the model to part of the record: in what a model
    without it leaves another shape may pass for it, with another stiffness and damping. Noise of its sensor may be
    beside it, and is then the next to be found."""
    best, *others = found.ranking
    if (seen := _spectrum_left(model, point, y, before, best)) is None:
        return found
    best, share, beside = seen
    noise = {p: own for s in beside if s.effect == "sensor_noise" for p, own in s.settings.items()}
    if share > LEAVES**2 and noise:
        both = replace(best, settings={**best.settings, "sensor_noise": noise})
        again = _spectrum_left(model, point, y, before, both)
        if again is not None and again[1] <= LEAVES**2:
            text = f"together with noise of the sensor at {', '.join(noise)} it explains the whole spectrum"
            note = Message("sensor_noise_too", text)
            best, share = replace(best, notes=(*best.notes, note)), again[1]
    if share <= LEAVES**2:
        return replace(found, ranking=(best, *others))
    how_much = f"{100 * np.sqrt(share):.0f} %" if share < 1.0 else "all"
    text = f"{best.effect} fits best but leaves {how_much} of the missing spectrum unexplained"
    said, regions = Message("nearest_leaves", text), _regions(before)
    return Diagnosis("unknown", (best, *others), shape_of(point, before), messages=(said, *regions, SPECTRUM))


def _spectrum_left(
    model: Model, point: WorkingPoint, y: Array, before: MissingForce, best: Entry
) -> tuple[Entry, float, list[Finding]] | None:  # fmt: skip
    """A shape of the spectrum fitted together with the model to part of the record; the share of the power that the
    spectrum lacked, which it leaves; and what is suspected beside it. None where too little of the record is whole."""
    if (added := _added(model, y, point.data.rate_hz, best)) is None:
        return None
    whole, part = added
    beside = search(whole.model, whole.point, part)
    after = missing_force.survey(whole.point, whole.model, only=before.places_found(), others=beside)
    places = tuple(sorted({whole.point.data.places.index(p) for own in best.settings.values() for p in own}))
    # what goes with a state is another effect's
    was, rest = (sum(s.power_N2 for s in it.disturbances if s.place in places) for it in (before, after))
    return replace(best, after_percent=after.interval(places)[0]), rest / max(was, 1e-300), beside


def _loss(entries: Sequence[Entry]) -> tuple[float, float]:
    """N/m that the shaft lacks in the mean, and nats, by a crack on trial: without anything that turns it is another
    shaft than the rig file's."""
    for entry in entries:
        loss = entry.parameters.get("disc.crack.loss")
        if loss is not None and loss.value and loss.sd:
            return loss.value, 0.5 * (loss.value / loss.sd) ** 2
    return 0.0, 0.0


def _beside(model: Model, point: WorkingPoint, before: MissingForce, entry: Entry) -> Entry:
    """The entry of a force of time alone, fitted together with the model: about a resonance it had spoiled the fit."""
    settings, after_point = fit_found_harmonics(model, point, entry.settings)
    part = point_on_part(after_point, missing_force.SURVEY_S)
    del after_point
    after = missing_force.survey(part, model, only=before.places_found())
    return replace(evidence.with_settings(entry, settings), after_percent=after.percent(part))


def verdict_of_laws(
    model: Model, point: WorkingPoint, before: MissingForce, entries: list[Entry], say: Progress,
    known: gate_residual.Seen | None = None,
) -> Diagnosis:  # fmt: skip
    """The first of the ranking, if its law has the shape of what is missing, or one close behind that has."""
    left: dict[str, float] = {}
    for k in _close(entries):
        name = entries[k].effect
        say(0.85, f"does {name} explain it?")
        found = gate_residual.fits(model, point, before, entries[k], say, known)
        entries[k] = found.entry
        if found.left is None:
            if left:
                continue
            said = verdict_of_ranking(model, point, before, entries[:k] + entries[k + 1 :], say)
            return replace(said, ranking=(*said.ranking, entries[k]))
        # friction may leave a third, as its step is rounded; what another state explains is no second law of its own
        two = not found.whole or (
            found.left <= gate_shape.MOST and gate_second_law.FAMILY.get(name) in gate_second_law.OF_X
        )
        if two and found.left > gate_second_law.NEGLIGIBLE and (not left or "stop" in left):
            part = point_on_part(point, missing_force.SURVEY_S)
            pair = gate_second_law.of_one_state(model, part, point, entries[k:])
            if pair is not None:
                left[name] = found.left
                return _of_two(model, point, before, entries, pair, left, say)
        left[name] = found.left
        if found.whole:
            return _named(entries, k, left)
    best = entries[0]
    if _little(before):
        return verdict_without_law(point, before, tuple(entries))
    text = (
        f"{best.effect} fits best but leaves {100 * left[best.effect]:.0f} % of the state-dependent missing force "
        "unexplained: no law of the catalogue has this shape"
    )
    return Diagnosis(
        "unknown",
        tuple(entries),
        shape_of(point, before, (best.placed[0].at[0], gate_shape.state_of(best.effect))),
        messages=(Message("nearest_leaves", text), *_clipped(entries)),
    )


def _named(entries: list[Entry], k: int, left: dict[str, float]) -> Diagnosis:
    """The finding of the k-th of the ranking. left : what it leaves, and all that were judged before it."""
    ranking = (entries[k], *entries[:k], *entries[k + 1 :])
    said = (*_passed_over(left), *_clipped(entries))
    return Diagnosis(entries[k].effect, ranking, separates=evidence.separates(ranking), messages=said)


def _of_two(
    model: Model, point: WorkingPoint, before: MissingForce, entries: list[Entry], pair: tuple[str, str],
    left: dict[str, float], say: Progress,
) -> Diagnosis:  # fmt: skip
    """The finding of the first of two laws of one state that together leave nothing of it."""
    name, other = pair
    k = next(j for j, e in enumerate(entries) if e.effect == name)
    if name not in left:
        found = gate_residual.fits(model, point, before, entries[k], say)
        left[name] = 1.0 if found.left is None else found.left
        entries[k] = entries[k] if found.left is None else found.entry
    text = f"alone it leaves {100 * left[name]:.0f} % of the missing force; together with {other} nothing is left"
    note = Message("second_law_too", text)
    entries[k] = replace(entries[k], notes=(*entries[k].notes, note))
    return _named(entries, k, left)


def _clipped(entries: list[Entry]) -> tuple[Message, ...]:
    """What to tell of clipped channels, beside a law that has more evidence than they could make."""
    return tuple(note for e in entries if e.effect == "sensor_clipping" for note in e.notes)


def _close(entries: list[Entry]) -> list[int]:
    """Numbers of the first of the ranking and of force laws so close behind that a law of the wrong shape may have
    passed them by its number of parameters; and of the first law behind a stop that is odd or even: a stop is both, and
    passes by two laws that are one of each."""
    least = entries[0].score - CLOSE
    sure = [k for k, e in enumerate(entries) if e.placed and e.p_value < SIGNIFICANT]
    near = [k for k in sure if k < FOREMOST and entries[k].score > least]
    halves = [
        k for k in sure if k not in near and gate_second_law.FAMILY.get(entries[k].effect) in gate_second_law.OF_X
    ]
    return near + halves[:1] if entries[0].effect == "stop" else near


def _passed_over(left: dict[str, float]) -> tuple[Message, ...]:
    """What was ahead, and why it is not the answer. left : of each effect judged, the last one named."""
    return tuple(
        Message(
            "ahead_leaves", f"{effect} was ahead but leaves {100 * rest:.0f} % of the state-dependent missing force"
        )
        for effect, rest in [*left.items()][:-1]
    )


def _is_claimed(entries: Sequence[Entry]) -> bool:
    return bool(entries) and entries[0].p_value <= SIGNIFICANT


def _negligible(point: WorkingPoint, best: Entry) -> bool:
    """Whether a force law, however certain, explains less than any simulation, filter or ceiling leaves behind."""
    least = max((missing_force.negligible_share(point, i) for i in best.places), default=0.0)
    return best.explained_percent < 100 * least


def _little(before: MissingForce) -> bool:
    """Whether so little is missing, or so little known of it that it may be nothing, that nothing is claimed."""
    value, low, _ = before.interval()
    return value < 100 * missing_force.NEGLIGIBLE_FORCE_SHARE or low <= 0.0


def verdict_without_law(point: WorkingPoint, before: MissingForce, entries: tuple[Entry, ...]) -> Diagnosis:
    loss, nats = _loss(entries)
    shaft = []
    if nats > SURE and point.data.disc is not None:
        how = "softer (or its disc heavier)" if loss > 0 else "stiffer (or its disc lighter)"
        percent = 100 * abs(loss) / point.data.disc.K
        by = f"{percent:.2g} +- {percent / np.sqrt(2 * nats):.1g} %"
        text = f"the shaft is {how} than the rig file says, by {by}: correct the shaft stiffness or the disc mass there"
        shaft = [Message(SHAFT_DIFFERS, text)]
    if before.any_found() and not _little(before):
        text = "part of the residual force is predictable, but no effect of the catalogue explains it significantly"
        said = [
            *shaft,
            Message("none_significant", text),
            *_regions(before),
        ]
        groups = {f.group for r in before.residuals for f in r.found}
        if "other_bearing" in groups:
            said.append(CAPS_COUPLED)
        if (
            not groups and before.disturbances and not point.data.measured_force
        ):  # beside one it is the path that is bent
            said.append(SPECTRUM)
        return Diagnosis("unknown", entries, shape_of(point, before), messages=tuple(said))
    if not before.looked_anywhere():
        return Diagnosis("unknown", entries, messages=(*shaft, missing_force.UNJUDGED_MESSAGE))
    forces = [_beside_forces(point)] if point.data.measured_force else []
    return Diagnosis("complete", entries, messages=(*shaft, *forces))


def _regions(before: missing_force.MissingForce) -> tuple[Message, ...]:
    """Where the parts of the missing force lie that no state explains."""
    return tuple(Message("missing_where", region) for region in dict.fromkeys(s.region for s in before.disturbances))


def _beside_forces(point: WorkingPoint) -> Message:
    """What is not tried where the force is measured."""
    known = [p for p, S in zip(point.data.places, point.data.driven, strict=True) if S > 0.0]
    text = (
        f"the force at {', '.join(known)} is measured: its spectrum and its correlation with other forces are known, "
        "and no missing effect is sought in them"
    )
    return Message("force_measured", text)
