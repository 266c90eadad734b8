"""Bearing cap masses that the rig file leaves out, estimated by the known stiffness of the shaft and mass of the disc.

Without a scale a cap counts as 1 kg. Then all ratios are right if nothing couples the caps, but not on a known shaft.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.errors import DataError, NotFiniteError
from estimator.likelihood.fitting.fitted_values import fitted_parameters
from estimator.likelihood.fitting.gauss_newton import fit_model, last_step_sd
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.located_law import located_laws
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.model.rotor import shaft_matrix
from estimator.results import Message, Parameter, is_of_place
from estimator.signals.channel_response import measured_force_places

from .grid_start import fit_record
from .shaft_scale import shaft_scale
from .thresholds import LIMITS

NO_MASS_REASON = "the mass is unknown: give [rig.mass]"


def with_masses_of_shaft(model: Model, y: Array, rate_hz: float) -> tuple[Model, dict[str, Parameter]]:
    """The model with the cap masses found by its shaft, and these as parameters by full name. y : (n, channels), SI.

    A mass that the shaft does not give is not identifiable among the parameters; the model has the likeliest one.
    """
    left_out = places_scaled_by_shaft(model)
    if not left_out:
        return model, {}
    apart = replace(model, shaft="none", effects=(), background=None)
    try:
        scale = shaft_scale(model, fit_record(apart, prepare(apart, y, rate_hz)), left_out)
    except (DataError, NotFiniteError, np.linalg.LinAlgError):  # the fit that follows says what is wrong
        return model, {}
    if scale is None:
        return model, {}
    start = {p: float(np.exp(ln_mass)) for p, (ln_mass, _) in scale.ln_mass.items()}
    found = {f"{p}.m": Parameter.from_estimate(start[p], sd * start[p], "kg") for p, (_, sd) in scale.ln_mass.items()}
    model = replace(model, background=scale.background)
    if scale.background is None and all(q.identifiable for q in found.values()):
        found = _refined_masses(model, y, rate_hz, start, found)
    known = {p: found[f"{p}.m"].value or m for p, m in start.items()}
    return replace(model, mass={**model.mass, **known}), found


def _refined_masses(
    model: Model, y: Array, rate_hz: float, start: Mapping[str, float], found: Mapping[str, Parameter]
) -> dict[str, Parameter]:
    """The masses fitted together with the laws of the model; those of the spectra where that fit departs from them.

    The fit holds a background: with one, the spectra alone give the uncertainty of a mass.
    """
    laws = tuple(u for u in model.effects if effect_of(u).kind == "force" and u.name not in PERIODIC_EFFECTS)
    bare = replace(model, effects=laws)
    try:
        data = prepare(bare, y, rate_hz, start.keys())
        data = data.with_mass(np.array([start.get(p, m) for p, m in zip(data.places, data.mass, strict=True)]))
        point = fit_model(data, located_laws(bare, data))
    except (DataError, NotFiniteError, np.linalg.LinAlgError):
        return dict(found)
    fitted = fitted_parameters(point)
    if min(*point.kL, *point.c) <= 0.0 or last_step_sd(point) > LIMITS.max_astray_step_sd:
        return dict(found)
    return {name: _agreed(q, fitted[name]) for name, q in found.items()}


def _agreed(spectral: Parameter, fitted: Parameter) -> Parameter:
    """The mass of a fit if it agrees with that of the spectra, else that of the spectra."""
    if fitted.value is None or spectral.value is None or fitted.sd is None or spectral.sd is None:
        return spectral
    agrees = abs(fitted.value - spectral.value) < LIMITS.max_departure_sd * np.hypot(fitted.sd, spectral.sd)
    return fitted if agrees else spectral


def places_scaled_by_shaft(model: Model) -> list[str]:
    """Places of unknown mass that the shaft gives a scale. A measured force sets the scale of its own place."""
    coupled = model.shaft != "none" and model.shaft_stiffness > 0.0 and "disc" in model.mass
    return places_without_mass(model) if coupled else []


def places_without_mass(model: Model) -> list[str]:
    """Places of unknown mass and without a measured force."""
    return [p for p in model.places if model.cap_mass(p) is None and p not in measured_force_places(model)]


def unscaled_places(model: Model, masses: Mapping[str, Parameter]) -> list[str]:
    """Places of unknown mass, those that the shaft does not give included. masses : of the shaft, by full name."""
    return [*places_without_mass(model), *(n.removesuffix(".m") for n, q in masses.items() if not q.identifiable)]


def ratio_messages(model: Model, point: WorkingPoint, masses: Mapping[str, Parameter]) -> tuple[Message, ...]:
    """A message for each place of unknown mass, with all that its mass does not scale."""
    found = fitted_parameters(point)
    at = {p: point.data.mass[point.data.places.index(p)] for p in unscaled_places(model, masses)}
    with_stiffness = [p for p in at if (found[f"{p}.kL"].value or 0.0) > 0.0]
    return tuple(_ratios_only_message(place, at[place], found) for place in with_stiffness)


def _ratios_only_message(place: str, mass: float, found: Mapping[str, Parameter]) -> Message:
    """A message with resonance, damping ratio and the strength of laws over kL at a place of unknown mass.

    mass : kg, at any scale, of the fit. found : parameters of that fit by full name.
    """
    at_place = {name.removeprefix(f"{place}."): q for name, q in found.items() if name.startswith(f"{place}.")}
    kL = at_place["kL"]
    hz = np.sqrt((kL.value or 0.0) / mass) / (2 * np.pi)
    said = [f"resonance {_with_sd(hz, 0.5 * _sd_rel(kL))} Hz", "damping not told from zero"]
    c = at_place["c"]
    if c.identifiable and c.value is not None and c.value > 0.0:
        zeta = 100 * c.value / (4 * np.pi * hz * mass)
        said[1] = f"damping {_with_sd(zeta, _sd_rel(c))} % of critical"
    for name, q in at_place.items():
        if "." in name and q.identifiable and q.value and kL.value and q.unit.startswith("N"):
            sd_rel = float(np.hypot(_sd_rel(q), _sd_rel(kL)))
            said.append(f"{name}/kL {_with_sd(q.value / kL.value, sd_rel)} ({q.unit})/(N/m)")
    text = f"{place}: the mass is unknown, so the record gives only ratios: {', '.join(said)}"
    return Message("mass_unknown", f"{text}; give [rig.mass] to get stiffness in N/m", place)


def _with_sd(value: float, sd_rel: float) -> str:
    return f"{value:.4g} +- {abs(value) * sd_rel:.2g}"


def _sd_rel(q: Parameter) -> float:
    """Relative standard deviation."""
    return (q.sd or 0.0) / abs(q.value or np.inf)


def with_mass_uncertainty(
    model: Model, found: Mapping[str, Parameter], masses: Mapping[str, Parameter]
) -> dict[str, Parameter]:
    """Parameters by full name with standard deviations that include those of the masses.

    A fit at given masses gives forces in proportion to the mass of the cap, and S to its square; kL and c in proportion
    together with the part of the shaft.
    """
    out = dict(found)
    for name, p in found.items():
        own = [q for mass, q in masses.items() if q.identifiable and is_of_place(name, mass.removesuffix(".m"))]
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
    known = {name: q.value for name, q in masses.items() if q.identifiable and q.value is not None}
    if not known:
        return ()
    values = ", ".join(f"{name.removesuffix('.m')} {m:.4g} kg" for name, m in known.items())
    text = f"masses missing in the rig file were estimated by the shaft stiffness: {values}; the fit rests on them"
    return (Message("mass_by_shaft", text),)
