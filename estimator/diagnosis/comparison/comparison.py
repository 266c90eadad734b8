"""Model against measurement on held-out data, and a map of where the model fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from estimator.arrays import Array
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.record import clipping
from estimator.identification.residual import missing_force
from estimator.identification.search import search
from estimator.likelihood.fitting.fitted_values import fitted_model
from estimator.likelihood.path.working_point import point_on_part
from estimator.model.rig import Model
from estimator.parallel import map_processes
from estimator.results import Message, Parameter, messages_json

from .curves import Law, curves
from .failure_map import Where, where_of
from .heldout import heldout_nll, heldout_rmse, reference_nll
from .shape import Shape
from .twin import twin

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Comparison:
    """As schemas/compare.json; missing : value, low, high in per cent of the rms bearing force, 95 %.

    curves : residual force against the states of every channel; laws : restoring force, measured and the model's.
    """

    heldout_nll: float
    reference_nll: float
    missing: tuple[float, float, float]
    psd_distance_db: dict[str, float]
    pdf_distance: dict[str, float]
    where: tuple[Where, ...]
    adequate: bool
    curves: tuple[Shape, ...] = ()
    laws: tuple[Law, ...] = ()
    spectra: dict[str, Any] = field(default_factory=dict)
    densities: dict[str, Any] = field(default_factory=dict)
    orbits: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, Parameter] = field(default_factory=dict)
    simulation_rmse: dict[str, float] = field(default_factory=dict)
    messages: tuple[Message, ...] = ()

    def to_json(self) -> dict[str, Any]:
        value, low, high = self.missing
        out: dict[str, Any] = {
            "schema": 1,
            "heldout_nll": self.heldout_nll,
            "reference_nll": self.reference_nll,
            "missing_force_percent": {"value": value, "low": low, "high": high},
            "psd_distance_db": self.psd_distance_db,
            "pdf_distance": self.pdf_distance,
            "where": [w.to_json() for w in self.where],
            "adequate": self.adequate,
            "curves": [c.to_json() for c in self.curves],
            "laws": [law.to_json() for law in self.laws],
            "spectra": self.spectra,
            "densities": self.densities,
            "orbits": self.orbits,
            "parameters": {k: p.to_json() for k, p in self.parameters.items()},
        } | messages_json(self.messages)
        return out | ({"simulation_rmse": self.simulation_rmse} if self.simulation_rmse else {})


def compare(model: Model, y: Array, rate_hz: float, progress: Progress | None = None) -> Comparison:
    """Fit the model on the record's time folds, judge it on the others. y : (n, channels), SI, NaN where missing.

    Raises DataError if the record cannot answer, ModelError for a model that makes no sense.
    """
    say = progress or (lambda fraction, text: None)
    say(0.0, "fit")
    whole = fit_all_effects(model, y, rate_hz)
    model, point = whole.model, whole.point
    say(0.4, "what can still be predicted")
    part = point_on_part(point, missing_force.SURVEY_S)
    found, others, rmse, beside, nll = missing_force.survey_with(
        part, model, lambda: search(model, point, y), lambda: heldout_rmse(model, y, point.data.rate_hz),
        lambda: twin(fitted_model(model, point), point, y), lambda: heldout_nll(point),
    )  # fmt: skip
    clipped = [clipping.clipped_message(s) for s in others if s.effect == "sensor_clipping"]
    say(0.85, "where the model fails")
    channel = {p: next(c.name for c in model.channels if c.place == p) for p in point.data.places}
    asked: list[Callable[[], Any]] = [
        lambda: curves(point, found, channel, missing_force.stiffness_orders(model)),
        lambda: reference_nll(point, found, nll),
        lambda: where_of(point, found, channel),
    ]
    (drawn, laws), reference, where = map_processes(asked)
    say(1.0, "done")
    return Comparison(
        heldout_nll=nll,
        reference_nll=reference,
        missing=found.interval(),
        psd_distance_db=beside.psd_distance_db,
        pdf_distance=beside.pdf_distance,
        where=where,
        adequate=found.looked_anywhere() and not found.any_found(),
        curves=drawn,
        laws=laws,
        spectra=beside.spectra,
        densities=beside.densities,
        orbits=beside.orbits,
        parameters=whole.parameters,
        simulation_rmse=rmse,
        messages=(
            *whole.messages,
            *clipped,
            *missing_force.unjudged_messages(found),
            *((Message("no_twin", beside.message),) if beside.message else ()),
        ),
    )
