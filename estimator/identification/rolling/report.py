"""Parameters of a rolling fit with their standard deviations, or the reason why one is not identifiable."""

from __future__ import annotations

import numpy as np

from estimator.identification.batch.unknown_mass import NO_MASS_REASON, places_without_mass, with_mass_uncertainty
from estimator.model.rig import LINEAR_UNITS
from estimator.results import Parameter, with_unidentifiable_at

from .follower import Follower
from .start import FirstFit


def judged_parameters(follower: Follower, first: FirstFit) -> dict[str, Parameter]:
    """Parameters by full name: kL, c, m and S of each place, then those of the effects."""
    anchor, values, model = follower.anchor, follower.values(), first.model
    own = anchor.names[: anchor.own]
    sd = dict(zip(own, np.sqrt(np.diag(follower.covariance())) * anchor.scales[: anchor.own], strict=True))
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
    out = with_mass_uncertainty(model, {**out, **first.held}, first.masses)
    return {**with_unidentifiable_at(places_without_mass(model), NO_MASS_REASON, out, "N"), **first.masses}


def _judged_parameter(value: float, sd: float, unit: str) -> Parameter:
    """The parameter, or the reason why it is not identifiable."""
    judged = Parameter.from_estimate(value, sd, unit)
    if judged.identifiable:
        return judged
    reason = f"{value:.3g} +- {sd:.2g}: not distinguishable from zero in this record"
    return Parameter(None, None, unit, identifiable=False, reason=reason)
