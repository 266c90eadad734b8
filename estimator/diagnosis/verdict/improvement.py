"""Compare, diagnose, add, refit, until nothing more is earned: the ladder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from estimator.arrays import Array
from estimator.diagnosis.comparison.heldout import heldout_nll, heldout_rmse
from estimator.diagnosis.hypotheses.ranking import Settings
from estimator.errors import DataError
from estimator.identification.batch.disturbance_numbers import with_found_effects
from estimator.identification.batch.full_fit import SPECTRAL_AND_SENSOR_EFFECTS, FullFit, fit_all_effects
from estimator.identification.residual.missing_force import NEGLIGIBLE_FORCE_SHARE, SURVEY_S, survey_with
from estimator.identification.search import search
from estimator.identification.structure import recorder_fall, recorder_phase
from estimator.likelihood.fitting.fitted_values import fitted_model, unidentifiable_laws
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model
from estimator.results import Message, Parameter, messages_json

from .diagnosis import Diagnosis, diagnose_point
from .gate_residual import EARNED

Progress = Callable[[float, str], None]
MOST = 5  # effects added at most
ENDED = ("complete", "unknown")  # verdicts that name nothing
UNSCORED = (
    "sensor_noise",
    "sensor_clipping",
    "imbalance",
    "bow",
    "line",
    "misalignment",
)  # may lie out of the band or beside the likelihood


@dataclass(frozen=True, slots=True)
class Rung:
    """A model on the ladder. missing : value, low, high in per cent."""

    effects: tuple[str, ...]
    heldout_nll: float
    missing: tuple[float, float, float]
    simulation_rmse: dict[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        value, low, high = self.missing
        more = {"simulation_rmse": self.simulation_rmse} if self.simulation_rmse else {}
        return more | {
            "effects": list(self.effects),
            "heldout_nll": self.heldout_nll,
            "missing_force_percent": {"value": value, "low": low, "high": high},
        }


@dataclass(frozen=True, slots=True)
class Improvement:
    """rungs : the model as it was, and after each effect added. model : the last, with fitted values.

    diagnoses : what was said of every model, in order; last : the one that ended it.
    """

    rungs: tuple[Rung, ...]
    model: Model
    parameters: dict[str, Parameter]
    last: Diagnosis
    messages: tuple[Message, ...] = ()
    diagnoses: tuple[Diagnosis, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As schemas/improve.json."""
        return {
            "schema": 1,
            "ladder": [r.to_json() for r in self.rungs],
            "verdict": self.last.verdict,
            "parameters": {k: p.to_json() for k, p in self.parameters.items()},
        } | messages_json(self.messages)


