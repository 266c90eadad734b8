"""Mistakes in the rig file on trial by the spectra of the caps.

The spectra of the caps are explained by the rig as it is given and by each changed one, each with the structural modes
and the spectrum of the force that it needs. The likelihood, less what the modes cost, says which rig is likelier.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from estimator.arrays import Array
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects.engine.custom import effect_of
from estimator.errors import ModelError
from estimator.identification.batch.grid_start import fit_record
from estimator.identification.structure.cross_spectra import SearchTooLongError
from estimator.identification.structure.rig_spectra import Arrangement, RigFit, RigSpectra
from estimator.identification.structure.thresholds import LIMITS as STRUCTURE_LIMITS
from estimator.likelihood.motion.prepare import prepare
from estimator.model.rig import Model

from .rig_changes import Hypothesis, SwappedChannels, Values, coupling_hypotheses


@dataclass(frozen=True, slots=True, kw_only=True)
class Mistake:
    """A mistake in the rig file that makes the spectra of the caps likelier.

    Parameters
    ----------
    hypothesis, values : Hypothesis, tuple of float
        What is changed, and to what.
    gain_nats : float
        Log-likelihood gained by the change, less what structural modes cost.
    rivals : tuple of str
        What to check of other mistakes that the record does not tell from it.
    """

    hypothesis: Hypothesis
    values: Values
    gain_nats: float
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Trial:
    """A hypothesis with values, and the spectra explained by the changed rig."""

    hypothesis: Hypothesis
    values: Values
    fit: RigFit


@dataclass(frozen=True, slots=True, kw_only=True)
class MistakeTrial:
    """The result of the trial of mistakes in the rig file.

    Parameters
    ----------
    mistake : Mistake or None
        The mistake with which the rig explains the spectra of the caps best; None where the rig as given does as well.
    asked, tried : int
        Numbers of mistakes that make sense for the rig, and of those that the work allowed for a trial sufficed for.
    """

    mistake: Mistake | None = None
    asked: int = 0
    tried: int = 0


class _Trials:
    """Hypotheses on the rig file of a record, on trial by the spectra of the caps. model : without a change."""

    def __init__(self, model: Model, spectra: RigSpectra, asked: Sequence[Hypothesis]) -> None:
        self.model, self.spectra, self.asked = model, spectra, asked
        self.pending = [h.name for h in asked]  # not settled yet

    def screened(self, start: RigFit | None, least_nats: float) -> list[_Trial]:
        """The likeliest hypotheses with the modes of another fit, or without modes, each with its likeliest value.

        least_nats : gain above which a hypothesis is kept.
        """
        tried = [trial for h in self.asked for trial in self._values_tried(h, start)]
        by_name: dict[str, _Trial] = {}
        for trial in sorted(tried, key=lambda t: -t.fit.nats):
            by_name.setdefault(trial.hypothesis.name, trial)
        best = [*by_name.values()][: THRESHOLDS.max_searched]
        if start is not None:
            best = [replace(t, fit=self.spectra.without_idle_modes(t.fit)) for t in best]
        return [t for t in best if t.fit.nats > least_nats]

    def _values_tried(self, hypothesis: Hypothesis, start: RigFit | None) -> list[_Trial]:
        """Trials of a hypothesis at its proposed values, and along its factor from the fit of the rig as given."""
        values, followed = hypothesis.propose(self.model), []
        if start is not None and any(values):
            for step in (THRESHOLDS.followed_step_log, -THRESHOLDS.followed_step_log):
                followed += self._followed(hypothesis, start, 0.0, step)
            reached = [t.values[0] for t in followed] or [1.0]
            values = [own for own in values if not min(reached) < own[0] < max(reached)]
        return followed + [t for own in values if (t := self.tried(hypothesis, own, start)) is not None]

    def _followed(self, hypothesis: Hypothesis, fit: RigFit, ln_factor: float, step: float) -> list[_Trial]:
        """Trials of a hypothesis along its factor, each started from the last fit, until two in a row lose nats.

        fit, ln_factor : where it begins. step : of the logarithm.
        """
        out: list[_Trial] = []
        best, falls = fit.nats, 0
        while falls < 2 and abs(ln_factor + step) < THRESHOLDS.max_log_factor:
            ln_factor += step
            trial = self.tried(hypothesis, (float(np.exp(ln_factor)), 1.0), fit)
            if trial is None:
                break
            out.append(trial)
            fit, falls = trial.fit, 0 if trial.fit.nats > best else falls + 1
            best = max(best, fit.nats)
        return out

    def tried(self, hypothesis: Hypothesis, values: Values, start: RigFit | None) -> _Trial | None:
        """The trial of a hypothesis with the modes of another fit, or without; None where the rig then has no fit."""
        try:
            fit = self.spectra.tried(*self._changed(hypothesis, values), start)
        except (np.linalg.LinAlgError, ModelError):
            return None
        return _Trial(hypothesis=hypothesis, values=values, fit=fit)

    def searched_in_turn(self, trials: Sequence[_Trial]) -> list[_Trial]:
        """Trials whose modes are searched, the likeliest first; after one that explains the spectra only its rivals.

        The work of a trial is limited: hypotheses that it does not reach stay pending.
        """
        found: list[_Trial] = []
        reach = THRESHOLDS.rival_costs * self.spectra.cost_nats
        self.pending = [t.hypothesis.name for t in trials]
        with suppress(SearchTooLongError):
            for trial in trials:
                if not found or not found[0].fit.explains or trial.fit.nats > found[0].fit.nats - reach:
                    found = sorted([*found, self._searched(trial)], key=lambda t: -t.fit.nats)
                self.pending.remove(trial.hypothesis.name)
        return found

    def _searched(self, trial: _Trial) -> _Trial:
        """The trial of a hypothesis with more modes, if they are found, and its likeliest factor.

        Where these modes explain too little, they are also sought from a start without modes.
        """
        trial = self._refined(trial)
        for start in (trial.fit, None):
            with suppress(np.linalg.LinAlgError):
                found = self.spectra.searched(*self._changed(trial.hypothesis, trial.values), start)
                if found.nats > trial.fit.nats + self.spectra.cost_nats:
                    trial = self._refined(replace(trial, fit=found))
            if trial.fit.explains and trial.fit.coherence_p_value > THRESHOLDS.max_p_value:
                break
        return trial

    def _changed(self, hypothesis: Hypothesis, values: Values) -> tuple[Model, Arrangement]:
        """The model whose masses and shaft are changed, and where the channels are."""
        arranged = hypothesis.arrange(self.model, self.spectra.as_given, self.spectra.places)
        if arranged != self.spectra.as_given:
            return self.model, arranged
        return hypothesis.apply(self.model, values), arranged

    def _refined(self, trial: _Trial) -> _Trial:
        """The trial at the likeliest factor, with the standard deviation of the logarithm of the factor."""
        if not trial.values:
            return trial

        def at(ln_factor: float) -> float:
            found = self.tried(trial.hypothesis, (float(np.exp(ln_factor)), 0.0), trial.fit)
            return THRESHOLDS.unsound_nats if found is None else found.fit.nats

        begin = float(np.log(trial.values[0]))
        for step in (THRESHOLDS.followed_step_log, -THRESHOLDS.followed_step_log):
            trial = max([trial, *self._followed(trial.hypothesis, trial.fit, begin, step)], key=lambda t: t.fit.nats)
        middle = float(np.log(trial.values[0]))
        reach = THRESHOLDS.followed_step_log
        best = minimize_scalar(
            lambda u: -at(u), bounds=(middle - reach, middle + reach), method="bounded",
            options={"maxiter": THRESHOLDS.refining_steps},
        )  # fmt: skip
        ln_factor = float(best.x) if -best.fun > trial.fit.nats else middle
        fall = at(ln_factor) - 0.5 * (
            at(ln_factor - THRESHOLDS.factor_step_log) + at(ln_factor + THRESHOLDS.factor_step_log)
        )
        sd = THRESHOLDS.factor_step_log / np.sqrt(2.0 * max(fall, THRESHOLDS.min_fall_nats))
        values = float(np.exp(ln_factor)), float(sd)
        found = self.tried(trial.hypothesis, values, trial.fit)
        if found is not None and found.fit.nats > trial.fit.nats:
            return found
        return replace(trial, values=(trial.values[0], float(sd)))


def likeliest_mistake(
    model: Model, y: Array, rate_hz: float, max_work: float = STRUCTURE_LIMITS.max_work_derivatives
) -> MistakeTrial:  # fmt: skip
    """The mistake with which the rig explains the spectra of the caps best, of those that are tried.

    Parameters
    ----------
    model : Model
        As the rig file has it, without disturbances, with the background that was found.
    y : (n, channels) float64
        Samples, SI.
    rate_hz : float
        Sampling rate, Hz.
    max_work : float
        Derivatives of spectra that each stage of the trial may take.

    Raises
    ------
    DataError
        The record is too short.
    """
    asked = coupling_hypotheses(model)
    if not asked:
        return MistakeTrial()
    laws = [use for use in model.effects if effect_of(use).kind == "force"]  # a wrong rig makes nonsense of them
    effects = tuple(use for use in model.effects if use not in laws)
    model, background = replace(model, background=None, effects=effects), model.background
    point = fit_record(model, prepare(model, y[: THRESHOLDS.trial_rows], rate_hz))
    trials = _Trials(model, RigSpectra(model, point, max_work), asked)
    mistake = None
    with suppress(np.linalg.LinAlgError, SearchTooLongError):
        mistake = _likeliest(trials, trials.spectra.as_fitted(model, background))
    return MistakeTrial(mistake=mistake, asked=len(asked), tried=len(asked) - len({*trials.pending}))


def _likeliest(trials: _Trials, given: RigFit) -> Mistake | None:
    """The mistake that explains the spectra best; None for none. given : the fit of the rig as given."""
    model, spectra = trials.model, trials.spectra
    given, contenders = _contenders(trials, given)
    found = trials.searched_in_turn(sorted(contenders, key=lambda t: -t.fit.nats))
    if not found or not (found[0].fit.explains or _explains_coherence(given, found[0].fit)):
        return None
    found = _with_rivals(trials, found)
    best, least = found[0], THRESHOLDS.rival_nats * found[0].fit.dispersion * spectra.dispersion
    if best.fit.nats - given.nats < least or not best.hypothesis.is_slip(best.values):
        return None
    spectra.begin_again()  # the rig as given has the modes of the best one on trial too
    trials.pending.append(best.hypothesis.name)
    with suppress(np.linalg.LinAlgError):
        again = spectra.without_idle_modes(spectra.searched(model, spectra.as_given, best.fit))
        given = max(given, again, key=lambda fit: fit.nats)
    trials.pending.remove(best.hypothesis.name)
    if (gain := best.fit.nats - given.nats) < least:
        return None
    near_best = [t for t in found[1:] if t.fit.nats > best.fit.nats - least]
    rivals = {t.hypothesis.name: t.hypothesis.text(model, t.values) for t in near_best}
    rivals |= {h.name: h.text(model, ()) for h in trials.asked if _is_twin(best.hypothesis, h)}
    rivals.pop(best.hypothesis.name, None)
    return Mistake(hypothesis=best.hypothesis, values=best.values, gain_nats=gain, rivals=tuple(rivals.values()))


def _contenders(trials: _Trials, given: RigFit) -> tuple[RigFit, list[_Trial]]:
    """The fit of the rig as given, and the likeliest hypotheses.

    Modes of the rig as given are sought where no changed one is far ahead.
    """
    model, spectra = trials.model, trials.spectra
    if given.explains:
        return given, trials.screened(given, given.nats + THRESHOLDS.min_screened_nats)
    plain = spectra.tried(model, spectra.as_given, None)
    contenders = trials.screened(None, plain.nats + THRESHOLDS.min_screened_nats)
    ahead = max((t.fit.nats for t in contenders), default=plain.nats) - plain.nats
    if ahead < THRESHOLDS.rival_costs * spectra.cost_nats:
        own = spectra.without_idle_modes(spectra.searched(model, spectra.as_given))
        given = max(given, own, key=lambda fit: fit.nats)
    spectra.begin_again()
    if given.explains:
        return given, trials.screened(given, given.nats + THRESHOLDS.min_screened_nats)
    if all(t.fit.nats < given.nats for t in contenders):
        contenders += trials.screened(given, given.nats + THRESHOLDS.min_screened_nats)
    return given, contenders


def _with_rivals(trials: _Trials, found: list[_Trial]) -> list[_Trial]:
    """Trials extended by hypotheses that come near the likeliest one when they use its modes, the likeliest first."""
    best, names = found[0].fit, {t.hypothesis.name for t in found}
    trials.spectra.begin_again()
    unsettled = [*trials.pending, found[0].hypothesis.name]
    trials.pending = unsettled
    near = trials.screened(best, best.nats - THRESHOLDS.rival_costs * trials.spectra.cost_nats)
    rivals = trials.searched_in_turn([t for t in near if t.hypothesis.name not in names])
    trials.pending += unsettled[:-1]
    return sorted([*found, *rivals], key=lambda t: -t.fit.nats)


def _is_twin(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether two swaps leave the same channels in one direction: the masses of the caps alone tell them apart."""
    if not (isinstance(one, SwappedChannels) and isinstance(other, SwappedChannels)):
        return False
    return not {one.first, one.second} & {other.first, other.second}


def _explains_coherence(given: RigFit, changed: RigFit) -> bool:
    """Whether the caps predict each other with the rig as given, and little with the changed one."""
    if given.coherence_p_value > THRESHOLDS.coherence_max_p_value:
        return False
    return changed.coherence_nats <= THRESHOLDS.coherence_max_left_rel * given.coherence_nats
