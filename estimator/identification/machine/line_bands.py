"""Narrow lines of a record as bands that the force balance leaves out."""

from __future__ import annotations

from dataclasses import replace

from estimator.arrays import Array
from estimator.likelihood.motion.harmonics import has_unknown_line, known_lines
from estimator.model.rig import MOTION_UNITS, Model

from .spectra import channel_spectra
from .tones import joined_bands, lines_to_leave_out, significant_lines


def with_lines_left_out(model: Model, y: Array, rate_hz: float) -> Model:
    """The model that leaves the lines of a record out of the force balance.

    A line is no force of a state, and a random excitation does not predict it. The lines of the model's own periodic
    forces stay. All lines stay where a force is measured, as that may have them too, and where the model has a periodic
    force of unknown frequency, as a line may be that force.

    y : (n, channels), SI; not read where a survey has found the lines.
    """
    if any(c.kind == "force" for c in model.channels) or has_unknown_line(model):
        return model
    own = known_lines(model)
    found = model.record_lines
    if found is None:
        columns = {c.name: i for i, c in enumerate(model.channels) if c.kind in MOTION_UNITS}
        lines = significant_lines(channel_spectra(y, rate_hz, columns))
        found = tuple(joined_bands(line.band for line in lines_to_leave_out(lines, model.band)))
    bands = tuple(b for b in found if not any(b.holds(hz) for hz in own))
    return replace(model, line_bands=bands)
