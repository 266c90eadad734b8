"""Improvement of a model: diagnose, add the effect that is named, fit again, until nothing more improves it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.comparison.heldout import heldout_nll, heldout_rmse
from estimator.diagnosis.comparison.survey import BearingSurvey, survey_bearing
from estimator.diagnosis.hypotheses.ranking import Entry, Settings
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import CATALOGUE, found_by
from estimator.errors import DataError
from estimator.identification.batch.disturbance_numbers import with_found_effects
from estimator.identification.batch.full_fit import SPECTRAL_AND_SENSOR_EFFECTS, FullFit, fit_all_effects
from estimator.identification.finding import effect_use
from estimator.identification.judgeable import Layers, on_judgeable_record, survey_layers
from estimator.identification.record import UsableRecord
from estimator.likelihood.fitting.fitted_values import fitted_model, unidentifiable_laws
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.results import RIG_FILE, Message, Parameter, messages_json

from .bearing import BearingJudgement, judge_bearing, quiet
from .clipped import with_clipped_channels
from .signal_findings import tones_of_surroundings

Progress = Callable[[float, str], None]
VERDICTS_WITHOUT_EFFECT = ("complete", "unknown", RIG_FILE)
# may lie out of the band or outside the likelihood, so the held-out likelihood does not judge them
UNSCORED_EFFECTS = tuple(name for name, e in CATALOGUE.items() if not e.in_likelihood)


@dataclass(frozen=True, slots=True)
class Rung:
    """A model on the ladder of improvements.

    effects : names, in the order of the model. heldout_nll : nats per sample, on the bins that all rungs are judged on.
    missing : missing force, value and 95 % limits, per cent of the rms bearing force. simulation_rmse : by channel, SI,
    of a free run under the measured force; empty unless a force is measured at every place.
    """

    effects: tuple[str, ...]
    heldout_nll: float
    missing: tuple[float, float, float]
    simulation_rmse: dict[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """An entry of `ladder` in the schema of improve."""
        value, low, high = self.missing
        more = {"simulation_rmse": self.simulation_rmse} if self.simulation_rmse else {}
        return more | {
            "effects": list(self.effects),
            "heldout_nll": self.heldout_nll,
            "missing_force_percent": {"value": value, "low": low, "high": high},
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Improvement:
    """What `improve` made of a model.

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
    surroundings = tones_of_surroundings(layers.record, layers.machine)
    found = improvement(usable.model, usable.y, rate_hz, say, refused=surroundings)
    known = [use for use in model.effects if found_by(use.name) == "samples"]
    rungs = [replace(r, effects=(*r.effects, *(use.name for use in known))) for r in found.rungs]
    named = with_clipped_channels(found.last, model, y, layers.record)
    diagnoses, parameters = list(found.diagnoses), found.parameters | dict(usable.parameters)
    if named.verdict != found.last.verdict:  # nothing else is to be added: its channel is left out already
        clipped = named.ranking[0]
        rungs.append(replace(rungs[-1], effects=(*rungs[-1].effects, named.verdict)))
        known += [effect_use(name, settings) for name, settings in clipped.settings.items()]
        diagnoses[-1:] = [named, found.last]
        parameters |= clipped.parameters
    return replace(
        found,
        rungs=tuple(rungs),
        model=replace(found.model, effects=(*found.model.effects, *known)),
        parameters=parameters,
        messages=(*usable.messages, *found.messages),
        diagnoses=tuple(diagnoses),
    )


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
    ladder = _Ladder(model, y, rate_hz, fit_all_effects(model, y, rate_hz))
    messages: list[Message] = []
    diagnoses: list[BearingJudgement] = []
    while True:
        step = len(diagnoses)
        whole = ladder.whole
        found = diagnose(whole.model, whole.point, y, _second_half(say, step / (step + 1.0)), refused, ladder.survey)
        named = found.verdict not in VERDICTS_WITHOUT_EFFECT
        best = found.ranking[0] if named and found.ranking else found.pair
        if best is None or best.effect in refused:
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
    last = found.messages if found.verdict in VERDICTS_WITHOUT_EFFECT else ()
    say(1.0, "done")
    return Improvement(
        rungs=tuple(ladder.rungs),
        model=fitted_model(ladder.whole.model, ladder.whole.point),
        parameters=ladder.whole.parameters,
        last=found,
        messages=(*ladder.whole.messages, *messages, *insignificant_effects(ladder.whole.point), *last),
        diagnoses=tuple(diagnoses),
    )


