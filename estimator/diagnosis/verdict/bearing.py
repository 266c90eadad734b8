"""The bearing layer: which law a model lacks, by the ranking of all candidates and the gates that they pass."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.comparison.shape import Shape, missing_force_curve
from estimator.diagnosis.hypotheses import gate_shape
from estimator.diagnosis.hypotheses.ranking import Entry, separation_text, with_settings
from estimator.diagnosis.hypotheses.screen import (
    MAX_RANK_JUDGED,
    Progress,
    amplitude_checked,
    rank_on_part,
    rank_on_record,
)
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.errors import NotFiniteError
from estimator.identification.machine.harmonic_fit import fit_found_harmonics
from estimator.identification.residual import missing_force
from estimator.identification.residual.missing_force import MissingForce
from estimator.identification.structure import spectral_shape
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.known_spectra import SPECTRAL_SHAPES
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model
from estimator.results import Message, messages_json

from . import gate_residual, gate_second_law, gate_spectrum

CAPS_COUPLED = Message(
    "caps_coupled_otherwise",
    "the bearings respond to each other through the shaft differently from what the rig file predicts: correct the "
    "shaft stiffness or the disc mass there, or check the sensors for a wrong gain or a delay",
)
SPECTRUM_UNEXPLAINED = Message(
    "spectrum_unexplained",
    "the missing force depends on no state, and no cause of the catalogue has its spectrum: check what excites the "
    "rotor at these frequencies, and the sensor",
)
SHAFT_DIFFERS = "shaft_differs"  # code: softer or stiffer than the rig file says
# codes of messages that lay what is missing to the rig file's shaft, a sensor or the excitation, and to no bearing
NO_LAW_CODES = frozenset({CAPS_COUPLED.code, SPECTRUM_UNEXPLAINED.code, SHAFT_DIFFERS})


@dataclass(frozen=True, slots=True)
class BearingJudgement:
    """What the bearing layer says of a record: the law that the model of the bearings lacks.

    Parameters
    ----------
    verdict : str
        Name of an effect, "complete" or "unknown".
    ranking : tuple of Entry
        Candidates with their evidence, best first.
    shape : Shape or None
        Force against the state that it depends on, where the verdict is "unknown"; else None.
    separates : str
        What tells the first of the ranking from the second, a sentence.
    messages : tuple of Message
        Remarks for the user.
    judged : bool
        Whether the record carries a judgement of the bearings.
    reason : str
        Why the bearings are not judged, one line; empty where they are.
    """

    verdict: str
    ranking: tuple[Entry, ...]
    shape: Shape | None = None
    separates: str = ""
    messages: tuple[Message, ...] = ()
    judged: bool = True
    reason: str = ""

    @classmethod
    def not_judged(cls, reason: str) -> BearingJudgement:
        """The answer for a record that does not carry a judgement of the bearings. reason : one line."""
        return cls("unknown", (), judged=False, reason=reason)

    def to_json(self) -> dict[str, Any]:
        """Keys of the result of diagnose that the bearing layer fills."""
        out: dict[str, Any] = {
            "schema": 1,
            "verdict": self.verdict,
            "ranking": [e.to_json() for e in self.ranking],
            "separates": self.separates,
            "bearing": {"judged": self.judged, "reason": self.reason},
        } | messages_json(self.messages)
        return out if self.shape is None else out | {"shape": self.shape.to_json()}


def quiet(fraction: float, text: str) -> None:
    """No progress shown."""


def judge_bearing(model: Model, point: WorkingPoint, y: Array, say: Progress = quiet) -> BearingJudgement:
    """The judgement of the bearings from a fitted model. y : (n, channels), SI."""
    before, entries, known = _ranked(model, point, y, say)
    law = max((entry.gain for entry in entries), default=0.0)
    if before.disturbances and (as_it_is := spectral_shape.refit_with_seen_spectra(model, point, law)) is not None:
        point, shares = as_it_is, before.disturbances
        before, entries, known = _ranked(model, point, y, say)
        before = replace(before, disturbances=shares)
    found = verdict_of_ranking(model, point, before, entries, say, known)
    if found.verdict in SPECTRAL_SHAPES:
        say(0.9, f"does {found.verdict} explain it?")
        return _judged_spectrum(model, point, y, before, found)
    return found


def _ranked(
    model: Model, point: WorkingPoint, y: Array, say: Progress
) -> tuple[MissingForce, list[Entry], gate_residual.PartFit | None]:  # fmt: skip
    """The missing force, the ranking of its causes, and the fit of the likeliest law to part of the record.

    The rest of the record is used where the law may have the right shape, or where a spectrum competes with it.
    """
    found = rank_on_part(model, point, y, say)
    say(0.58, "largest amplitudes")
    entries, known = amplitude_checked(found), None
    if _is_claimed(entries) and gate_shape.polynomial_terms(entries[0].law):
        say(0.6, f"does {entries[0].effect} explain it?")
        with suppress(NotFiniteError):  # where it goes far from the rotor: said once it is asked of the whole
            known = gate_residual.fit_on_part(found.part, point, found.before, entries[0])
    if found.part is not point and (known is None or not known.far or found.before.disturbances):
        entries = amplitude_checked(rank_on_record(model, point, found, say))
    return found.before, entries, known


def verdict_of_ranking(
    model: Model, point: WorkingPoint, before: MissingForce, entries: list[Entry], say: Progress,
    known: gate_residual.PartFit | None = None,
) -> BearingJudgement:  # fmt: skip
    """The verdict of a ranking."""
    if not _is_claimed(entries) or _is_negligible(entries[0]):
        return verdict_without_law(point, before, tuple(entries))
    best = entries[0]
    if best.law is not None and best.law.kind != "shaft" and _shaft_loss(entries)[1] > best.gain:
        return verdict_without_law(point, before, tuple(entries))
    if not best.placed:
        if best.effect in PERIODIC_EFFECTS:
            say(0.85, f"{best.effect} and the model fitted together")
            entries[0] = _with_joint_fit(model, point, before, best)
        return BearingJudgement(best.effect, tuple(entries), separates=separation_text(entries), messages=best.notes)
    return verdict_of_laws(model, point, before, entries, say, known)


def _judged_spectrum(
    model: Model, point: WorkingPoint, y: Array, before: MissingForce, found: BearingJudgement
) -> BearingJudgement:
    """The diagnosis that names a spectral shape, kept if the shape passes its gate."""
    best, *others = found.ranking
    result = gate_spectrum.spectrum_gate(model, point, y, before, best)
    if result.misfit_rel is None:
        return found
    if result.passed:
        return replace(found, ranking=(result.entry, *others))
    how_much = f"{100 * result.misfit_rel:.0f} %" if result.misfit_rel < 1.0 else "all"
    text = f"{best.effect} fits best but leaves {how_much} of the missing spectrum unexplained"
    said = (Message("nearest_leaves", text), *_regions(before), SPECTRUM_UNEXPLAINED)
    return BearingJudgement("unknown", (result.entry, *others), missing_force_curve(point, before), messages=said)


def _shaft_loss(entries: Sequence[Entry]) -> tuple[float, float]:
    """Mean stiffness that the shaft lacks, N/m, and its evidence, nats, from the trial of a law of the shaft.

    A mean loss without a part that turns with the shaft means that the rig file has another shaft.
    """
    for entry in entries:
        loss = entry.parameters.get(f"{entry.placed[0].key}.loss") if entry.placed else None
        if entry.law is not None and entry.law.kind == "shaft" and loss is not None and loss.value and loss.sd:
            return loss.value, 0.5 * (loss.value / loss.sd) ** 2
    return 0.0, 0.0


def _with_joint_fit(model: Model, point: WorkingPoint, before: MissingForce, entry: Entry) -> Entry:
    """The entry of a periodic force, fitted together with the model: near a resonance it had biased the fit."""
    settings, after_point = fit_found_harmonics(model, point, entry.settings)
    part = point_on_part(after_point, missing_force.SURVEY_S)
    del after_point
    after = missing_force.survey(part, model, only=before.places_found())
    return replace(with_settings(entry, settings), after_percent=after.percent(part))


def verdict_of_laws(
    model: Model, point: WorkingPoint, before: MissingForce, entries: list[Entry], say: Progress,
    known: gate_residual.PartFit | None = None,
) -> BearingJudgement:  # fmt: skip
    """The verdict among force laws: the first of the ranking, or one close behind it, that passes the residual gate."""
    left: dict[str, float] = {}
    for k in _rivals(entries):
        name = entries[k].effect
        say(0.85, f"does {name} explain it?")
        found = gate_residual.residual_gate(model, point, before, entries[k], say, known)
        entries[k] = found.entry
        if found.misfit_rel is None:
            if left:
                continue
            said = verdict_of_ranking(model, point, before, entries[:k] + entries[k + 1 :], say)
            return replace(said, ranking=(*said.ranking, entries[k]))
        # friction may leave a third, as its step is rounded; what another state explains is no second law of its own
        two = not found.passed or (
            found.misfit_rel <= THRESHOLDS.misfit_max_rel
            and gate_second_law.law_family(entries[k].law) in gate_second_law.X_FAMILIES
        )
        mixed = any(gate_second_law.is_odd_and_even(e.law) for e in entries if e.effect in left)
        if two and found.misfit_rel > gate_second_law.PAIR_MISFIT_MAX_REL and (not left or mixed):
            part = point_on_part(point, missing_force.SURVEY_S)
            pair = gate_second_law.of_one_state(model, part, point, entries[k:])
            if pair is not None:
                left[name] = found.misfit_rel
                return _named_pair(model, point, before, entries, pair, left, say)
        left[name] = found.misfit_rel
        if found.passed:
            return _named(entries, k, left)
    best = entries[0]
    if _is_little(before):
        return verdict_without_law(point, before, tuple(entries))
    text = (
        f"{best.effect} fits best but leaves {100 * left[best.effect]:.0f} % of the state-dependent missing force "
        "unexplained: no law of the catalogue has this shape"
    )
    return BearingJudgement(
        "unknown",
        tuple(entries),
        missing_force_curve(point, before, (best.placed[0].at[0], gate_shape.own_state(best.placed[0].effect))),
        messages=(Message("nearest_leaves", text),),
    )


def _named(entries: list[Entry], k: int, left: dict[str, float]) -> BearingJudgement:
    """The diagnosis that names the k-th of the ranking. left : misfit of it and of those judged before it."""
    ranking = (entries[k], *entries[:k], *entries[k + 1 :])
    said = _passed_over(left)
    return BearingJudgement(entries[k].effect, ranking, separates=separation_text(ranking), messages=said)


def _named_pair(
    model: Model, point: WorkingPoint, before: MissingForce, entries: list[Entry], pair: tuple[str, str],
    left: dict[str, float], say: Progress,
) -> BearingJudgement:  # fmt: skip
    """The diagnosis that names the first of two laws of one state that together leave no misfit."""
    name, other = pair
    k = next(j for j, e in enumerate(entries) if e.effect == name)
    if name not in left:
        found = gate_residual.residual_gate(model, point, before, entries[k], say)
        left[name] = 1.0 if found.misfit_rel is None else found.misfit_rel
        entries[k] = entries[k] if found.misfit_rel is None else found.entry
    text = f"alone it leaves {100 * left[name]:.0f} % of the missing force; together with {other} nothing is left"
    note = Message("second_law_too", text)
    entries[k] = replace(entries[k], notes=(*entries[k].notes, note))
    return _named(entries, k, left)


def _rivals(entries: list[Entry]) -> list[int]:
    """Indices of the ranked entries that may be the true law although another one is first.

    They are the first entry; force laws so close behind that a law of the wrong shape may have passed them by its
    number of parameters; and the first law odd or even in x behind one that is both.
    """
    least = entries[0].score - THRESHOLDS.rival_nats
    sure = [k for k, e in enumerate(entries) if e.placed and e.p_value < THRESHOLDS.max_p_value]
    near = [k for k in sure if k < MAX_RANK_JUDGED and entries[k].score > least]
    halves = [
        k for k in sure if k not in near and gate_second_law.law_family(entries[k].law) in gate_second_law.X_FAMILIES
    ]
    return near + halves[:1] if gate_second_law.is_odd_and_even(entries[0].law) else near


def _passed_over(left: dict[str, float]) -> tuple[Message, ...]:
    """Messages on effects that were ahead of the verdict. left : misfit of each effect judged, the named one last."""
    return tuple(
        Message(
            "ahead_leaves", f"{effect} was ahead but leaves {100 * rest:.0f} % of the state-dependent missing force"
        )
        for effect, rest in [*left.items()][:-1]
    )


def _is_claimed(entries: Sequence[Entry]) -> bool:
    return bool(entries) and entries[0].p_value <= THRESHOLDS.max_p_value


def _is_negligible(best: Entry) -> bool:
    """Whether a force law explains less than the errors of a simulation or a filter."""
    return bool(best.places) and best.explained_percent < 100 * missing_force.NEGLIGIBLE_FORCE_SHARE


def _is_little(before: MissingForce) -> bool:
    """Whether the missing force is negligible or may be zero."""
    value, low, _ = before.interval()
    return value < 100 * missing_force.NEGLIGIBLE_FORCE_SHARE or low <= 0.0


def verdict_without_law(point: WorkingPoint, before: MissingForce, entries: tuple[Entry, ...]) -> BearingJudgement:
    """The verdict "unknown" or "complete", with a hint where a shaft of another stiffness explains the record."""
    loss, nats = _shaft_loss(entries)
    shaft = []
    if nats > THRESHOLDS.shaft_min_gain_nats and point.data.disc is not None:
        how = "softer (or its disc heavier)" if loss > 0 else "stiffer (or its disc lighter)"
        percent = 100 * abs(loss) / point.data.disc.K
        by = f"{percent:.2g} +- {percent / np.sqrt(2 * nats):.1g} %"
        text = f"the shaft is {how} than the rig file says, by {by}: correct the shaft stiffness or the disc mass there"
        shaft = [Message(SHAFT_DIFFERS, text)]
    if before.any_found() and not _is_little(before):
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
            said.append(SPECTRUM_UNEXPLAINED)
        return BearingJudgement("unknown", entries, missing_force_curve(point, before), messages=tuple(said))
    forces = [_measured_force_message(point)] if point.data.measured_force else []
    return BearingJudgement("complete", entries, messages=(*shaft, *forces))


def _regions(before: missing_force.MissingForce) -> tuple[Message, ...]:
    """Messages on the parts of the missing force that no state explains."""
    return tuple(Message("missing_where", region) for region in dict.fromkeys(s.region for s in before.disturbances))


def _measured_force_message(point: WorkingPoint) -> Message:
    """The message on effects that are not searched for where the force is measured."""
    known = [p for p, S in zip(point.data.places, point.data.measured_force_psd, strict=True) if S > 0.0]
    text = (
        f"the force at {', '.join(known)} is measured: its spectrum and its correlation with other forces are known, "
        "and no missing effect is sought in them"
    )
    return Message("force_measured", text)
