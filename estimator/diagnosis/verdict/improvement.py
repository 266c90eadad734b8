"""Improvement of a model: diagnose, add the effect that is named, fit again, until nothing more improves it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from estimator.arrays import Array
from estimator.diagnosis.comparison.survey import BearingSurvey
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.hypotheses.screen import Progress, quiet
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import LINE_NAMES, found_by
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.finding import effect_use
from estimator.identification.judgeable import Layers, on_judgeable_record, survey_layers
from estimator.identification.record import UsableRecord
from estimator.likelihood.fitting.fitted_values import fitted_model, unidentifiable_laws
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.results import RIG_FILE, Message, Parameter, messages_json

from .bearing import SHAFT_HARMONICS, BearingJudgement, judge_bearing
from .clipped import with_clipped_channels
from .ladder import Ladder, Rung
from .signal_findings import shaft_entries, signal_entries, signal_use, tones_of_surroundings


@dataclass(frozen=True, slots=True, kw_only=True)
class Improvement:
    """Result of `improve`: the models and the last diagnosis.

    rungs : the model as it was, and after each effect added. model : the last model, with fitted values. parameters :
    of the last model, by full name, SI. last : the diagnosis that ended the improvement. messages : for the user.
    diagnoses : of every model, in order.
    """

    rungs: tuple[Rung, ...]
    model: Model
    parameters: dict[str, Parameter]
    last: BearingJudgement
    messages: tuple[Message, ...] = ()
    diagnoses: tuple[BearingJudgement, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The result of improve, by its schema."""
        return {
            "schema": 1,
            "ladder": [r.to_json() for r in self.rungs],
            "verdict": self.last.verdict,
            "parameters": {k: p.to_json() for k, p in self.parameters.items()},
        } | messages_json(self.messages)


def improve(model: Model, y: Array, rate_hz: float, *, progress: Progress | None = None) -> Improvement:
    """Add the effects that a model lacks, one by one, as long as its held-out likelihood improves.

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
    Improvement
        The models in order, the last one with its fitted values, and the diagnosis that ended it.

    Raises
    ------
    DataError
        The record cannot answer: too short, a dead channel, no resonance in the band.
    ModelError
        A model that makes no sense.

    Examples
    --------
    >>> from estimator import Channel, Model, Setting, improve, simulate
    >>> cap = {"bearing1.x": {"kL": Setting(1.0e7), "c": Setting(60.0), "S": Setting(1.0e-4)}}
    >>> rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 8000.0), mass={"bearing1": 0.2}, linear=cap)
    >>> improvement = improve(rig, simulate(rig, rate_hz=25600.0, seconds=4.0, seed=1), 25600.0)
    >>> improvement.last.verdict, len(improvement.rungs)
    ('complete', 1)
    """
    layers = survey_layers(model, y, rate_hz)
    return on_judgeable_record(
        model, y, layers, lambda usable: _of_usable(model, y, rate_hz, layers, usable, progress or quiet)
    )


def _of_usable(
    model: Model, y: Array, rate_hz: float, layers: Layers, usable: UsableRecord, say: Progress
) -> Improvement:
    """The improvement of a record whose channels are sound. model, y : with all channels."""
    refused = tones_of_surroundings(layers.machine)
    if shaft_entries(model, layers.record, layers.machine):
        refused |= set(LINE_NAMES)  # a line is the trace of a shaft that is out of balance
    found = improvement(usable.model, usable.y, rate_hz, say, refused=refused)
    known = [use for use in model.effects if found_by(use.name) == "samples"]
    rungs = [replace(r, effects=(*r.effects, *(use.name for use in known))) for r in found.rungs]
    diagnoses, parameters = list(found.diagnoses), found.parameters | dict(usable.parameters)
    for judgement in _named_by_samples(found, model, y, layers):  # no fit is the better for them
        entry = judgement.ranking[0]
        rungs.append(replace(rungs[-1], effects=(*rungs[-1].effects, entry.effect)))
        uses = [effect_use(name, own) for name, own in entry.settings.items()]
        known += uses or [signal_use(model, entry)]
        diagnoses.insert(-1, judgement)
        parameters |= entry.parameters
    last = found.last
    faulty = any(found_by(d.verdict) == "samples" for d in diagnoses)
    if last.verdict == "complete" and faulty and set(usable.model.places) != set(model.places):
        last = replace(last, verdict="unknown")  # the messages on the record say which place is not judged, and why
    return replace(
        found,
        last=last,
        rungs=tuple(rungs),
        model=replace(found.model, effects=(*found.model.effects, *known)),
        parameters=parameters,
        messages=(*usable.messages, *found.messages),
        diagnoses=tuple(diagnoses),
    )


