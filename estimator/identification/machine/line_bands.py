"""Narrow lines of a record as bands that the force balance leaves out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from estimator.arrays import Array
from estimator.likelihood.motion.harmonics import has_unknown_line, known_lines
from estimator.model.rig import MOTION_UNITS, LineBand, Model

from .spectra import HANN_BIN_CORRELATION, channel_spectra
from .tones import Line, significant_lines

REACH_HALF_WIDTHS = 3.0  # of the resolution that holds most of a line: a wandering line has skirts beyond it


def with_lines_left_out(model: Model, y: Array, rate_hz: float) -> Model:
    """The model that leaves the narrow lines of a record out of the force balance.

    A line is no force of a state, and a random excitation tells nothing about it. The lines of the model's own periodic
    forces stay. All lines stay where a force is measured, as that may have them too, and where the model has a periodic
    force of unknown frequency, as a line may be that force.

    y : (n, channels), SI.
    """
    if any(c.kind == "force" for c in model.channels) or has_unknown_line(model):
        return model
    columns = {c.name: i for i, c in enumerate(model.channels) if c.kind in MOTION_UNITS}
    own = known_lines(model)
    found = line_bands(significant_lines(channel_spectra(y, rate_hz, columns)))
    bands = (b for b in found if not any(b.low_hz <= hz <= b.high_hz for hz in own))
    return replace(model, line_bands=tuple(bands))


def line_bands(lines: Iterable[Line]) -> list[LineBand]:
    """The bands of narrow lines of all channels; overlapping ones are joined. A peak that may be a mode is none."""
    out: list[LineBand] = []
    for line in sorted((line for line in lines if line.narrow), key=lambda line: line.hz):
        reach = REACH_HALF_WIDTHS * line.half_width_hz
        low, high = line.hz - reach, line.hz + reach
        power = line.power_ratio * HANN_BIN_CORRELATION * line.half_width_hz
        if out and low <= out[-1].high_hz:
            last = out.pop()
            low, high, power = last.low_hz, max(high, last.high_hz), max(power, last.power_over_psd_hz)
        out.append(LineBand(low_hz=low, high_hz=high, power_over_psd_hz=power))
    return out
