"""Survey of what a fitted model leaves unexplained: `compare`, `diagnose` and `improve` read this survey."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from estimator.arrays import Array, return_freed_memory
from estimator.diagnosis.hypotheses.ranking import Entry, is_sure_law
from estimator.diagnosis.hypotheses.screen import Progress, Ranking, quiet, rank_on_part
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.errors import NotFiniteError
from estimator.identification.finding import Finding
from estimator.identification.residual import missing_force
from estimator.identification.residual.missing_force import MissingForce
from estimator.identification.residual.strong_law import strong_law_message
from estimator.identification.search import search
from estimator.likelihood.fitting.fitted_values import fitted_parameters
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.likelihood.thresholds import LIMITS as LIKELIHOOD_LIMITS
from estimator.model.rig import Model
from estimator.results import NOT_CONCLUSIVE, Message

from .heldout import heldout_gain_nats
from .thresholds import LIMITS


def has_impossible_amplitude(entry: Entry, after: WorkingPoint) -> bool:
    """Whether a law is fitted with an amplitude beyond its limits, such as a damping that drives the rotor."""
    known = fitted_parameters(after)
    names = {law.name(k): q for law in entry.placed for k, q in enumerate(law.effect.parameters) if q.linear}
    values = ((known[name].value, q) for name, q in names.items() if name in known)
    return any(value is not None and not q.low <= value <= q.high for value, q in values)


def law_text(law: Entry) -> str:
    """How much better a law predicts the residual force, for a message."""
    where = ", ".join(law.at)
    return f"{law.effect} at {where} predicts the residual force better, by {law.heldout_gain:.0f} held-out nats"


@dataclass(frozen=True, kw_only=True)
class BearingSurvey:
    """The part of a record that a fitted model leaves unexplained, with its causes.

    Parameters
    ----------
    model : Model
        The model of the working point.
    part : WorkingPoint
        The model on the part of the record that is surveyed.
    missing : MissingForce
        The force that can still be predicted there.
    findings : tuple of Finding
        Tones, spectra and faults of sensors, strongest first.
    speed_lacks : bool
        Whether the geometry of the bearing is given and the speed of the shaft is unknown.
    say : callable
        Progress of the trials.
    """

    model: Model
    part: WorkingPoint
    missing: MissingForce
    findings: tuple[Finding, ...]
    speed_lacks: bool = False
    say: Progress = quiet

    @cached_property
    def ranking(self) -> Ranking:
        """The ranking of the causes of the missing force, from the part of the record that was surveyed."""
        return rank_on_part(self.model, self.part, self.missing, self.findings, self.say)

    @cached_property
    def law(self) -> Entry | None:
        """The law that predicts a force beside structural modes that no regressor on the states predicts; else None.

        Errors of the modes hide a force from the regressors that the one law of the right form finds.
        """
        if self.part.data.background is None or not self._explained_by_states:
            return None
        sure_laws = [e for e in self.ranking.entries if is_sure_law(e)]
        return next((e for e in sure_laws[: LIMITS.max_fitted_laws] if self._holds_when_fitted(e)), None)

    def _holds_when_fitted(self, law: Entry) -> bool:
        """Whether a law still predicts, with a possible amplitude, when it is fitted together with the model."""
        part = self.part
        try:
            after = fit_model(part.data, [*part.placed, *law.placed], start=part)
            gains = heldout_gain_nats(part, after) >= THRESHOLDS.rival_nats
        except NotFiniteError:
            return False
        return gains and not has_impossible_amplitude(law, after)

    @property
    def interval(self) -> tuple[float, float, float]:
        """Rms of the missing force and its 95 % limits, per cent of the rms bearing force."""
        if self.law is None:
            return self.missing.interval()
        return self.law.explained_percent, *self.law.explained_limits_percent

    @property
    def explained(self) -> bool:
        """Whether no missing force is found, or only a force that is negligible or may be zero."""
        return self._explained_by_states and self.law is None

    @property
    def _explained_by_states(self) -> bool:
        """Whether neither the regressors on the states nor the findings show a missing force."""
        value, low, _ = self.missing.interval()
        least = 100 * missing_force.negligible_force_share(self.part.data)
        return not self.missing.any_found() or value < least or low <= 0.0

    @cached_property
    def too_strong(self) -> Message | None:
        """Why no law is named: the laws of the model vary a stiffness by more than the fit can follow; else None."""
        return strong_law_message(self.part)

    @cached_property
    def inconclusive(self) -> Message | None:
        """Why the record does not decide whether a force is missing; None where it decides.

        A law is too strong for the fit, or none is found to be missing and one could hide.

        Structural modes and the spectrum of the force may explain what a law does: where they leave the stiffness of
        the bearing open, and in a short record. Without a speed no law of the shaft's angle is on trial. A place
        that no mode explains shows no law.
        """
        if self.too_strong is not None or not self.explained:
            return self.too_strong
        fitted = fitted_parameters(self.part)
        loose = [place for place in self.part.data.places if not fitted[f"{place}.kL"].identifiable]
        hidden = self.interval[2]
        if loose:
            text = f"the record does not tell the stiffness of {', '.join(loose)}: an effect could hide behind it"
            return Message(NOT_CONCLUSIVE, f"{text}; record longer, or add a channel at the other bearing")
        if hidden > LIMITS.max_hidden_force_percent:
            text = f"no missing force is found, but one of up to {hidden:.1f} % of the bearing force could hide"
            return Message(NOT_CONCLUSIVE, f"{text}; record longer")
        if self.model.unexplained_places:
            text = f"no missing force is found, but {', '.join(self.model.unexplained_places)} cannot be judged"
            return Message(NOT_CONCLUSIVE, f"{text}: give the masses, or narrow the band to the bearing's mode")
        if self.speed_lacks:
            text = "no missing force is found, but what turns with the shaft is not looked for, as its speed is unknown"
            return Message(NOT_CONCLUSIVE, f"{text}: give speed_rpm or a tacho channel")
        data = self.part.data
        asked_s = max(LIMITS.min_seconds_beside_modes, LIKELIHOOD_LIMITS.min_samples / data.rate_hz)
        if data.background is not None and data.seconds < asked_s:
            text = f"beside structural modes {data.seconds:.0f} s do not show every effect"
            return Message(
                NOT_CONCLUSIVE, f"no missing force is found, but {text}; record {2.0 * asked_s:.0f} s or more"
            )
        return None

    @property
    def adequate(self) -> bool:
        """Whether the model is adequate: no missing force is found, and none could go unnoticed."""
        return self.explained and self.inconclusive is None


def survey_bearing(
    model: Model, point: WorkingPoint, y: Array, *more: Callable[[], Any], say: Progress = quiet
) -> tuple[BearingSurvey, *tuple[Any, ...]]:
    """The survey of a fitted model, and the results of the functions `more`, computed in parallel.

    Parameters
    ----------
    model : Model
        The model of the working point.
    point : WorkingPoint
        The model fitted to the record.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``.
    more : callables
        Further questions.
    say : callable
        Progress of the trials of laws.
    """
    return_freed_memory(y)
    part = point_on_part(point, missing_force.survey_seconds(point.data.rate_hz))
    found, findings, *answers = missing_force.survey_with(part, model, lambda: search(model, point, y), *more)
    lacks = model.bearing is not None and not point.data.speed
    survey = BearingSurvey(
        model=model, part=part, missing=found, findings=tuple(findings), speed_lacks=lacks, say=say
    )  # fmt: skip
    return survey, *answers
