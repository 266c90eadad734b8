"""Masses of caps that the rig file leaves out, where the shaft, whose spring and disc are known, sets their scale.

Without them the motion blocks would weigh a cap 1 kg: right in proportion where nothing couples the caps, but beside a
shaft of known stiffness it is another rotor.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from . import spectral
from .effects.custom import effect_of
from .errors import DataError
from .estimate import Parameter
from .model import Model
from .periodic import PERIODIC
from .sensor_response import forced
from .working_point import WorkingPoint

Array = NDArray[np.float64]
FREE = "no mass is known, so only ratios are: give [rig.mass]"


def weighed(model: Model, y: Array, rate_hz: float) -> tuple[Model, dict[str, Parameter]]:
    """The model with the masses that its shaft and a record (n, channels) tell, and these as parameters by full name.

    Where a force is measured it sets the scale, and the mass is left to it.
    """
    left_out = unknown(model)
    if not left_out or model.shaft == "none" or model.shaft_stiffness == 0.0 or "disc" not in model.mass:
        return model, {}
    laws = tuple(u for u in model.effects if effect_of(u).kind == "force" and u.name not in PERIODIC)
    try:
        fitted = spectral.report(spectral.analyse(replace(model, effects=laws), y, rate_hz))
    except DataError:  # the fit that follows says what is wrong
        return model, {}
    told = {f"{p}.m": fitted[f"{p}.m"] for p in left_out}
    found = {p: q.value for p in left_out if (q := told[f"{p}.m"]).identifiable and q.value and q.value > 0.0}
    return replace(model, mass={**model.mass, **found}), {f"{p}.m": told[f"{p}.m"] for p in found}


def unknown(model: Model) -> list[str]:
    """Places whose mass nothing tells."""
    return [p for p in model.places if model.cap_mass(p) is None and p not in forced(model)]


def ratios(model: Model, point: WorkingPoint) -> tuple[str, ...]:
    """What to tell the user of places whose mass nothing tells."""
    at = [point.data.places.index(p) for p in unknown(model)]
    return tuple(
        spectral.ratios_only(point.data.places[i], point.kL[i], point.c[i], point.data.mass[i])
        for i in at if point.kL[i] > 0.0
    )  # fmt: skip


def said(told: dict[str, Parameter]) -> tuple[str, ...]:
    """What to tell the user of them."""
    if not told:
        return ()
    values = ", ".join(f"{name.removesuffix('.m')} {q.value:.4g} kg" for name, q in told.items())
    return (f"masses that the rig file leaves out are as the shaft has them: {values}; the rest is fitted with these",)