def improve(model: Model, y: Array, rate_hz: float, progress: Progress | None = None) -> Improvement:
    """Add what the diagnosis names, as long as the held-out likelihood improves. y : (n, channels), SI."""
    say = progress or (lambda fraction, text: None)
    given = model
    whole = fit_all_effects(model, y, rate_hz)
    model, point = whole.model, whole.point
    rungs = [rung(model, point, y)]
    messages: list[Message] = []
    diagnoses: list[Diagnosis] = []
    shift = 0.0  # of the likelihood, so that each rung is compared on the bins that both are judged on
    for step in range(MOST):
        start = step / (step + 1.0)

        def inner(fraction: float, text: str, start: float = start) -> None:
            say(start + fraction * (1 - start) / 2, text)

        found = diagnose_point(model, point, y, inner)
        diagnoses.append(found)
        best = found.ranking[0] if found.ranking else None
        if found.verdict in ENDED or best is None:
            break
        try:
            if best.placed:
                richer = fit_model(point.data, [*point.placed, *best.placed], start=point)
                if set(unidentifiable_laws(richer)).issuperset(use.key for use in best.placed):
                    text = f"{found.verdict} was named but cannot be distinguished from zero when fitted: not added"
                    messages.append(Message("not_added", text))
                    break
                new_whole = replace(whole, model=fitted_model(model, richer), point=richer)
                # masses, shapes of spectra, and what the recorder takes and delays, were sought beside what was missing
                taken = model.roll_off is not given.roll_off or recorder_fall.find_roll_off(new_whole.model, richer)
                shaped = any(use.name in SPECTRAL_AND_SENSOR_EFFECTS for use in model.effects)
                if whole.masses or shaped or taken or recorder_phase.find_recorder_phase(new_whole.model, richer):
                    again = replace(new_whole.model, mass=given.mass, roll_off=given.roll_off)
                    del richer, new_whole  # large, as is the last one, and the next is larger while it is made
                    whole = replace(whole, point=(point := point.without_rows()))
                    new_whole = _refitted(again, y, rate_hz)
            else:
                # forces of time alone make products with the motion that pass for a stiffness that turns: sought again
                before = replace(
                    fitted_model(model, point),
                    ball_pass_order=given.ball_pass_order, order_found=False, mass=given.mass,
                )  # fmt: skip
                if (
                    best.effect not in PERIODIC_EFFECTS
                ):  # a shape of the spectra that the recorder's filter was sought in
                    before = replace(before, roll_off=given.roll_off)
                whole = replace(whole, point=(point := point.without_rows()))
                new_whole = refitted_with_found(before, given, best.settings, y, rate_hz)
        except DataError as problem:  # far from the rotor
            text = f"{found.verdict} was named but the fit with it fails ({problem}): not added"
            messages.append(Message("not_added", text))
            break
        moved = shift
        if (data := new_whole.point.data).bins.size < point.data.bins.size:  # left out beside a crack
            moved = rungs[-1].heldout_nll - heldout_nll(fit_model(data, list(point.placed), start=point))
        new = rung(new_whole.model, new_whole.point, y)
        new = replace(new, heldout_nll=new.heldout_nll + moved)
        if best.effect not in UNSCORED and new.heldout_nll >= rungs[-1].heldout_nll:
            text = f"{found.verdict} was named but does not improve the held-out likelihood: not added"
            messages.append(Message("not_added", text))
            break
        earned = (rungs[-1].heldout_nll - new.heldout_nll) * point.data.blocks * point.data.block > EARNED
        if best.effect in PERIODIC_EFFECTS and new.missing[0] >= rungs[-1].missing[0] and not earned:
            text = f"{found.verdict} was named but does not reduce the missing force: not added"
            messages.append(Message("not_added", text))
            break
        whole, model, point, shift = new_whole, new_whole.model, new_whole.point, moved
        rungs.append(new)
    else:
        text = f"{MOST} effects were added, the limit of one run: run improve again on the rig file that it wrote"
        messages.append(Message("most_added", text))
    if found.verdict not in ENDED and len(diagnoses) == len(rungs):  # what it named was not upheld
        if rungs[-1].missing[0] < 100 * NEGLIGIBLE_FORCE_SHARE:
            found = replace(found, verdict="complete", messages=())
        elif best is not None and best.placed:  # a law of another shape than what is missing
            found = replace(found, verdict="unknown", messages=())
    said = [*whole.messages, *messages, *idle(point), *(found.messages if found.verdict in ENDED else ())]
    say(1.0, "done")
    return Improvement(tuple(rungs), fitted_model(model, point), whole.parameters, found, tuple(said), tuple(diagnoses))


def refitted_with_found(
    before: Model, given: Model, settings: dict[str, Settings], y: Array, rate_hz: float
) -> FullFit:
    """The whole of a model with what was found, begun from its fit without it; where that ended too far from the rotor,
    as of a sensor that is clipped much, from the numbers that were given. Raises DataError if neither is sound."""
    try:
        return _refitted(with_found_effects(before, settings), y, rate_hz)
    except DataError:
        own = {use.name: use for use in given.effects}
        afresh = replace(
            before, linear=given.linear, effects=tuple(own.get(use.name, use) for use in before.effects)
        )  # fmt: skip
        return _refitted(with_found_effects(afresh, settings), y, rate_hz)


def _refitted(model: Model, y: Array, rate_hz: float) -> FullFit:
    """The whole of a model that begins from a fit, and the masses that the rig file leaves out with it."""
    whole = fit_all_effects(model, y, rate_hz)
    return replace(whole, model=fitted_model(whole.model, whole.point))


def rung(model: Model, point: WorkingPoint, y: Array) -> Rung:
    """A model's place on the ladder."""
    found, _, nll, rmse = survey_with(
        point_on_part(point, SURVEY_S), model, lambda: search(model, point, y), lambda: heldout_nll(point),
        lambda: heldout_rmse(model, y, point.data.rate_hz),
    )  # fmt: skip
    return Rung(tuple(u.name for u in model.effects), nll, found.interval(), rmse)


def idle(point: WorkingPoint) -> list[Message]:
    """Effects of the model that earn nothing: said, never removed."""
    text = "cannot be distinguished from zero in this record; it stays in the model"
    return [Message("effect_idle", f"{key} {text}", key.rsplit(".", 1)[0]) for key in unidentifiable_laws(point)]
