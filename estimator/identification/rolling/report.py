"""Parameters of a rolling fit with their standard deviations, or the reason why one is not identifiable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.identification.batch.unknown_mass import (
    NO_MASS_REASON,
    unscaled_places,
    with_mass_uncertainty,
)
from estimator.model.rig import LINEAR_UNITS
from estimator.results import Parameter, is_of_place, with_unidentifiable_at

from .follower import Follower
from .start import FirstFit
from .thresholds import LIMITS

LOST_LAW = "its force is not distinguishable from zero in this record"


def judged_parameters(follower: Follower, first: FirstFit) -> dict[str, Parameter]:
    """Parameters by full name: kL, c, m and S of each place, then those of the effects."""
    anchor, values, model = follower.anchor, follower.values(), first.model
    fitted = anchor.names[: anchor.own]
    sd = dict(zip(fitted, np.sqrt(np.diag(follower.covariance())) * anchor.scales[: anchor.own], strict=True))
    for place, around in ({} if model.background is None else model.background.at).items():
        for name, more in ((f"{place}.kL", around.stiffness_sd_rel), (f"{place}.c", around.damping_sd_rel)):
            sd |= {name: float(np.hypot(sd[name], more * values[name]))} if name in sd else {}
    units = dict(zip(fitted, anchor.units, strict=False))
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
    out |= {name: _judged_parameter(values[name], sd[name], units[name]) for name in fitted if name not in out}
    out = with_mass_uncertainty(model, _without_lost_laws(follower, out), first.masses)
    out = {**with_unidentifiable_at(unscaled_places(model, first.masses), NO_MASS_REASON, out, "N"), **first.masses}
    for place, (power, hz) in zip(anchor.data.places, follower.excess_power(), strict=True):
        out = _with_colour(out, place, power, hz)
    return out


def is_coloured(follower: Follower) -> bool:
    """Whether the spectrum of the residual force at a place is not that of the model."""
    return any(abs(own) >= LIMITS.min_colour_rel for own, _ in follower.excess_power())


def _with_colour(found: dict[str, Parameter], place: str, excess: float, hz: float) -> dict[str, Parameter]:
    """The parameters, those of a place whose spectrum departs from the model with the reason, or without a
    number. excess : power of the residual force near `hz` over that of the model, less 1."""
    if abs(excess) < LIMITS.min_colour_rel:
        return found
    reason = f"the residual force is not white, {100 * excess:+.0f} % near {hz:.0f} Hz: rotorscope diagnose says why"
    if not 1.0 / LIMITS.max_colour_ratio < 1.0 + excess < LIMITS.max_colour_ratio:
        given = {name: p for name, p in found.items() if p.sd == 0.0}
        return with_unidentifiable_at([place], reason, found) | given
    fitted = {name: p for name, p in found.items() if p.identifiable and p.sd and is_of_place(name, place)}
    return found | {name: replace(p, reason=reason) for name, p in fitted.items()}


def _without_lost_laws(follower: Follower, found: dict[str, Parameter]) -> dict[str, Parameter]:
    """The parameters, without those of laws none of whose fitted amplitudes is identifiable."""
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
