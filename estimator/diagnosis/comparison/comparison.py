"""Model against measurement on held-out data, and a map of where the model fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from estimator.arrays import Array
from estimator.diagnosis.hypotheses.screen import Progress, quiet
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.judgeable import judging_layers, on_judgeable_record
from estimator.identification.record import UsableRecord
from estimator.identification.residual import missing_force
from estimator.likelihood.fitting.fitted_values import fitted_model
from estimator.model.rig import Model
from estimator.parallel import map_processes
from estimator.results import Message, Parameter, messages_json

from .curves import Law, Shape, curves
from .failure_map import FailureRegion, failure_regions
from .heldout import heldout_nll, heldout_rmse, reference_nll
from .survey import law_text, survey_bearing
from .twin import Twin, twin


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison(Twin):
    """A fitted model against the measurement. Forces, states and spectra in SI.

    heldout_nll : negative log-likelihood of held-out data, nats per sample. reference_nll : of a black box. missing :
    missing force, value and 95 % limits, per cent of the rms bearing force. where : regions of the states in which the
    model fails, largest share first. adequate : whether nothing predictable is left. curves : residual force against
    the states of every channel. laws : restoring force, measured and of the model. parameters : by full name.
    simulation_rmse : by channel, of a free run; empty unless a force is measured at every place. messages : for the
    user. Further fields are those of the simulated twin.
    """

    heldout_nll: float
    reference_nll: float
    missing: tuple[float, float, float]
    where: tuple[FailureRegion, ...]
    adequate: bool
    curves: tuple[Shape, ...] = ()
    laws: tuple[Law, ...] = ()
    parameters: dict[str, Parameter] = field(default_factory=dict)
    simulation_rmse: dict[str, float] = field(default_factory=dict)
    messages: tuple[Message, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The result of compare, by its schema."""
        value, low, high = self.missing
        out: dict[str, Any] = {
            "schema": 1,
            "heldout_nll": self.heldout_nll,
            "reference_nll": self.reference_nll,
            "missing_force_percent": {"value": value, "low": low, "high": high},
            "psd_distance_db": self.psd_distance_db,
            "pdf_distance": self.pdf_distance,
            "where": [asdict(w) for w in self.where],
            "adequate": self.adequate,
            "curves": [c.to_json() for c in self.curves],
            "laws": [law.to_json() for law in self.laws],
            "spectra": self.spectra,
            "densities": self.densities,
            "orbits": self.orbits,
            "parameters": {k: p.to_json() for k, p in self.parameters.items()},
        } | messages_json(self.messages)
        return out | ({"simulation_rmse": self.simulation_rmse} if self.simulation_rmse else {})


def compare(model: Model, y: Array, rate_hz: float, *, progress: Progress | None = None) -> Comparison:
    """Compare a fitted model with the measurement on held-out data, and map where it fails.

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
    Comparison
        The missing force with its 95 % limits, held-out likelihood, and curves of the residual force.

    Raises
    ------
    DataError
        The record cannot answer: too short, a dead channel, no resonance in the band.
    ModelError
        A model that makes no sense.

    Examples
    --------
    >>> from estimator import Channel, Model, Setting, compare, simulate
    >>> cap = {"bearing1.x": {"kL": Setting(1.0e7), "c": Setting(60.0), "S": Setting(1.0e-4)}}
    >>> rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 8000.0), mass={"bearing1": 0.2}, linear=cap)
    >>> compare(rig, simulate(rig, rate_hz=25600.0, seconds=4.0, seed=1), 25600.0).adequate
    True
    """
    say = progress or quiet
    say(0.0, "fit")
    layers = judging_layers(model, y, rate_hz)
    return on_judgeable_record(model, y, layers, lambda usable: _of_usable(usable, rate_hz, say))


def _of_usable(usable: UsableRecord, rate_hz: float, say: Progress) -> Comparison:
    """The comparison of a record whose channels are sound."""
    model, y = usable.model, usable.y
    whole = fit_all_effects(model, y, rate_hz)
    model, point = whole.model, whole.point
    say(0.4, "what can still be predicted")
    survey, rmse, beside, nll = survey_bearing(
        model, point, y, lambda: heldout_rmse(model, y, point.data.rate_hz),
        lambda: twin(fitted_model(model, point), point, y), lambda: heldout_nll(point),
    )  # fmt: skip
    found = survey.missing
    say(0.85, "where the model fails")
    channel = {p: next(c.name for c in model.channels if c.place == p) for p in point.data.places}
    asked: list[Callable[[], Any]] = [
        lambda: curves(point, found, channel, missing_force.stiffness_orders(model)),
        lambda: reference_nll(point, found, nll),
        lambda: failure_regions(point, found, channel),
    ]
    (drawn, laws), reference, where = map_processes(asked)
    say(1.0, "done")
    return Comparison(
        heldout_nll=nll,
        reference_nll=reference,
        missing=survey.interval,
        where=where,
        adequate=survey.adequate,
        curves=drawn,
        laws=laws,
        parameters=whole.parameters | dict(usable.parameters),
        simulation_rmse=rmse,
        messages=(
            *usable.messages,
            *whole.messages,
            *(() if survey.inconclusive is None else (survey.inconclusive,)),
            *(() if survey.law is None else (Message("law_predicts", law_text(survey.law)),)),
            *((Message("no_twin", beside.message),) if beside.message else ()),
        ),
        **{f.name: getattr(beside, f.name) for f in fields(beside)},
    )
