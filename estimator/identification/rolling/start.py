"""The start of a rolling fit: the first seconds fitted as a record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.identification.batch.full_fit import refuse_without_resonance, stiffness_and_damping_held
from estimator.identification.batch.grid_start import fit_record
from estimator.identification.batch.unknown_mass import (
    with_masses_of_shaft,
)
from estimator.identification.machine.line_bands import with_lines_left_out
from estimator.likelihood.motion.harmonics import known_lines
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.motion.prepare import check_record, motion_record
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import LineBand, Model
from estimator.results import Parameter
from estimator.signals.channel_response import corrected_record
from estimator.signals.shaft_angle import with_measured_speed

from .thresholds import LIMITS


@dataclass(frozen=True, slots=True)
class FirstFit:
    """The fit of the first seconds. masses : those that the shaft sets, by full name."""

    model: Model
    point: WorkingPoint
    masses: Mapping[str, Parameter]


def first_fit(model: Model, lines: Model, y: Array, rate_hz: float, block: int) -> FirstFit:
    """The fit of the first rows y (n, channels), SI, in blocks of `block` rows.

    model : the rig without its periodic forces. lines : with them. Raises DataError.
    """
    model, masses, data = first_record(model, lines, y, rate_hz, block)
    point = fit_record(model, data)
    _check(point)
    return FirstFit(model, point, masses)


def first_record(
    model: Model, lines: Model, y: Array, rate_hz: float, block: int
) -> tuple[Model, Mapping[str, Parameter], MotionRecord]:
    """The model with the lines and the speed of some rows, the masses that the shaft sets, and the motion record.

    Arguments as of `first_fit`. Raises DataError.
    """
    y = check_record(model, y, rate_hz)
    model = with_lines_left_out(with_measured_speed(model, y, rate_hz), y, rate_hz)
    model = _with_known_lines(model, lines, rate_hz / block)
    model, masses = with_masses_of_shaft(model, y, rate_hz)
    return model, masses, motion_record(model, corrected_record(model, y, rate_hz), rate_hz, block)


def _with_known_lines(model: Model, lines: Model, bin_hz: float) -> Model:
    """The model that leaves out the known lines of its periodic forces too, strong or weak.

    None are added with a tacho, as they move with the speed, nor where they would take half of the band.
    """
    low, high = model.band
    known = [
        hz
        for hz in known_lines(lines)
        if low - LIMITS.line_width_bins * bin_hz < hz < high + LIMITS.line_width_bins * bin_hz
    ]
    if model.tacho is not None or LIMITS.line_width_bins * bin_hz * len(known) > LIMITS.max_known_lines_share * (
        high - low
    ):
        return model
    new = [hz for hz in known if not any(b.holds(hz) for b in model.line_bands)]
    bands = (*model.line_bands, *(LineBand(low_hz=hz, high_hz=hz, power_over_psd_hz=0.0) for hz in new))
    return replace(model, line_bands=tuple(sorted(bands, key=lambda b: b.low_hz)))


def _check(point: WorkingPoint) -> None:
    """Raise DataError where a place does not resonate in the band, or the record is too short for its resonance."""
    refuse_without_resonance(point)
    data, (_, c) = point.data, stiffness_and_damping_held(point)
    for place, m, damping in zip(data.places, data.mass.tolist(), c.tolist(), strict=True):
        needed_s = LIMITS.min_correlation_times * 2 * m / damping if damping > 0.0 else 0.0
        if data.seconds < needed_s:
            raise DataError(
                f"the record ({data.seconds:.2f} s valid) is shorter than ten correlation times of {place} "
                f"({2 * m / damping:.2g} s each): record at least {needed_s:.1f} s"
            )
