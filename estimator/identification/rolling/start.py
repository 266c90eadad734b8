"""The start of a rolling fit: the first seconds fitted as a record.

Parameters of a rolling fit with their standard deviations, or the reason why one is not identifiable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.identification.batch.full_fit import refuse_without_resonance, stiffness_and_damping_held
from estimator.identification.batch.grid_start import fit_record
from estimator.identification.batch.unknown_mass import (
    NO_MASS_REASON,
    unscaled_places,
    with_mass_uncertainty,
    with_masses_of_shaft,
)
from estimator.identification.machine.line_bands import with_lines_left_out
from estimator.likelihood.motion.harmonics import known_lines
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.motion.prepare import check_record, motion_record
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import LINEAR_UNITS, LineBand, Model
from estimator.results import Parameter, is_of_place, with_unidentifiable_at
from estimator.signals.channel_response import corrected_record
from estimator.signals.shaft_angle import with_measured_speed

from .follower import Follower
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
    new = [hz for hz in known if not any(b.low_hz <= hz <= b.high_hz for b in model.line_bands)]
    bands = (*model.line_bands, *(LineBand(low_hz=hz, high_hz=hz, power_over_psd_hz=0.0) for hz in new))
    return replace(model, line_bands=tuple(sorted(bands, key=lambda b: b.low_hz)))


def _check(point: WorkingPoint) -> None:
    """Raise DataError where a place does not resonate in the band, or the record is too short for its resonance."""
    data = point.data
    k, c = stiffness_and_damping_held(point)
    for i, place in enumerate(data.places):
        m, damping = float(data.mass[i]), float(c[i])
        if not data.measured_force:
            refuse_without_resonance(place, m, max(damping, 0.0), float(k[i]), data.band)
        needed_s = LIMITS.min_correlation_times * 2 * m / damping if damping > 0.0 else 0.0
        if data.seconds < needed_s:
            raise DataError(
                f"the record ({data.seconds:.2f} s valid) is shorter than ten correlation times of {place} "
                f"({2 * m / damping:.2g} s each): record at least {needed_s:.1f} s"
            )


LOST_LAW = "its force is not distinguishable from zero in this record"


def judged_parameters(follower: Follower, first: FirstFit) -> dict[str, Parameter]:
    """Parameters by full name: kL, c, m and S of each place, then those of the effects."""
    anchor, values, model = follower.anchor, follower.values(), first.model
    own = anchor.names[: anchor.own]
    sd = dict(zip(own, np.sqrt(np.diag(follower.covariance())) * anchor.scales[: anchor.own], strict=True))
    for place, around in ({} if model.background is None else model.background.at).items():
        for name, more in ((f"{place}.kL", around.stiffness_sd_rel), (f"{place}.c", around.damping_sd_rel)):
            sd |= {name: float(np.hypot(sd[name], more * values[name]))} if name in sd else {}
    units = dict(zip(own, anchor.units, strict=False))
    (level, level_sd), S = follower.level(), follower.excitation()
    out: dict[str, Parameter] = {}
    for i, place in enumerate(anchor.data.places):
        for key in ("kL", "c", "m"):
            name = f"{place}.{key}"
            if name in sd:
                out[name] = _judged_parameter(values[name], sd[name], units[name])
            elif key != "m" or model.cap_mass(place) is not None:
                out[name] = Parameter(values[name], 0.0, LINEAR_UNITS[key], reason="given")
        out[f"{place}.S"] = _judged_parameter(S[i] * level[i], S[i] * level_sd[i], LINEAR_UNITS["S"])
    out |= {name: _judged_parameter(values[name], sd[name], units[name]) for name in own if name not in out}
    out = with_mass_uncertainty(model, _without_lost_laws(follower, out), first.masses)
    out = {**with_unidentifiable_at(unscaled_places(model, first.masses), NO_MASS_REASON, out, "N"), **first.masses}
    for place, (power, hz) in zip(anchor.data.places, follower.excess_power(), strict=True):
        out = _with_colour(out, place, power, hz)
    return out


def is_coloured(follower: Follower) -> bool:
    """Whether the spectrum of the residual force at a place is not that of the model."""
    return any(abs(own) >= LIMITS.min_colour_rel for own, _ in follower.excess_power())


def _with_colour(found: dict[str, Parameter], place: str, excess: float, hz: float) -> dict[str, Parameter]:
    """The parameters where the spectrum of the residual force at a place is not that of the model: with the reason, or
    without a number. excess : its power near `hz` over that of the model, less 1."""
    if abs(excess) < LIMITS.min_colour_rel:
        return found
    reason = f"the residual force is not white, {100 * excess:+.0f} % near {hz:.0f} Hz: rotorscope diagnose says why"
    if not 1.0 / LIMITS.max_colour_ratio < 1.0 + excess < LIMITS.max_colour_ratio:
        given = {name: p for name, p in found.items() if p.sd == 0.0}
        return with_unidentifiable_at([place], reason, found) | given
    fitted = {name: p for name, p in found.items() if p.identifiable and p.sd and is_of_place(name, place)}
    return found | {name: replace(p, reason=reason) for name, p in fitted.items()}


def _without_lost_laws(follower: Follower, found: dict[str, Parameter]) -> dict[str, Parameter]:
    """The parameters, without those of laws none of whose fitted amplitudes is told from zero."""
    out = dict(found)
    for use in follower.anchor.placed:
        names = {use.name(k): q for k, q in enumerate(use.effect.parameters) if use.name(k) in found}
        amplitudes = [found[name] for name, q in names.items() if q.linear]
        if amplitudes and not any(p.identifiable for p in amplitudes):
            lost = {name: q.unit for name, q in names.items() if not q.linear}
            out |= {n: Parameter(None, None, unit, identifiable=False, reason=LOST_LAW) for n, unit in lost.items()}
    return out


def _judged_parameter(value: float, sd: float, unit: str) -> Parameter:
    """The parameter, or the reason why it is not identifiable."""
    judged = Parameter.from_estimate(value, sd, unit)
    reason = f"{value:.3g} +- {sd:.2g}: not distinguishable from zero in this record"
    return judged if judged.identifiable else replace(judged, reason=reason)