def _last_verdict(found: BearingJudgement, survey: BearingSurvey) -> BearingJudgement:
    """The diagnosis that ends an improvement: an effect that was refused is no verdict."""
    if found.verdict in VERDICTS_WITHOUT_EFFECT:
        return found
    return replace(found, verdict="complete" if survey.adequate else "unknown", messages=())


def _second_half(say: Progress, start: float) -> Progress:
    """Progress of a diagnosis that ends halfway between `start` and 1."""
    return lambda fraction, text: say(start + fraction * (1 - start) / 2, text)


class _Ladder:
    """The models of an improvement. Only the last one is kept: its rows are large."""

    def __init__(self, given: Model, y: Array, rate_hz: float, whole: FullFit) -> None:
        self._given, self._y, self._rate_hz = given, y, rate_hz
        self._shift = 0.0  # nats per sample, so that each rung is compared on the bins that both are judged on
        self.whole = whole
        first, self.survey = surveyed_rung(whole.model, whole.point, y)
        self.rungs = [first]
        self._added: list[str] = []

    def add(self, best: Entry) -> str:
        """Add an effect that was named. Returns why it is refused; "" where it is added."""
        try:
            new = self._with_law(best) if best.placed else self._with_settings(best)
        except DataError as problem:  # far from the rotor
            return f"the fit with it fails ({problem})"
        if new is None:
            return "cannot be distinguished from zero when fitted"
        point, last, shift = self.whole.point, self.rungs[-1], self._shift
        if (data := new.point.data).bins.size < point.data.bins.size:  # left out beside a crack
            shift = last.heldout_nll - heldout_nll(fit_model(data, list(point.placed), start=point))
        now, survey = surveyed_rung(new.model, new.point, self._y)
        now = replace(now, heldout_nll=now.heldout_nll + shift)
        if now.missing[0] > max(last.missing[2], last.missing[0]):
            return "raises the missing force"
        if best.effect not in UNSCORED_EFFECTS and now.heldout_nll >= last.heldout_nll:
            return "does not improve the held-out likelihood"
        gain_nats = (last.heldout_nll - now.heldout_nll) * point.data.blocks * point.data.block
        idle = now.missing[0] >= last.missing[0] and not gain_nats > THRESHOLDS.min_gain_nats
        if best.effect in PERIODIC_EFFECTS and idle:
            return "does not reduce the missing force"
        self.whole, self._shift, self.survey = new, shift, survey
        self.rungs.append(now)
        self._added += dict.fromkeys(law.effect.name for law in best.placed) or [best.effect]
        return ""

    def prune(self) -> list[str]:
        """The laws added before the last one without which the model predicts as well; they are taken back."""
        gone: list[str] = []
        for name in self._added[:-1]:
            point = self.whole.point
            fewer = [law for law in point.placed if law.effect.name != name]
            if len(fewer) == len(point.placed) or point.data.disc is not None and self._shift:
                continue
            less = fit_model(point.data, fewer, start=point)
            lost = (heldout_nll(less) - heldout_nll(point)) * point.data.blocks * point.data.block
            if lost > THRESHOLDS.min_gain_nats:
                continue
            model = replace(
                self.whole.model, effects=tuple(use for use in self.whole.model.effects if use.name != name)
            )  # fmt: skip
            now, survey = surveyed_rung(model, less, self._y)
            if now.missing[0] > max(self.rungs[-1].missing[2], self.rungs[-1].missing[0]):
                continue
            self.whole = replace(self.whole, model=fitted_model(model, less), point=less)
            self.survey = survey
            self.rungs.append(replace(now, heldout_nll=now.heldout_nll + self._shift))
            gone.append(name)
        self._added = [name for name in self._added if name not in gone]
        return gone

    def _with_law(self, best: Entry) -> FullFit | None:
        """The model with a law that was found; None where the law cannot be distinguished from zero.

        Masses, shapes of spectra and the background were fitted without the law. They are fitted again with it, and are
        kept as they were where that predicts better.
        """
        given, model, point = self._given, self.whole.model, self.whole.point
        richer = fit_model(point.data, [*point.placed, *best.placed], start=point)
        if set(unidentifiable_laws(richer)).issuperset(use.key for use in best.placed):
            return None
        new = replace(self.whole, model=fitted_model(model, richer), point=richer)
        shaped = any(use.name in SPECTRAL_AND_SENSOR_EFFECTS for use in model.effects)
        if not (self.whole.masses or shaped or model.background):
            return new
        again = replace(new.model, mass=given.mass, background=None)  # found anew: a missing law bends spectra too
        refitted = _refitted(again, self._y, self._rate_hz)
        comparable = np.array_equal(refitted.point.data.bins, richer.data.bins)
        return new if comparable and heldout_nll(richer) < heldout_nll(refitted.point) else refitted

    def _with_settings(self, best: Entry) -> FullFit:
        """The model with an effect that is no law of a state.

        Forces of time alone make products with the motion that look like a parametric stiffness: its order is sought
        again.
        """
        given = self._given
        before = replace(
            fitted_model(self.whole.model, self.whole.point),
            ball_pass_order=given.ball_pass_order, order_found=False, mass=given.mass, background=None,
        )  # fmt: skip
        return refitted_with_found(before, given, best.settings, self._y, self._rate_hz)


