"""Gate of a spectral shape: does it, fitted together with the model, explain the missing spectrum?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects.sensor.sensor_noise import SENSOR_NOISE
from estimator.errors import DataError
from estimator.identification.batch.disturbance_numbers import with_found_effects
from estimator.identification.batch.full_fit import FullFit, fit_all_effects
from estimator.identification.finding import Finding
from estimator.identification.residual import missing_force
from estimator.identification.residual.missing_force import MissingForce
from estimator.identification.search import search
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.results import Message

from .gate_residual import GateResult


def spectrum_gate(model: Model, point: WorkingPoint, y: Array, before: MissingForce, entry: Entry) -> GateResult:
    """Whether a spectral shape, fitted together with the model to part of the record, explains the missing spectrum.

    In the residual of a model without it another shape may pass for the right one, with another stiffness and damping.
    Noise of the sensor may be present too. It is then fitted together with the shape. The misfit is None where too
    little of the record is valid.
    """
    if (seen := _spectrum_left(model, point, y, before, entry)) is None:
        return GateResult(entry, None)
    best, share, beside = seen
    noise = {p: own for f in beside if f.effect == SENSOR_NOISE.name for p, own in f.settings.items()}
    if share > THRESHOLDS.spectrum_misfit_max_rel**2 and noise:
        both = replace(best, settings={**best.settings, SENSOR_NOISE.name: noise})
        again = _spectrum_left(model, point, y, before, both)
        if again is not None and again[1] <= THRESHOLDS.spectrum_misfit_max_rel**2:
            text = f"together with noise of the sensor at {', '.join(noise)} it explains the whole spectrum"
            best, share = replace(best, notes=(*best.notes, Message("sensor_noise_too", text))), again[1]
    return GateResult(best, float(np.sqrt(share)), share <= THRESHOLDS.spectrum_misfit_max_rel**2)


def _fit_of_part(model: Model, y: Array, rate_hz: float, entry: Entry) -> tuple[FullFit, Array] | None:
    """The model with a candidate fitted to the first part of the record, and that part.

    None where too little of it is valid.
    """
    part = y[: int(missing_force.SURVEY_S * rate_hz)]
    try:
        return fit_all_effects(with_found_effects(model, entry.settings), part, rate_hz), part
    except DataError:
        return None


def _spectrum_left(
    model: Model, point: WorkingPoint, y: Array, before: MissingForce, entry: Entry
) -> tuple[Entry, float, list[Finding]] | None:  # fmt: skip
    """A spectral shape fitted to part of the record, the share of the missing power that it leaves, other findings.

    None where too little of the record is valid.
    """
    if (fitted := _fit_of_part(model, y, point.data.rate_hz, entry)) is None:
        return None
    whole, part = fitted
    beside = search(whole.model, whole.point, part)
    after = missing_force.survey(whole.point, whole.model, only=before.places_found(), others=beside)
    places = tuple(sorted({whole.point.data.places.index(p) for own in entry.settings.values() for p in own}))
    # the force that goes with a state belongs to another effect
    was, rest = (sum(share.power_N2 for share in it.disturbances if share.place in places) for it in (before, after))
    return replace(entry, after_percent=after.interval(places)[0]), rest / max(was, 1e-300), beside
