"""The bearing layer: which law a model lacks, by the ranking of all candidates and the gates that they pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from itertools import combinations, product
from typing import Any

from estimator.arrays import Array
from estimator.diagnosis.comparison.curves import Shape, missing_force_curve
from estimator.diagnosis.comparison.survey import BearingSurvey, law_text, survey_bearing
from estimator.diagnosis.hypotheses.ranking import Entry, separation_text
from estimator.diagnosis.hypotheses.screen import Progress, quiet, rank_on_record
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import CATALOGUE, LINE_NAMES
from estimator.effects.rotating.local_defect import LOCAL_DEFECT
from estimator.errors import NotFiniteError
from estimator.identification.batch.full_fit import FullFit
from estimator.identification.finding import OTHER_BEARING, is_cause_of_spectrum
from estimator.identification.residual import missing_force
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.results import NOT_CONCLUSIVE, RIG_FILE, Message, messages_json

from .gates import Context, judged
from .joint_fit import left_of_own_state, left_of_states
from .mistake import explaining_mistake
from .rivals import better_predicting, has_mistakes_for_rivals, is_overshadowed, leaves_less, left_text, share_left

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
SHAFT_HARMONICS = frozenset(PERIODIC_EFFECTS).difference(LINE_NAMES, {LOCAL_DEFECT.name})
CAUSES_OF_SPECTRUM = frozenset(name for name in CATALOGUE if is_cause_of_spectrum(name))  # a background holds them
TWO_LAWS = "two_laws_fit"  # code: two laws of one state leave little together
# codes of messages that lay what is missing to the rig file's shaft, a sensor or the excitation, and to no bearing
NO_LAW_CODES = frozenset({CAPS_COUPLED.code, SPECTRUM_UNEXPLAINED.code})


@dataclass(frozen=True, slots=True)
class Judgement:
    """The verdict on a record, with its evidence.

    Parameters
    ----------
    verdict : str
        Name of an effect, "complete", "unknown" or "rig_file".
    ranking : tuple of Entry
        Candidates with their evidence, best first.
    shape : Shape or None
        Force against the state that it depends on, where a force is missing that no effect explains; else None.
    separates : str
        What separates the first of the ranking from the second, a sentence.
    messages : tuple of Message
        Remarks for the user.
    """

    verdict: str
    ranking: tuple[Entry, ...]
    shape: Shape | None = None
    separates: str = ""
    _: KW_ONLY
    messages: tuple[Message, ...] = ()

    @property
    def names_effect(self) -> bool:
        """Whether the verdict is the name of an effect."""
        return self.verdict not in ("complete", "unknown", RIG_FILE)

    def to_json(self) -> dict[str, Any]:
        """The judgement by the keys of the result of diagnose."""
        out: dict[str, Any] = {
            "schema": 1,
            "verdict": self.verdict,
            "ranking": [e.to_json() for e in self.ranking],
            "separates": self.separates,
        } | messages_json(self.messages)
        return out if self.shape is None else out | {"shape": self.shape.to_json()}


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingJudgement(Judgement):
    """Result of the bearing layer: the law that the model of the bearings lacks.

    Parameters
    ----------
    judged : bool
        Whether the record carries a judgement of the bearings.
    reason : str
        Why the bearings are not judged, one line; empty where they are.
    pair : Entry or None
        Two laws of one state as one candidate, where the verdict is "unknown" and they leave little together.
    """

    judged: bool = True
    reason: str = ""
    pair: Entry | None = None

    @classmethod
    def not_judged(cls, reason: str) -> BearingJudgement:
        """The answer for a record that does not carry a judgement of the bearings. reason : one line."""
        return cls("unknown", (), judged=False, reason=reason)


def judge_bearing(
    model: Model, point: WorkingPoint, y: Array, say: Progress = quiet, refused: frozenset[str] = frozenset(),
    survey: BearingSurvey | None = None,
) -> BearingJudgement:  # fmt: skip
    """The judgement of the bearings from a fitted model, by one rule.

    An adequate model is complete. Else the first candidate that passes all gates is named; a second one within the
    resolution of the record is named beside it. Where no law passes, mistakes in the rig file are on trial. Where
    nothing passes, the answer is "unknown".

    Parameters
    ----------
    model, point : Model, WorkingPoint
        The model, fitted to the record.
    y : (n, channels) float64
        Samples, SI.
    say : callable
        Progress.
    refused : frozenset of str
        Effects that are not to be named.
    survey : BearingSurvey or None
        Of this model, if it is known.
    """
    say(0.15, "what can still be predicted")
    survey, untried = survey or survey_bearing(model, point, y, say=say)[0], list[Message]()
    found = _judged_by_rule(model, point, y, say, refused, survey, untried)
    return replace(found, messages=(*found.messages, *untried))


def _judged_by_rule(
    model: Model, point: WorkingPoint, y: Array, say: Progress, refused: frozenset[str], survey: BearingSurvey,
    untried: list[Message],
) -> BearingJudgement:  # fmt: skip
    """The judgement of `judge_bearing`. untried : receives the remark on mistakes that were not tried."""
    found = survey.ranking
    refused |= CAUSES_OF_SPECTRUM if point.data.background is not None else frozenset()
    if survey.too_strong is not None:
        return BearingJudgement("unknown", tuple(found.entries), messages=(survey.too_strong,))
    mistake = partial(judged_mistake, model, y, point.data.rate_hz, survey, refused=refused, untried=untried)
    if survey.explained:
        if point.data.background is not None and (mistaken := mistake(entries=found.entries)) is not None:
            return mistaken
        return _explained(Context(model=model, point=point, y=y, survey=survey, say=say), found.entries, refused)
    entries = found.entries if survey.part is point else rank_on_record(model, point, found, say).entries
    context = Context(model=model, point=point, y=y, survey=survey, say=say)
    tones = [e for e in entries if _is_tone(e)]
    entries = _judged_entries([e for e in entries if e.effect not in refused and e not in tones], context)
    named = [e for e in entries if e.passed and not (e.placed and is_overshadowed(e, entries))]
    if named and (better := better_predicting(entries, named[0], context)) is not None:
        named.insert(0, better)
    if has_mistakes_for_rivals(named):
        say(0.92, "a mistake in the rig file?")
        if (mistaken := mistake(entries=entries)) is not None and leaves_less(mistaken.ranking[0], named):
            return mistaken
    if not named and not untried and (best := better_predicting(entries, None, context)) is not None:
        named = [best]
    if named and is_cause_of_spectrum(named[0].effect):  # every excitation has some colour: a surer line goes first
        likelier = [e for e in tones if e.effect in LINE_NAMES and e.effect not in refused and e.score > named[0].score]
        sure = [e for e in _judged_entries(likelier, context) if e.passed]
        named, entries = [*sure, *named], [*sure, *entries]
    entries += [tone for tone in tones if all(tone.effect != e.effect for e in named)]
    if not named:
        return _unknown(context, entries)
    shaped = context.fitted(named[0]).whole
    if shaped is not None and (law := _law_beside(shaped, named[0], y, say, refused)) is not None:
        return law
    if not named[0].placed and is_overshadowed(named[0], entries):
        return _unknown(context, entries)
    ranking = (*named, *(e for e in entries if e not in named))
    ahead = [_leaves_message(e) for e in entries[: entries.index(named[0])] if share_left(e) is not None]
    notes = _more_missing(named[0]) if named[0].placed else named[0].notes
    said = (*ahead, *notes)
    return BearingJudgement(named[0].effect, ranking, separates=separation_text(ranking), messages=said)


def is_of_surroundings(verdict: str) -> bool:
    """Whether a verdict names no effect, a line or the shape of a spectrum: the surroundings of a bearing have both."""
    return verdict in ("complete", *LINE_NAMES) or is_cause_of_spectrum(verdict)


def _is_tone(entry: Entry) -> bool:
    """Whether a candidate is a periodic force, whose lines are left out of the force balance."""
    return entry.effect in PERIODIC_EFFECTS


def _explained(context: Context, entries: list[Entry], refused: frozenset[str]) -> BearingJudgement:
    """The judgement where no missing force is found: complete if none could hide, but for a periodic force that passes.

    Structural modes show that a record holds its surroundings, and every shaft has some 1X and 2X: beside modes, of the
    bearing or of a place that is not judged for them, these are named by their severity alone. Where the speed is
    unknown a line may be one of these.
    """
    surrounded = context.model.background is not None or context.model.unexplained_places
    refused = refused | SHAFT_HARMONICS if surrounded else refused
    tones = _judged_entries([e for e in entries if _is_tone(e) and e.effect not in refused], context)
    named = [e for e in tones if e.passed]
    rest = [e for e in entries if not any(e.effect == tone.effect for tone in named)]
    if named:
        ranking, notes = (*named, *rest), named[0].notes
        if surrounded and named[0].effect in LINE_NAMES and not context.point.data.speed:
            text = f"a line at {notes[0].text} is all that is found, and every shaft has such lines"
            said = Message(NOT_CONCLUSIVE, f"{text}: give speed_rpm or a tacho channel")
            return BearingJudgement("unknown", ranking, messages=(said, *notes[1:]))
        return BearingJudgement(named[0].effect, ranking, separates=separation_text(ranking), messages=notes)
    forces = [_measured_force_message(context.point)] if context.point.data.measured_force else []
    if (doubt := context.survey.inconclusive) is not None:
        return BearingJudgement("unknown", tuple(rest), messages=(doubt, *forces))
    return BearingJudgement("complete", tuple(rest), messages=tuple(forces))


def _judged_entries(entries: list[Entry], context: Context) -> list[Entry]:
    """The ranking, each candidate with what the gates say until one is named and no other is within the resolution.

    A fit together with the model is costly: at most `max_fitted` candidates come so far.
    """
    out = list(entries)
    best: Entry | None = None
    for k, entry in enumerate(entries):
        if len(context.fits) >= THRESHOLDS.max_fitted or entry.p_value > THRESHOLDS.max_p_value:
            continue
        if best is not None and entry.score < best.score - THRESHOLDS.rival_nats:
            break
        out[k] = judged(entry, context)
        if best is None and out[k].passed:
            best = out[k]
    return out


def _more_missing(named: Entry) -> Sequence[Message]:
    """The remark on a named law that leaves more than a fifth; none for another candidate."""
    if named.passed:
        return ()
    finer = " or ".join(e.name for e in CATALOGUE.values() if e.refines == named.effect)
    more = f"; {finer} refines it, which `improve` tries" if finer else ""
    text = f"{named.effect} predicts best, but leaves {left_text(named)} of the missing force{more}"
    return (Message("leaves_more", text),)


def _law_beside(
    whole: FullFit, nuisance: Entry, y: Array, say: Progress, refused: frozenset[str]
) -> BearingJudgement | None:  # fmt: skip
    """The judgement that names a law that is missing beside a spectral shape; None where none is.

    A spectrum of the excitation or the support is a background: what is named is the law, if one passes beside it.

    whole : the model with the spectral shape, fitted to the first part of the record.
    """
    rate_hz = whole.point.data.rate_hz
    part = y[: int(missing_force.survey_seconds(rate_hz) * rate_hz)]
    survey = survey_bearing(whole.model, whole.point, part, say=say)[0]
    if survey.explained or not survey.missing.places_found():
        return None
    context = Context(model=whole.model, point=whole.point, y=part, survey=survey, say=say)
    laws = [e for e in survey.ranking.entries if e.placed and e.effect not in refused]
    entries = _judged_entries(laws, context)
    named = [e for e in entries if e.passed]
    if not named:
        return None
    ranking = (*named, nuisance, *(e for e in entries if not e.passed))
    text = f"the force at {', '.join(nuisance.at)} is not white either: {nuisance.effect} comes nearest"
    note = Message("background_too", text)
    return BearingJudgement(named[0].effect, ranking, separates=separation_text(ranking), messages=(note,))


def _leaves_message(entry: Entry) -> Message:
    """The remark on a candidate that was ahead of the verdict."""
    return Message("ahead_leaves", f"{entry.effect} was ahead but leaves {left_text(entry)} of it")


def judged_mistake(
    model: Model, y: Array, rate_hz: float, survey: BearingSurvey | None, *,
    untried: list[Message], refused: frozenset[str] = frozenset(), entries: Sequence[Entry] = (),
) -> BearingJudgement | None:  # fmt: skip
    """The judgement that the rig file has a mistake; None where none explains the record, or it is refused.

    y : (n, channels) float64, samples, SI. survey : what the model leaves over; None where it cannot be fitted.
    untried : is given the remark on mistakes that were not tried. refused : effects that are not to be named.
    entries : other candidates.
    """
    if RIG_FILE in refused:
        return None
    found, said = explaining_mistake(model, y, rate_hz, survey)
    if found is None:
        untried += said
        return None
    return BearingJudgement(RIG_FILE, (found, *entries), messages=said)


def _unknown(context: Context, entries: list[Entry]) -> BearingJudgement:
    """The judgement where no candidate passes: the curve, the nearest candidate and what it leaves."""
    survey, point = context.survey, context.point
    before = survey.missing
    tried = [e for e in entries if share_left(e) is not None]
    said: list[Message] = []
    state: tuple[int, str] | None = None
    pair: Entry | None = None
    if tried:
        nearest = tried[0]
        text = f"{nearest.effect} fits best but leaves {left_text(nearest)} of the missing force"
        said.append(Message("nearest_leaves", text))
        if nearest.law is not None:
            state = min(nearest.places), "velocity" if nearest.law.state == "velocity" else "displacement"
        if (pair := fitting_pair(context, tried, entries)) is not None:
            said.append(Message(TWO_LAWS, f"two laws together fit: {pair.effect}"))
    elif survey.law is None:
        text = "part of the residual force is predictable, but no effect of the catalogue explains it significantly"
        said.append(Message("none_significant", text))
    else:
        text = f"{law_text(survey.law)}, but is not sure enough to be named"
        said.append(Message("none_significant", text))
    said += _regions(before)
    groups = {f.group for r in before.residuals for f in r.found}
    if OTHER_BEARING in groups:
        said.append(CAPS_COUPLED)
    if not groups and before.disturbances and not point.data.measured_force:  # beside one the path is biased
        said.append(SPECTRUM_UNEXPLAINED)
    curve = missing_force_curve(point, before, state)
    return BearingJudgement("unknown", tuple(entries), curve, messages=tuple(said), pair=pair)


def fitting_pair(context: Context, tried: list[Entry], entries: Sequence[Entry] = ()) -> Entry | None:
    """Two laws as one candidate, where both together leave little and neither does alone; None without such laws.

    Laws of one state are to leave little of it, others of all that follows a state at their bearing. The likeliest pair
    is the answer, if it is the likelier by 20 to 1.

    tried : candidates that leave too much, the likeliest first. entries : all candidates; of each state that none of
    those has the likeliest significant one is tried beside the first of them, and so is every law of the state of the
    first one: alone it may explain nothing, where the other one curves the force the other way.
    """
    part, before = context.survey.part, context.survey.missing
    laws = [e for e in tried if e.law is not None][: THRESHOLDS.max_paired]
    states = {e.law.state for e in laws if e.law is not None}
    others: dict[str, Entry] = {}
    for e in entries:
        if e.law is not None and e.law.state not in states and e.p_value <= THRESHOLDS.max_p_value:
            others.setdefault(e.law.state, e)
    nearest = laws[0].law.state if laws and laws[0].law is not None else None
    same = [e for e in entries if e not in laws and e.law is not None and e.law.state == nearest]
    found: list[tuple[float, Entry]] = []
    for one, other in (*combinations(laws, 2), *product(laws[:2], others.values()), *product(laws[:1], same)):
        try:
            both = fit_model(part.data, [*part.placed, *one.placed, *other.placed], start=part)
        except NotFiniteError:
            continue
        left = missing_force.survey(both, context.model, only=before.places_found())
        alike = one.law is not None and other.law is not None and one.law.state == other.law.state
        rest = left_of_own_state(before, left, one)[0] if alike else left_of_states(before, left)
        if rest <= THRESHOLDS.max_left_rel:
            own = {law.key for law in (*one.placed, *other.placed)}
            cost = THRESHOLDS.parameter_cost_nats * sum(sum(law.free) for law in both.placed)
            pair = replace(
                one, effect=f"{one.effect} + {other.effect}", at=tuple(dict.fromkeys((*one.at, *other.at))),
                placed=tuple(law for law in both.placed if law.key in own),
            )  # fmt: skip
            found.append((both.fit.log_likelihood - cost, pair))
    found.sort(key=lambda scored: -scored[0])
    alone = len(found) == 1 or len(found) > 1 and found[0][0] - found[1][0] >= THRESHOLDS.min_ahead_nats
    return found[0][1] if alone else None


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