def refitted_with_found(
    before: Model, given: Model, settings: dict[str, Settings], y: Array, rate_hz: float,
    fit: Callable[[Model, Array, float], FullFit] = fit_all_effects,
) -> FullFit:  # fmt: skip
    """The full fit of a model with effects that were found.

    The fit starts from the fit without them. Where that one lies too far from the rotor, as beside a sensor that clips
    much, the fit starts from the given values. Raises DataError if neither is sound. settings : by name, by place.
    """
    try:
        return _refitted(with_found_effects(before, settings), y, rate_hz, fit)
    except DataError:
        own = {use.name: use for use in given.effects}
        afresh = replace(
            before, linear=given.linear, effects=tuple(own.get(use.name, use) for use in before.effects)
        )  # fmt: skip
        return _refitted(with_found_effects(afresh, settings), y, rate_hz, fit)


def _refitted(
    model: Model, y: Array, rate_hz: float, fit: Callable[[Model, Array, float], FullFit] = fit_all_effects
) -> FullFit:
    """The full fit of a model, the masses that the rig file leaves out included; its model has the fitted values."""
    whole = fit(model, y, rate_hz)
    return replace(whole, model=fitted_model(whole.model, whole.point))


def rung(model: Model, point: WorkingPoint, y: Array) -> Rung:
    """The held-out likelihood and the missing force of a fitted model. y : (n, channels), SI."""
    return surveyed_rung(model, point, y)[0]


def surveyed_rung(model: Model, point: WorkingPoint, y: Array) -> tuple[Rung, BearingSurvey]:
    """The rung of a fitted model, and its survey. y : (n, channels), SI."""
    survey, nll, rmse = survey_bearing(
        model, point, y, lambda: heldout_nll(point), lambda: heldout_rmse(model, y, point.data.rate_hz)
    )  # fmt: skip
    return Rung(tuple(u.name for u in model.effects), nll, survey.missing.interval(), rmse), survey


def insignificant_effects(point: WorkingPoint) -> list[Message]:
    """Messages on effects of the model that cannot be distinguished from zero. They are never removed."""
    text = "cannot be distinguished from zero in this record; it stays in the model"
    return [Message("effect_idle", f"{key} {text}", key.rsplit(".", 1)[0]) for key in unidentifiable_laws(point)]
