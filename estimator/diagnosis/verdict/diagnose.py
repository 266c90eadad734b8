"""The diagnosis of a record: the layers record, machine, structure and bearing, and one verdict of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

from estimator.arrays import Array
from estimator.diagnosis.comparison.shape import Shape
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.hypotheses.screen import Progress
from estimator.errors import DataError
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.record import RecordSurvey, record_messages, survey_record, usable_record
from estimator.model.rig import Model
from estimator.results import NOT_JUDGED, Message, messages_json

from .bearing import BearingJudgement, judge_bearing, quiet
from .clipped import with_clipped_channels


class Survey(Protocol):
    """What a layer says of a record."""

    def to_json(self) -> dict[str, Any]:
        """The layer's part of the result of diagnose."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """What is said of a record: four layers, each of which stands without the later ones, and their verdict.

    Parameters
    ----------
    verdict : str
        Name of an effect, "complete" or "unknown".
    ranking : tuple of Entry
        Candidates with their evidence, best first.
    shape : Shape or None
        Force against the state that it depends on, where a force is missing that no effect explains; else None.
    separates : str
        What tells the first of the ranking from the second, a sentence.
    messages : tuple of Message
        Remarks for the user.
    record : Survey or None
        Whether the record is fit to be judged; None where that was not examined.
    machine : Survey or None
        Tones and strike trains; None where these were not sought.
    structure : Survey or None
        Modes and excitation; None where these were not sought.
    bearing : BearingJudgement
        Laws of the bearings, or why they are not judged.
    """

    verdict: str
    ranking: tuple[Entry, ...]
    shape: Shape | None = None
    separates: str = ""
    messages: tuple[Message, ...] = ()
    record: Survey | None = None
    machine: Survey | None = None
    structure: Survey | None = None
    bearing: BearingJudgement

    def to_json(self) -> dict[str, Any]:
        """The result of diagnose, by its schema."""
        layers = {"record": self.record, "machine": self.machine, "structure": self.structure}
        out: dict[str, Any] = {
            "schema": 1,
            "verdict": self.verdict,
            "ranking": [entry.to_json() for entry in self.ranking],
            "separates": self.separates,
            "bearing": {"judged": self.bearing.judged, "reason": self.bearing.reason},
        } | messages_json(self.messages)
        out |= {name: survey.to_json() for name, survey in layers.items() if survey is not None}
        return out if self.shape is None else out | {"shape": self.shape.to_json()}


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
    record = survey_record(model, y, rate_hz)
    bearing = bearing_layer(model, y, rate_hz, record, progress or quiet)
    why = () if bearing.judged else (Message(NOT_JUDGED, f"the bearings cannot be judged here: {bearing.reason}"),)
    return Diagnosis(
        verdict=bearing.verdict,
        ranking=bearing.ranking,
        shape=bearing.shape,
        separates=bearing.separates,
        messages=(*why, *record_messages(record), *bearing.messages),
        record=record,
        bearing=bearing,
    )


def bearing_layer(model: Model, y: Array, rate_hz: float, record: RecordSurvey, say: Progress) -> BearingJudgement:
    """The judgement of the bearings; it says why where the record does not carry one.

    y : (n, channels), SI. record : findings on the channels. say : progress.
    """
    say(0.0, "fit of the model as it is")
    try:
        usable = usable_record(model, y, record)
        whole = fit_all_effects(usable.model, usable.y, rate_hz)
        found = judge_bearing(whole.model, whole.point, usable.y, say)
        found = replace(found, messages=(*found.messages, *whole.messages))
    except DataError as problem:
        found = BearingJudgement.not_judged(str(problem))
    return with_clipped_channels(found, model, y, record)
