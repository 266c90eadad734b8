"""Narrow lines of a record as bands that the force balance leaves out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from estimator.arrays import Array
from estimator.likelihood.motion.harmonics import has_unknown_line, known_lines
from estimator.model.rig import MOTION_UNITS, Model

from .machine_survey import ShaftSpeed
from .spectra import LevelSpectrum, channel_spectra, order_spectra
from .speed import tacho_angle, tacho_speed
from .tones import Line, joined_bands, lines_to_leave_out, shaft_order, significant_lines


def with_lines_left_out(model: Model, y: Array, rate_hz: float) -> Model:
    """The model that leaves the lines of a record out of the force balance.

    A line is no force of a state, and a random excitation does not predict it. The lines of the model's own periodic
    forces stay, but for orders of a speed that changes: their amplitudes change too. All lines stay where a force is
    measured, as that may have them too, and where the model has a periodic force of unknown frequency, as a line may be
    that force.

    y : (n, channels), SI; not read where a survey has found the lines.
    """
    if any(c.kind == "force" for c in model.channels) or has_unknown_line(model):
        return model
    own = known_lines(model)
    found = model.record_lines
    if found is None:
        columns = {c.name: i for i, c in enumerate(model.channels) if c.kind in MOTION_UNITS}
        spectra, speed = channel_spectra(y, rate_hz, columns), tacho_speed(model, y, rate_hz)
        lines = record_lines(model, y, rate_hz, spectra, speed)
        found = tuple(joined_bands(line.band for line in lines_to_leave_out(lines, model.band)))
    bands = tuple(b for b in found if b.swept or not any(b.holds(hz) for hz in own))
    return replace(model, line_bands=bands)


def record_lines(
    model: Model, y: Array, rate_hz: float, spectra: Mapping[str, Sequence[LevelSpectrum]], speed: ShaftSpeed | None
) -> list[Line]:  # fmt: skip
    """Significant lines of a record, clearest first, with the orders of a shaft whose changing speed a tacho follows.

    spectra : channel -> its spectra.
    """
    lines = significant_lines(spectra)
    angle = tacho_angle(model, y, rate_hz) if speed is not None and speed.is_swept else None
    if angle is None or speed is None:
        return lines
    columns = {c.name: i for i, c in enumerate(model.channels) if c.name in spectra}
    found = significant_lines(order_spectra(y, rate_hz, columns, angle))
    orders = [
        replace(line, range_rel=speed.range_rel) for line in found if line.narrow and shaft_order(line, speed)
    ]  # fmt: skip
    swept = {name: [order.band for order in orders if order.channel == name] for name in columns}
    still = [line for line in lines if not any(band.holds(line.hz) for band in swept[line.channel])]
    return sorted([*orders, *still], key=lambda line: line.log_p)
