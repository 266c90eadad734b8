"""Parameters of a model's disturbances, resolved from what was found in the residual force of the other effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.effects import LINE_NAMES, NAMED
from estimator.effects.places import at, written
from estimator.identification.finding import Finding, effect_use
from estimator.identification.structure import spectral_shape
from estimator.likelihood.motion import harmonics
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.effect import EffectParameter
from estimator.model.rig import EffectUse, Model, Setting
from estimator.results import Parameter
from estimator.signals.channel_response import GAIN_AND_DELAY, RESPONSE_EFFECTS, measured_force_places

from .thresholds import LIMITS


def with_further_effects(model: Model, further: Mapping[str, Mapping[str, Mapping[str, Setting]]]) -> Model:
    """The model with effects at further locations. further : effect -> location -> parameter -> Setting."""
    uses = {use.name: use for use in model.effects}
    for name, own in further.items():
        use = uses.get(name, EffectUse(name, {}))
        uses[name] = replace(use, parameters={**use.parameters, **own})
    return replace(model, effects=tuple(uses.values()))


def with_found_effects(model: Model, found: Mapping[str, Mapping[str, Mapping[str, Parameter]]]) -> Model:
    """The model with disturbances at the values found. found : effect -> location -> parameter name -> Parameter."""
    return with_further_effects(model, {name: effect_use(name, own).parameters for name, own in found.items()})


def further_lines_found(model: Model, findings: list[Finding]) -> dict[str, dict[str, dict[str, Setting]]]:
    """Effects for the lines that were found beyond those of the model: effect -> location -> no settings.

    A line of unknown frequency in the model stands for all lines at its location.
    """
    out: dict[str, dict[str, dict[str, Setting]]] = {}
    uses = [(u, at(NAMED[u.name], u, model)) for u in model.effects if u.name in LINE_NAMES]
    for key in dict.fromkeys(key for _, keys in uses for key in keys):
        own = {u.name: written(NAMED[u.name], u, model, key).get("frequency", Setting()) for u, ks in uses if key in ks}
        if all(setting.value is not None for setting in own.values()):
            continue
        free = [name for name in LINE_NAMES if name not in own]
        count = sum(s.effect in LINE_NAMES and key in s.settings for s in findings) - len(own)
        for name in free[: max(count, 0)]:
            out.setdefault(name, {})[key] = {}
    return {name: out[name] for name in LINE_NAMES if name in out}


def is_identifiable_by_force(use: EffectUse, model: Model) -> bool:
    """Whether an effect is a gain or a delay of a sensor that a measured force makes identifiable."""
    return use.name in GAIN_AND_DELAY and _has_force(use, model)


def _has_force(use: EffectUse, model: Model) -> bool:
    """Whether the force is measured at a location of an effect."""
    return not measured_force_places(model).isdisjoint(at(NAMED[use.name], use, model))


def is_corrected_as_given(use: EffectUse, model: Model) -> bool:
    """Whether an effect is a sensor response that is inverted at the values of the rig file, before any fit."""
    if use.name not in RESPONSE_EFFECTS or not _has_force(use, model):
        return use.name in GAIN_AND_DELAY
    names = [q.name for q in NAMED[use.name].parameters]
    return all(own.get(n, Setting()).value is not None for own in use.parameters.values() for n in names)


def with_resolved_parameters(
    model: Model, names: set[str], findings: list[Finding], point: WorkingPoint
) -> tuple[Model, dict[str, Parameter]]:
    """The model with the values found for the effects of these names, and these values as parameters by full name.

    findings : of the model without these effects. point : its working point.
    """
    found: dict[str, Parameter] = {}
    effects = []
    for use in model.effects:
        if use.name in names:
            use, own = _with_resolved_use(use, model, findings, point)
            found |= own
        effects.append(use)
    return replace(model, effects=tuple(effects)), found


def parameters_have_moved(before: Mapping[str, Parameter], now: Mapping[str, Parameter]) -> bool:
    """Whether a parameter that was found both times has changed by more than max_settled_change_sd."""
    pairs = [(before[name], p) for name, p in now.items()]
    if any(p.value is None or q.value is None for p, q in pairs):
        return False
    return any(
        abs((p.value or 0.0) - (q.value or 0.0)) > LIMITS.max_settled_change_sd * (q.sd or 0.0)
        for p, q in pairs
        if q.sd
    )


def _with_resolved_use(
    use: EffectUse, model: Model, findings: list[Finding], point: WorkingPoint
) -> tuple[EffectUse, dict[str, Parameter]]:
    """An effect with the values found for it at each of its locations, and these as parameters by full name."""
    effect = NAMED[use.name]
    found: dict[str, Parameter] = {}
    new: dict[str, dict[str, Setting]] = {}
    for key in at(effect, use, model):
        old = written(effect, use, model, key)
        own = _found_at_location(use, key, model, findings, point)
        new[key] = {}
        for q in effect.parameters:
            setting, name = old.get(q.name, Setting()), f"{key}.{use.name}.{q.name}"
            if setting.fixed and setting.value is not None:
                found[name] = Parameter(setting.value, 0.0, q.unit, reason="given")
            elif q.name in own:
                found[name] = own[q.name]
                setting = replace(setting, value=own[q.name].value)
            else:
                blind = is_corrected_as_given(use, model) and not is_identifiable_by_force(use, model)
                found[name] = _not_found(blind, q)
                setting = setting if blind else replace(setting, value=None)
            new[key][q.name] = setting
    return replace(use, parameters=new), found


def _found_at_location(
    use: EffectUse, key: str, model: Model, findings: list[Finding], point: WorkingPoint
) -> dict[str, Parameter]:
    """Parameters found for an effect at a location, by parameter name."""
    if NAMED[use.name].adds_noise and key in point.data.places:
        return {"rms": spectral_shape.sensor_noise_rms(point, point.data.places.index(key))}
    if NAMED[use.name].kind == "shaft":
        on_disc = [s for s in findings if s.effect in NAMED and NAMED[s.effect].kind == "disc"]
        return _bow_of_imbalance(model, [s.settings[key] for s in on_disc])
    if use.name in LINE_NAMES:
        return _line_at_location(
            use, key, model, [s.settings[key] for s in findings if s.effect in LINE_NAMES and key in s.settings]
        )
    return next((s.settings[key] for s in findings if s.effect == use.name and key in s.settings), {})


def _line_at_location(
    use: EffectUse, key: str, model: Model, lines_found: list[dict[str, Parameter]]
) -> dict[str, Parameter]:
    """The line found nearest to the frequency that the model gives; without one the strongest that no other line has.

    lines_found : at the location, strongest first.
    """
    lines = {
        u.name: written(NAMED[u.name], u, model, key).get("frequency", Setting()).value
        for u in model.effects
        if u.name in LINE_NAMES and key in at(NAMED[u.name], u, model)
    }
    remaining = list(lines_found)
    for name, hz in sorted(lines.items(), key=lambda item: not item[1]):
        if not remaining:
            break
        nearest = remaining.pop(
            min(range(len(remaining)), key=lambda k: abs((remaining[k]["frequency"].value or 0.0) - hz) if hz else k)
        )
        if name == use.name:
            return nearest
    return {}


def _bow_of_imbalance(model: Model, imbalances: list[dict[str, Parameter]]) -> dict[str, Parameter]:
    """The parameters of a bow from the line at shaft speed that was found as an imbalance.

    imbalances : parameters of the imbalances found; the first counts.
    """
    if not imbalances:
        return {}
    rotation = np.array([2 * np.pi * (model.speed_rpm or 0.0) / 60.0])
    through = complex(harmonics.cap_force_per_shaft_force(model, "disc", model.places[0], rotation).sum())
    ratio = through / (through - 0.5)
    a, b = imbalances[0]["a"], imbalances[0]["b"]
    force = ratio * complex(a.value or 0.0, b.value or 0.0)
    sd = abs(ratio) * (a.sd or 0.0)
    return {"a": Parameter(force.real, sd, "N"), "b": Parameter(force.imag, sd, "N")}


def _not_found(blind: bool, q: EffectParameter) -> Parameter:
    """A parameter without a value. blind : because only a measured force identifies it."""
    if blind:
        why = "only a measured force identifies it: calibrate the sensor and give the number, or measure the force"
    else:
        why = harmonics.NOT_IDENTIFIABLE_TEXT
    return Parameter(None, None, q.unit, identifiable=False, reason=why)