def _named_by_samples(found: Improvement, model: Model, y: Array, layers: Layers) -> list[BearingJudgement]:
    """Effects that the samples show without a fit and a model lacks: strikes, large shaft tones, clipped channels."""
    whole = replace(model, effects=(*model.effects, *found.model.effects))
    shown = {e.effect: e for e in reversed(signal_entries(whole, layers.record, layers.machine))}
    if any(use.name in SHAFT_HARMONICS for use in found.model.effects):
        shown = {name: e for name, e in shown.items() if name not in SHAFT_HARMONICS}
    out = [BearingJudgement(name, (entry,)) for name, entry in reversed(shown.items())]
    plain = BearingJudgement("complete", ())
    clipped = with_clipped_channels(plain, model, y, layers.record)
    return [*out, clipped] if clipped.ranking else out


def improvement(
    model: Model, y: Array, rate_hz: float, say: Progress = quiet, *,
    diagnose: Callable[..., BearingJudgement] = judge_bearing, refused: frozenset[str] = frozenset(),
) -> Improvement:  # fmt: skip
    """Diagnose, add, fit again, until the diagnosis names nothing that can be added.

    An effect that is refused once it is added is taken back, and the next candidate has its turn. After each addition
    every earlier one is tested for removal.

    diagnose : from the fitted model, its working point, the samples, the progress, the effects refused, the survey.
    refused : effects that are not added.
    """
    ladder = Ladder(model, y, rate_hz, fit_all_effects(model, y, rate_hz))
    ladder.settle_background()
    messages: list[Message] = []
    diagnoses: list[BearingJudgement] = []
    while True:
        step = len(diagnoses)
        whole = ladder.whole
        untried = refused
        if len(ladder.rungs) > 1 and ladder.survey.explained:  # no shaft is blamed beside laws that explain all
            untried |= {RIG_FILE}
        found = diagnose(whole.model, whole.point, y, _second_half(say, step / (step + 1.0)), untried, ladder.survey)
        best = found.ranking[0] if found.names_effect and found.ranking else found.pair
        if best is None or best.effect in untried:
            break
        if rivals := _inseparable(best, found.ranking):
            text = f"{' or '.join([best.effect, *rivals])}: the record does not separate these: none is added"
            messages.append(Message("not_separated", text))
            break
        if refusal := ladder.add(best):
            messages.append(Message("not_added", f"{best.effect} was named but {refusal}: not added"))
            refused |= {best.effect}
            continue
        diagnoses.append(found)
        gone = ladder.prune()
        refused |= set(gone)  # else it could be added and taken back without end
        messages += [Message("taken_back", f"{name} is not needed any more: taken back") for name in gone]
    diagnoses.append(found)
    found = _last_verdict(found, ladder.survey)
    last = () if found.names_effect else found.messages
    say(1.0, "done")
    return Improvement(
        rungs=tuple(ladder.rungs),
        model=fitted_model(ladder.whole.model, ladder.whole.point),
        parameters=ladder.whole.parameters,
        last=found,
        messages=(*ladder.whole.messages, *messages, *insignificant_effects(ladder.whole.point), *last),
        diagnoses=tuple(diagnoses),
    )


def _inseparable(best: Entry, ranking: Sequence[Entry]) -> list[str]:
    """Other laws that pass all gates and that the record does not separate from a law by odds of 20 to 1."""
    rivals = [e for e in ranking if e.passed and e.placed and e.effect != best.effect]
    return [e.effect for e in rivals if best.placed and abs(best.gain - e.gain) < THRESHOLDS.min_ahead_nats]


def _last_verdict(found: BearingJudgement, survey: BearingSurvey) -> BearingJudgement:
    """The diagnosis that ends an improvement: an effect that was refused is no verdict."""
    if not found.names_effect:
        return found
    doubt = () if survey.inconclusive is None else (survey.inconclusive,)
    return replace(found, verdict="complete" if survey.adequate else "unknown", messages=doubt)


def _second_half(say: Progress, start: float) -> Progress:
    """Progress of a diagnosis that ends halfway between `start` and 1."""
    return lambda fraction, text: say(start + fraction * (1 - start) / 2, text)


def insignificant_effects(point: WorkingPoint) -> list[Message]:
    """Messages on effects of the model that cannot be distinguished from zero. They are never removed."""
    text = "cannot be distinguished from zero in this record; it stays in the model"
    return [Message("effect_idle", f"{key} {text}", key.rsplit(".", 1)[0]) for key in unidentifiable_laws(point)]
