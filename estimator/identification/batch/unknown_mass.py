"""Bearing cap masses that the rig file leaves out, estimated by the known stiffness of the shaft and mass of the disc.

Without a scale a cap counts as 1 kg. Then all ratios are right if nothing couples the caps, but not on a known shaft.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.errors import DataError
from estimator.likelihood.fitting.fitted_values import fitted_parameters
from estimator.likelihood.fitting.gauss_newton import fit_model, last_step_sd
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.located_law import LocatedLaw, located_laws
from estimator.likelihood.motion.motion_record import MotionRecord, leading_blocks
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.model.rotor import shaft_matrix
from estimator.results import Message, Parameter, is_of_place
from estimator.signals.channel_response import measured_force_places

MASS_START_S = 8.0  # of the record, on which several start masses are tried
MAX_START_STEP_SD = 1.0  # last step of a start, standard deviations: with a larger one the fit has gone astray
START_MASSES_REL = (0.05, 0.15, 0.5, 1.5)  # of the disc: start values of unknown cap masses
NO_MASS_REASON = "the mass is unknown: give [rig.mass]"


def with_masses_of_shaft(model: Model, y: Array, rate_hz: float) -> tuple[Model, dict[str, Parameter]]:
    """The model with the cap masses found by its shaft, and these as parameters by full name. y : (n, channels), SI."""
    left_out = places_scaled_by_shaft(model)
    if not left_out:
        return model, {}
    laws = tuple(u for u in model.effects if effect_of(u).kind == "force" and u.name not in PERIODIC_EFFECTS)
    try:
        data = prepare(replace(model, effects=laws), y, rate_hz, left_out)
        point = _fit_from_several_masses(data, located_laws(replace(model, effects=laws), data), model)
    except DataError:  # the fit that follows says what is wrong
        return model, {}
    fitted = fitted_parameters(point)
    estimated = {f"{p}.m": fitted[f"{p}.m"] for p in left_out}
    found = {p: q.value for p in left_out if (q := estimated[f"{p}.m"]).identifiable and q.value and q.value > 0.0}
    return replace(model, mass={**model.mass, **found}), {f"{p}.m": estimated[f"{p}.m"] for p in found}


def _fit_from_several_masses(data: MotionRecord, laws: list[LocatedLaw], model: Model) -> WorkingPoint:
    """The likeliest fit with free masses; the likelihood has several maxima. Of a part of the record, then of all."""
    part = leading_blocks(data, MASS_START_S)
    points = [
        fit_model(part.with_mass(np.full(part.mass.size, share * model.mass["disc"])), laws)
        for share in START_MASSES_REL
    ]
    sound = [p for p in points if min(*p.kL, *p.c) > 0.0 and last_step_sd(p) < MAX_START_STEP_SD]
    if not sound:
        raise DataError("the shaft does not give the masses that the rig file leaves out: give [rig.mass]")
    best = max(sound, key=lambda point: point.fit.log_likelihood)
    return best if part is data else fit_model(data, list(best.placed), best)


def places_scaled_by_shaft(model: Model) -> list[str]:
    """Places of unknown mass that the shaft gives a scale. A measured force sets the scale of its own place."""
    coupled = model.shaft != "none" and model.shaft_stiffness > 0.0 and "disc" in model.mass
    return places_without_mass(model) if coupled else []


def places_without_mass(model: Model) -> list[str]:
    """Places of unknown mass and without a measured force."""
    return [p for p in model.places if model.cap_mass(p) is None and p not in measured_force_places(model)]


def ratio_messages(model: Model, point: WorkingPoint) -> tuple[Message, ...]:
    """A message for each place of unknown mass, with the resonance and the damping ratio."""
    at = [point.data.places.index(p) for p in places_without_mass(model)]
    return tuple(
        _ratios_only_message(point.data.places[i], point.kL[i], point.c[i], point.data.mass[i])
        for i in at if point.kL[i] > 0.0
    )  # fmt: skip


def _ratios_only_message(place: str, kL: float, c: float, m: float) -> Message:
    """A message with the resonance and the damping ratio of a place of unknown mass. kL, c, m : at any scale."""
    hz, zeta = np.sqrt(kL / m) / (2 * np.pi), c / (2 * np.sqrt(kL * m))
    text = (
        f"{place}: the mass is unknown, so the record gives only ratios: resonance {hz:.1f} Hz, damping "
        f"{100 * zeta:.2f} % of critical; give [rig.mass] to get stiffness in N/m"
    )
    return Message("mass_unknown", text, place)


def with_mass_uncertainty(
    model: Model, found: Mapping[str, Parameter], masses: Mapping[str, Parameter]
) -> dict[str, Parameter]:
    """Parameters by full name with standard deviations that include those of the masses.

    A fit at given masses gives forces in proportion to the mass of the cap, and S to its square; kL and c in proportion
    together with the part of the shaft.
    """
    out = dict(found)
    for name, p in found.items():
        own = [q for mass, q in masses.items() if is_of_place(name, mass.removesuffix(".m"))]
        power = 2 if p.unit.startswith("N^2") else int(p.unit.startswith(("N", "kg")))
        if not (own and power and p.identifiable and p.value is not None and p.sd is not None):
            continue
        value = p.value + _shaft_part(model, name)
        share = max((q.sd or 0.0) / (q.value or np.inf) for q in own)
        out[name] = replace(p, sd=float(np.hypot(p.sd, power * share * value)))
    return out


def _shaft_part(model: Model, name: str) -> float:
    """Stiffness (N/m) or damping (N s/m) that the shaft adds to kL or c of a cap above the resonance of the disc."""
    added = {"kL": model.shaft_stiffness, "c": model.shaft_damping}
    return float(shaft_matrix(model.shaft, added.get(name.rsplit(".", 1)[1], 0.0))[0, 0])


def mass_messages(masses: dict[str, Parameter]) -> tuple[Message, ...]:
    """A message that names the masses found. masses : by full name."""
    if not masses:
        return ()
    values = ", ".join(f"{name.removesuffix('.m')} {q.value:.4g} kg" for name, q in masses.items())
    text = f"masses missing in the rig file were estimated by the shaft stiffness: {values}; the fit rests on them"
    return (Message("mass_by_shaft", text),)
