"""The models of an improvement: an effect is added, tested for what it brings, and taken back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.comparison.heldout import heldout_gain_nats, heldout_nll, heldout_rmse, judged_like
from estimator.diagnosis.comparison.survey import BearingSurvey, survey_bearing
from estimator.diagnosis.hypotheses.ranking import Entry, Settings, ranked_entries
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import CATALOGUE
from estimator.errors import DataError
from estimator.identification.batch.disturbance_numbers import with_found_effects
from estimator.identification.batch.full_fit import SPECTRAL_AND_SENSOR_EFFECTS, FullFit, fit_all_effects
from estimator.identification.finding import is_cause_of_spectrum
from estimator.identification.structure.background_search import background_of_spectra
from estimator.identification.structure.cross_spectra import Work
from estimator.identification.structure.thresholds import LIMITS as STRUCTURE_LIMITS
from estimator.likelihood.fitting.fitted_values import fitted_model, unidentifiable_laws
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.background import Background
from estimator.model.rig import Model

# may lie out of the band, outside the likelihood or at bins that are left out: the held-out likelihood does not judge
# them
UNSCORED_EFFECTS = (*PERIODIC_EFFECTS, *(name for name, e in CATALOGUE.items() if not e.in_likelihood))


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


class Ladder:
    """The models of an improvement. Only the last one is kept: its rows are large."""

    def __init__(self, given: Model, y: Array, rate_hz: float, whole: FullFit) -> None:
        self._given, self._y, self._rate_hz = given, y, rate_hz
        self._shift = 0.0  # nats per sample, so that each rung is compared on the bins that both are judged on
        self.whole = whole
        first, self.survey = surveyed_rung(whole.model, whole.point, y)
        self.rungs = [first]
        self._added: list[str] = []
        self._background: Background | None = None  # that was settled; else each fit finds its own

    def settle_background(self) -> None:
        """Take structural modes into the fit where they predict better than the one cause that explains a spectrum.

        One cause is the simpler answer where both predict alike. Modes and spectra of the force are surroundings that
        every machine has: each costs what a mode costs in the search for a background.
        """
        whole, survey = self.whole, self.survey
        entries = ranked_entries(whole.model, survey.part, (), survey.missing, survey.findings)
        causes = [e for e in entries if is_cause_of_spectrum(e.effect) and e.p_value <= THRESHOLDS.max_p_value]
        if whole.model.background is not None or not causes:
            return
        background, _ = background_of_spectra(whole.model, whole.point, Work())
        if background is None:
            return
        try:
            modes = _refitted(replace(self._unscaled(), background=background), self._y, self._rate_hz)
            one = self._with_settings(causes[0])
        except DataError:
            return
        comparable = modes.point.data.is_judged_like(one.point.data)
        if not comparable or heldout_gain_nats(one.point, modes.point) < STRUCTURE_LIMITS.min_gain_nats:
            return
        self.whole, self._background = modes, modes.model.background
        self.rungs[-1], self.survey = surveyed_rung(modes.model, modes.point, self._y)

    def _unscaled(self) -> Model:
        """The model with its fitted values, without masses and background of the fit."""
        model = fitted_model(self.whole.model, self.whole.point)
        return replace(model, mass=self._given.mass, background=self._background)

    def add(self, best: Entry) -> str:
        """Add an effect that was named. Returns why it is refused; "" where it is added."""
        try:
            new = self._with_law(best) if best.placed else self._with_settings(best)
        except DataError as problem:  # far from the rotor
            return f"the fit with it fails ({problem})"
        if new is None:
            return "cannot be distinguished from zero when fitted"
        point, last, shift = self.whole.point, self.rungs[-1], self._shift
        if not new.point.data.is_judged_like(point.data):  # bins are left out beside a crack, and at unknown lines
            shift = last.heldout_nll - heldout_nll(judged_like(point, new.point))
        now, survey = surveyed_rung(new.model, new.point, self._y)
        now = replace(now, heldout_nll=now.heldout_nll + shift)
        if now.missing[0] > max(last.missing[2], last.missing[0]):
            return "raises the missing force"
        if best.effect not in UNSCORED_EFFECTS and now.heldout_nll >= last.heldout_nll:
            return "does not improve the held-out likelihood"
        self.rungs[-1] = self._with_force_of(best.effect)
        self.whole, self._shift, self.survey = new, shift, survey
        self.rungs.append(now)
        self._added += dict.fromkeys(law.effect.name for law in best.placed) or [best.effect]
        return ""

    def _with_force_of(self, effect: str) -> Rung:
        """The last rung with a periodic force in the missing force, from which the fit leaves its lines out."""
        missing, last = self.survey.missing, self.rungs[-1]
        if effect not in PERIODIC_EFFECTS:
            return last
        power = sum(p for f in self.survey.findings if f.effect == effect for p in f.power_N2.values())
        percent = 100.0 * float(np.sqrt(power / np.sum(missing.bearing_force_N**2)))
        value, low, high = (min(float(np.hypot(limit, percent)), 100.0) for limit in last.missing)
        return replace(last, missing=(value, low, high))

    def prune(self) -> list[str]:
        """The laws added before the last one without which the model predicts as well; they are taken back."""
        gone: list[str] = []
        for name in self._added[:-1]:
            point = self.whole.point
            fewer = [law for law in point.placed if law.effect.name != name]
            if len(fewer) == len(point.placed) or point.data.disc is not None and self._shift:
                continue
            less = fit_model(point.data, fewer, start=point)
            if heldout_gain_nats(less, point) > THRESHOLDS.min_gain_nats:
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

        Masses, shapes of spectra and the background were fitted without the law, which shapes spectra too. They are
        fitted again with it, and are kept as they were where that predicts better.
        """
        model, point = self.whole.model, self.whole.point
        richer = fit_model(point.data, [*point.placed, *best.placed], start=point)
        if set(unidentifiable_laws(richer)).issuperset(use.key for use in best.placed):
            return None
        new = replace(self.whole, model=fitted_model(model, richer), point=richer)
        shaped = any(use.name in SPECTRAL_AND_SENSOR_EFFECTS for use in model.effects)
        if not (self.whole.masses or shaped or model.background):
            return new
        again = replace(new.model, mass=self._given.mass, background=self._background)  # found anew
        refitted = _refitted(again, self._y, self._rate_hz)
        comparable = refitted.point.data.is_judged_like(richer.data)
        return new if comparable and heldout_nll(richer) < heldout_nll(refitted.point) else refitted

    def _with_settings(self, best: Entry) -> FullFit:
        """The model with an effect that is no law of a state.

        Forces of time alone make products with the motion that look like a parametric stiffness: its order is sought
        again.
        """
        given = self._given
        before = replace(
            self._unscaled(), ball_pass_order=given.ball_pass_order, order_found=False,
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
    value, low, high = (min(percent, 100.0) for percent in survey.interval)  # a share of the force
    return Rung(tuple(u.name for u in model.effects), nll, (value, low, high), rmse), survey
