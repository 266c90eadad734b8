"""The diagnosis of a record: the layers record, machine, structure and bearing, and one verdict of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from estimator.arrays import Array
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.hypotheses.screen import Progress, quiet
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import CATALOGUE, found_by
from estimator.effects.excitation.line import LINE
from estimator.effects.rotating.local_defect import LOCAL_DEFECT
from estimator.errors import DataError, NoResonanceError
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.judgeable import Layers, judgeable_record, on_judgeable_record, survey_layers
from estimator.identification.machine import MachineSurvey
from estimator.identification.record import RecordSurvey, UsableRecord, record_messages
from estimator.identification.structure import StructureSurvey
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.model.rig import Model
from estimator.results import NOT_JUDGED, RIG_FILE, Message

from .bearing import BearingJudgement, Judgement, is_of_surroundings, judge_bearing, judged_mistake
from .clipped import with_clipped_channels
from .signal_findings import (
    RING_TONES_CODE,
    have_one_order,
    line_entries,
    rig_file_entry,
    severe_tone_message,
    signal_entries,
    tones_of_surroundings,
    whole_order_messages,
)

BEARING_NOT_JUDGED = "bearing_not_judged"  # code: the verdict comes from the layers before
ROTOR_UNTRIED = Message(
    "rotor_untried",
    "the matrices of the rotor and its nodes are not on trial, and a mistake there looks like a law: hold the modes "
    "that rotorscope check prints against a tap test before you believe one",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis(Judgement):
    """The diagnosis of a record: four layers, each independent of the later ones, and their verdict.

    Parameters
    ----------
    record : RecordSurvey
        Whether the record is fit to be judged.
    machine : MachineSurvey
        Tones and strike trains.
    structure : StructureSurvey
        Modes and excitation.
    bearing : BearingJudgement
        Laws of the bearings, or why they are not judged.
    """

    record: RecordSurvey
    machine: MachineSurvey
    structure: StructureSurvey
    bearing: BearingJudgement

    def to_json(self) -> dict[str, Any]:
        """The result of diagnose, by its schema."""
        return Judgement.to_json(self) | {
            "bearing": {"judged": self.bearing.judged, "reason": self.bearing.reason},
            "record": self.record.to_json(),
            "machine": self.machine.to_json(),
            "structure": self.structure.to_json(),
        }


def diagnose(model: Model, y: Array, rate_hz: float, *, progress: Progress | None = None) -> Diagnosis:
    """Say what a record shows, and name the physical effect that a model lacks.

    Every record is answered. Where it does not carry a judgement of the bearings, ``bearing.reason`` says why, and the
    other layers are answered all the same.

    Parameters
    ----------
    model : Model
        The rig. Linear values and parameters of effects may be unknown (None); they are fitted.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``. NaN where a sample is missing or clipped.
    rate_hz : float
        Sampling rate, Hz.
    progress : callable, optional
        Called with a fraction from 0 to 1 and a text.

    Returns
    -------
    Diagnosis
        ``verdict`` ("complete", "unknown" or the name of an effect), ``ranking``, ``messages`` and the layers.

    Raises
    ------
    ModelError
        A model that makes no sense.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from estimator import Channel, EffectUse, Model, Setting, diagnose, simulate
    >>> cap = {"bearing1.x": {"kL": Setting(1.0e7), "c": Setting(60.0), "S": Setting(1.0e-4)}}
    >>> rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 8000.0), mass={"bearing1": 0.2}, linear=cap)
    >>> true = replace(rig, effects=(EffectUse("cubic", {"bearing1.x": {"kNL": Setting(3.0e18)}}),))
    >>> diagnose(rig, simulate(true, rate_hz=25600.0, seconds=4.0, seed=1), 25600.0).verdict
    'cubic'
    """
    say = progress or quiet
    say(0.0, "channels, tones and strikes")
    layers = survey_layers(model, y, rate_hz)
    return verdict_of_layers(model, layers, bearing_layer(model, y, rate_hz, layers, say), rate_hz)


def bearing_layer(model: Model, y: Array, rate_hz: float, layers: Layers, say: Progress) -> BearingJudgement:
    """The judgement of the bearings; it says why where the record does not carry one.

    y : (n, channels), SI. layers : those before. say : progress.
    """
    say(0.0, "fit of the model as it is")

    def judged(usable: UsableRecord) -> BearingJudgement:
        whole = fit_all_effects(usable.model, usable.y, rate_hz)
        surroundings = tones_of_surroundings(layers.machine)
        found = judge_bearing(whole.model, whole.point, usable.y, say, surroundings)
        untried = (ROTOR_UNTRIED,) if model.rotor is not None and found.verdict != "complete" else ()
        return replace(found, messages=(*untried, *found.messages, *usable.messages, *whole.messages))

    try:
        usable = judgeable_record(model, y, layers)
        try:
            found = judged(usable)
        except NoResonanceError as problem:
            say(0.1, "a mistake in the rig file?")
            untried: list[Message] = []
            mistaken = judged_mistake(usable.model, usable.y, rate_hz, None, untried=untried)
            refused = {problem.place: str(problem)}
            found = mistaken or on_judgeable_record(model, y, layers, judged, refused)
            found = replace(found, messages=(*found.messages, *untried))
    except DataError as problem:
        found = BearingJudgement.not_judged(str(problem))
    return with_clipped_channels(found, model, y, layers.record)


def verdict_of_layers(model: Model, layers: Layers, bearing: BearingJudgement, rate_hz: float) -> Diagnosis:
    """The verdict of all layers.

    A bearing defect goes before a law of the motion: impacts make laws look right. Tones alone at the order of a defect
    do not: a law stands beside them. A law of the user's own is judged like ours. A defect goes before a law of the
    shaft's angle unless that modulates the vibration at the order of the strikes with the smaller p-value. The order of
    a defect is that of the strikes. Imbalance and misalignment go before what is only the trace of a tone. A line is
    named only where no model of the bearings explains the record and no impacts repeat, which have many lines. A wrong
    speed or rate in the rig file is named where nothing is missing, and before a law, a line or a spectral shape: a
    wrong rate scales every frequency. Where no speed names a tone that dominates, nothing is called complete.
    """
    record, machine = layers.record, layers.machine
    signal = signal_entries(model, record, machine)
    if not (bearing.judged or machine.strikes) and all(use.name != LINE.name for use in model.effects):
        signal += line_entries(model, record, machine)
    overruling = next((e for e in signal[:1] if not _keeps_its_verdict(bearing, e)), None)
    verdict = bearing.verdict if overruling is None else overruling.effect
    severe = severe_tone_message(model, record, machine)
    if severe is not None and _is_no_cause_of_tones(verdict):
        verdict = "unknown"
    if overruling is not None:
        bearing = _with_notes_of(overruling, bearing)
    mistaken = rig_file_entry(model, machine, rate_hz) if _goes_after_mistakes(verdict) else None
    if mistaken is not None:
        verdict = RIG_FILE
        bearing = replace(bearing, ranking=(mistaken[0], *bearing.ranking), messages=(mistaken[1], *bearing.messages))
    keeps = overruling is None
    names = {entry.effect for entry in bearing.ranking} if keeps else set()
    ranking = _ranking(bearing.ranking, [entry for entry in signal if entry.effect not in names], keeps)
    return Diagnosis(
        verdict=verdict,
        ranking=ranking,
        shape=bearing.shape if verdict == bearing.verdict else None,
        separates=bearing.separates if verdict == bearing.verdict else "",
        messages=_messages(layers, bearing, verdict, severe),
        record=record,
        machine=machine,
        structure=layers.structure,
        bearing=bearing,
    )


def _keeps_its_verdict(bearing: BearingJudgement, first: Entry) -> bool:
    """Whether the verdict of the bearing layer stands beside the first candidate of the signal."""
    verdict = bearing.verdict
    if not bearing.names_effect:
        return verdict == RIG_FILE
    if first.effect == LINE.name:
        return True
    law = bearing.ranking[0]
    if verdict == first.effect:
        return have_one_order(law, first)
    if found_by(verdict) != "law":
        return False
    if first.effect != LOCAL_DEFECT.name or any(note.code == RING_TONES_CODE for note in first.notes):
        return True
    turns = verdict in CATALOGUE and CATALOGUE[verdict].state == "shaft_angle"
    return turns and have_one_order(law, first) and law.p_value <= first.p_value


def _is_no_cause_of_tones(verdict: str) -> bool:
    """Whether a verdict is that nothing is missing, or a cause that is no law and makes no tone."""
    return verdict == "complete" or (found_by(verdict) != "law" and verdict not in PERIODIC_EFFECTS)


def _goes_after_mistakes(verdict: str) -> bool:
    """Whether a verdict names no effect, a law, a line, or a cause of a spectral shape."""
    return is_of_surroundings(verdict) or (verdict != RIG_FILE and found_by(verdict) == "law")


def _with_notes_of(first: Entry, bearing: BearingJudgement) -> BearingJudgement:
    """The judgement of the bearings with the notes on what the signal shows, without those on what that overrules."""
    overruled = {note for entry in bearing.ranking[:1] for note in entry.notes}
    rest = tuple(message for message in bearing.messages if message not in overruled)
    return replace(bearing, messages=(*first.notes, *rest))


def _ranking(bearing: Sequence[Entry], signal: Sequence[Entry], bearing_first: bool) -> tuple[Entry, ...]:
    """Candidates of both layers. Missing force is a share of the force in the band: it cannot exceed all of it."""
    names = {entry.effect for entry in signal}
    rest = [
        replace(entry, before_percent=min(entry.before_percent, 100.0), after_percent=min(entry.after_percent, 100.0))
        for entry in bearing
        if entry.effect not in names
    ]
    return (*rest, *signal) if bearing_first else (*signal, *rest)


def _messages(
    layers: Layers, bearing: BearingJudgement, verdict: str, severe: Message | None
) -> tuple[Message, ...]:  # fmt: skip
    """Remarks of the layers for the user, each once: a severe tone first, then why a bearing is not judged."""
    machine, said = layers.machine, [] if severe is None else [severe]
    if not bearing.judged:
        code = NOT_JUDGED if verdict == bearing.verdict else BEARING_NOT_JUDGED
        said.append(Message(code, f"the bearings cannot be judged here: {bearing.reason}"))
    said += [*record_messages(layers.record), *whole_order_messages(machine), *machine.messages, *bearing.messages]
    each = tuple({message.text: message for message in said}.values())
    return each[: THRESHOLDS.max_messages]
