"""A model fitted to the Gram matrices of a record: values, covariance, residual force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.motion.force_balance import Balance
from estimator.likelihood.motion.stream_record import Bank, Record
from estimator.likelihood.path.gram_likelihood import Local, Point
from estimator.model.rig import LINEAR_UNITS, Model
from estimator.results import Message, Parameter, with_unidentifiable_at

from .linear_start import LinearStart
from .maximum import inverse, maximum

NO_SCALE_REASON = "nothing in the model sets the scale of this value: give [rig.mass]"
BLOCK_ENERGY_CORRELATION = (
    0.106  # correlation of the energies of neighbouring blocks (sums of w^2 w'^2 over w^4, gram.taper)
)


@dataclass(frozen=True, slots=True)
class SpectralFit:
    """A model fitted to the Gram matrices of a record.

    record : the band-limited record. start : the linear fit that it started from.
    balance : the force balance with p free parameters at P places. bank : its Gram matrices by fold of time.
    local : the likelihood at the maximum.
    covariance : (p + 2 P, p + 2 P) of the parameters, log S and the sensor noise; inf where the data leave one free.
    converged : whether the maximum was reached.
    """

    record: Record
    start: LinearStart
    balance: Balance
    bank: Bank
    local: Local
    covariance: Array
    converged: bool

    @property
    def point(self) -> Point:
        """Parameters, S and sensor noise at the maximum."""
        return self.local.point

    @property
    def values(self) -> dict[str, float]:
        """Free parameters by full name, SI."""
        return {
            f.name: (f.start + b if f.searched else b)
            for f, b in zip(self.balance.free, self.local.point.beta.tolist(), strict=True)
        }


def fit_from_start(
    record: Record, start: LinearStart, model: Model, values: Mapping[str, float] | None = None
) -> SpectralFit:
    """A model fitted to a record from a linear start. values : start values by full name; they override the model's."""
    best = maximum(record, start, model, values)
    covariance = inverse(best.local)
    return SpectralFit(
        record=record,
        start=start,
        balance=best.balance,
        bank=best.bank,
        local=best.local,
        covariance=covariance,
        converged=best.converged,
    )


def fitted_parameters(gram_fit: SpectralFit) -> dict[str, Parameter]:
    """Every parameter by full name with its standard deviation, or the reason why it is not identifiable."""
    return judged_parameters(gram_fit.balance, gram_fit.point, gram_fit.covariance, gram_fit.record.model)


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


def ratios_only_message(place: str, kL: float, c: float, m: float) -> Message:
    """A message with the resonance and the damping ratio of a place of unknown mass. kL, c, m : at any scale."""
    hz, zeta = np.sqrt(kL / m) / (2 * np.pi), c / (2 * np.sqrt(kL * m))
    text = (
        f"{place}: the mass is unknown, so the record gives only ratios: resonance {hz:.1f} Hz, damping "
        f"{100 * zeta:.2f} % of critical; give [rig.mass] to get stiffness in N/m"
    )
    return Message("mass_unknown", text, place)
