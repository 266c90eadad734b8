"""Fit of a record by any method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from typing import Literal

from estimator.arrays import Array
from estimator.model.rig import Model
from estimator.results import Fit

from .judgeable import judging_layers, on_judgeable_record
from .record import UsableRecord

Method = Literal["spectral", "fokker-planck", "score-matching"]
_FIT_METHODS: Mapping[Method, tuple[str, str]] = {  # module and function
    "spectral": ("batch.spectral", "fit_spectral"),
    "fokker-planck": ("moments.fokker_planck", "fit_fokker_planck"),
    "score-matching": ("moments.score_matching", "fit_score_matching"),
}


def fit(model: Model, y: Array, rate_hz: float, *, method: Method = "spectral") -> Fit:
    """Estimate the parameters of a rig from a record.

    Parameters
    ----------
    model : Model
        The rig. Linear values and parameters of effects may be unknown (None); they are fitted.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``. NaN where a sample is missing or clipped.
    rate_hz : float
        Sampling rate, Hz.
    method : {"spectral", "fokker-planck", "score-matching"}
        ``spectral`` is the path likelihood of the force balance and the most precise. The others are the independent
        methods of the literature; they need white excitation and known masses.

    Returns
    -------
    Fit
        Parameters by full name such as ``bearing1.x.kL``, each with its standard deviation and unit.

    Raises
    ------
    DataError
        The record cannot answer: too short, a dead channel, no resonance in the band.

    References
    ----------
    Tiwari and Vyas, J. Sound Vib. 203 (1997) 389.

    Examples
    --------
    >>> from estimator import Channel, Model, Setting, fit, simulate
    >>> cap = {"bearing1.x": {"kL": Setting(1.0e7), "c": Setting(60.0), "S": Setting(1.0e-4)}}
    >>> rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 8000.0), mass={"bearing1": 0.2}, linear=cap)
    >>> record = simulate(rig, rate_hz=25600.0, seconds=4.0, seed=1)
    >>> stiffness = fit(rig, record, 25600.0).parameters["bearing1.x.kL"]
    >>> abs(stiffness.value - 1.0e7) < 4.0 * stiffness.sd
    True
    """

    def fitted(usable: UsableRecord) -> Fit:
        module, function = _FIT_METHODS[method]
        result: Fit = getattr(import_module(f"{__package__}.{module}"), function)(usable.model, usable.y, rate_hz)
        parameters = dict(result.parameters) | dict(usable.parameters)
        return replace(result, parameters=parameters, messages=(*usable.messages, *result.messages))

    return on_judgeable_record(model, y, judging_layers(model, y, rate_hz), fitted)
