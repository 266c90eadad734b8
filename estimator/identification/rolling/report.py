"""Parameters of a rolling fit with their standard deviations, or the reason why one is not identifiable."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.motion.force_balance import Balance
from estimator.likelihood.path.gram_likelihood import Point
from estimator.model.rig import LINEAR_UNITS, Model
from estimator.results import Parameter, with_unidentifiable_at

NO_SCALE_REASON = "nothing in the model sets the scale of this value: give [rig.mass]"
BLOCK_ENERGY_CORRELATION = (
    0.106  # correlation of the energies of neighbouring blocks (sums of w^2 w'^2 over w^4, gram.taper)
)


def judged_parameters(balance: Balance, point: Point, covariance: Array, model: Model) -> dict[str, Parameter]:
    """Parameters by full name: kL, c, m and S of each place, then those of the effects.

    covariance : (p + 2 P, p + 2 P) of the parameters, log S and the sensor noise.
    """
    sd = np.sqrt(np.diag(covariance))
    free = {
        f.name: (f, (f.start + b if f.searched else b), sd[j])
        for j, (f, b) in enumerate(zip(balance.free, point.beta.tolist(), strict=True))
    }
    out: dict[str, Parameter] = {}
    for i, place in enumerate(balance.places):
        for key in ("kL", "c", "m"):
            name = f"{place}.{key}"
            setting = model.linear.get(place, {}).get(key)
            given = model.cap_mass(place) if key == "m" else None if setting is None else setting.value
            if name in free:
                out[name] = _judged_parameter(free[name][1], free[name][2], LINEAR_UNITS[key])
            elif given is not None:
                out[name] = Parameter(given, 0.0, LINEAR_UNITS[key], reason="given")
        out[f"{place}.S"] = _judged_parameter(point.S[i], point.S[i] * sd[point.beta.size + i], LINEAR_UNITS["S"])
    out |= {name: _judged_parameter(value, s, f.unit) for name, (f, value, s) in free.items() if name not in out}
    adrift = [p for p in balance.places if f"{p}.m" in free and not np.isfinite(free[f"{p}.m"][2])]
    return with_unidentifiable_at(adrift, NO_SCALE_REASON, out, "N")


def _judged_parameter(value: float, sd: float, unit: str) -> Parameter:
    """The parameter, or the reason why it is not identifiable."""
    judged = Parameter.from_estimate(value, sd, unit)
    if judged.identifiable:
        return judged
    if not np.isfinite(sd):
        return Parameter(None, None, unit, identifiable=False, reason=NO_SCALE_REASON)
    return Parameter(
        None,
        None,
        unit,
        identifiable=False,
        reason=f"{value:.3g} +- {sd:.2g}: not distinguishable from zero in this record",
    )
