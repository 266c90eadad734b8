"""What a fitted model leaves over: the one survey that `compare`, `diagnose` and `improve` read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from estimator.arrays import Array, return_freed_memory
from estimator.identification.finding import Finding
from estimator.identification.residual import missing_force
from estimator.identification.residual.missing_force import MissingForce
from estimator.identification.residual.strong_law import strong_law_message
from estimator.identification.search import search
from estimator.likelihood.fitting.fitted_values import fitted_parameters
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.likelihood.thresholds import LIMITS as LIKELIHOOD_LIMITS
from estimator.model.rig import Model
from estimator.results import NOT_CONCLUSIVE, Message

from .thresholds import LIMITS


@dataclass(frozen=True, kw_only=True)
class BearingSurvey:
    """What a fitted model leaves over.

    Parameters
    ----------
    part : WorkingPoint
        The model on the part of the record that is surveyed.
    missing : MissingForce
        The force that can still be predicted there.
    findings : tuple of Finding
        Tones, spectra and faults of sensors, strongest first.
    speed_lacks : bool
        Whether the geometry of the bearing is given and the speed of the shaft is unknown.
    unexplained_places : tuple of str
        Measured places where no mode can be the bearing's.
    """

    part: WorkingPoint
    missing: MissingForce
    findings: tuple[Finding, ...]
    speed_lacks: bool = False
    unexplained_places: tuple[str, ...] = ()

    @property
    def explained(self) -> bool:
        """Whether nothing missing is found: no force, or a negligible one, or one that may be zero."""
        value, low, _ = self.missing.interval()
        least = 100 * missing_force.negligible_force_share(self.part.data)
        return not self.missing.any_found() or value < least or low <= 0.0

    @cached_property
    def too_strong(self) -> Message | None:
        """Why nothing is named: the laws of the model vary a stiffness by more than the fit can follow; else None."""
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
        hidden = self.missing.interval()[2]
        if loose:
            text = f"the record does not tell the stiffness of {', '.join(loose)}: an effect could hide behind it"
            return Message(NOT_CONCLUSIVE, f"{text}; record longer, or add a channel at the other bearing")
        if hidden > LIMITS.max_hidden_force_percent:
            text = f"no missing force is found, but one of up to {hidden:.1f} % of the bearing force could hide"
            return Message(NOT_CONCLUSIVE, f"{text}; record longer")
        if self.unexplained_places:
            text = f"no missing force is found, but {', '.join(self.unexplained_places)} cannot be judged"
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
        """Whether nothing is missing: no missing force is found, and none could hide."""
        return self.explained and self.inconclusive is None


def survey_bearing(
    model: Model, point: WorkingPoint, y: Array, *more: Callable[[], Any]
) -> tuple[BearingSurvey, *tuple[Any, ...]]:
    """The survey of a fitted model, and the answers of `more`, computed beside it.

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
    """
    return_freed_memory(y)
    part = point_on_part(point, missing_force.survey_seconds(point.data.rate_hz))
    found, findings, *answers = missing_force.survey_with(part, model, lambda: search(model, point, y), *more)
    lacks = model.bearing is not None and not point.data.speed
    survey = BearingSurvey(
        part=part, missing=found, findings=tuple(findings), speed_lacks=lacks,
        unexplained_places=model.unexplained_places,
    )  # fmt: skip
    return survey, *answers
