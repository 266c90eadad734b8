"""What a fitted model leaves over: the one survey that `compare`, `diagnose` and `improve` read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from estimator.arrays import Array, return_freed_memory
from estimator.identification.finding import Finding
from estimator.identification.residual import missing_force
from estimator.identification.residual.missing_force import MissingForce
from estimator.identification.search import search
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model


@dataclass(frozen=True, slots=True, kw_only=True)
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
    """

    part: WorkingPoint
    missing: MissingForce
    findings: tuple[Finding, ...]

    @property
    def adequate(self) -> bool:
        """Whether nothing is missing: no force is found, or a negligible one, or one that may be zero."""
        value, low, _ = self.missing.interval()
        least = 100 * missing_force.NEGLIGIBLE_FORCE_SHARE
        return not self.missing.any_found() or value < least or low <= 0.0


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
    return BearingSurvey(part=part, missing=found, findings=tuple(findings)), *answers
