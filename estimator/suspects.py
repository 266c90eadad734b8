"""Everything that can be wrong with a record besides a force law on its states."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import force_colour, line_forces, sensor_faults
from .model import Model
from .model_uses import not_judged
from .suspect import Suspect
from .working_point import WorkingPoint

Array = NDArray[np.float64]


def suspects(model: Model, point: WorkingPoint, y: Array) -> list[Suspect]:
    """Lines, shaped or shared forces, sensor faults, strongest first; of a clipped channel nothing else."""
    clipped = sensor_faults.find(model, y)
    if point.data.measured_force:
        return clipped  # what is left of a known force has no spectrum of its own to judge
    bad = {p for s in clipped for p in s.at} | {point.data.places[i] for i in not_judged(model, point.data.places)}
    rest = line_forces.find(model, point, y, point.data.rate_hz) + force_colour.find(model, point)
    kept = [s for s in rest if not (set(s.at) & bad)]
    return clipped + sorted(kept, key=lambda s: -s.gain)
