"""Numbers for a model's effects that are no laws of the states: what was found for each in what the rest leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.effects import NAMED
from estimator.effects.places import at, written
from estimator.identification.finding import Finding, effect_use
from estimator.identification.structure import noisy_sensor
from estimator.likelihood.motion import harmonics
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.effect import EffectParameter
from estimator.model.rig import EffectUse, Model, Setting
from estimator.results import Parameter
from estimator.signals.channel_response import GAIN_AND_DELAY, RESPONSE_EFFECTS, measured_force_places

MAX_SETTLED_CHANGE_SD = 0.5  # standard deviations by which a colour may still move


def with_further_effects(model: Model, further: Mapping[str, Mapping[str, Mapping[str, Setting]]]) -> Model:
    """The model with effects at further places. further : name -> canonical place -> parameter name -> Setting."""
    uses = {use.name: use for use in model.effects}
    for name, own in further.items():
        use = uses.get(name, EffectUse(name, {}))
        uses[name] = replace(use, parameters={**use.parameters, **own})
    return replace(model, effects=tuple(uses.values()))


def with_found_effects(model: Model, found: Mapping[str, Mapping[str, Mapping[str, Parameter]]]) -> Model:
    """The model with effects that are no force laws, at the values found. found : by the name of the effect."""
    return with_further_effects(model, {name: effect_use(name, own).parameters for name, own in found.items()})


def further_lines_found(model: Model, seen: list[Finding]) -> dict[str, dict[str, dict[str, Setting]]]:
    """Name -> place -> no numbers, of lines seen that the model has no name for: at a place where it has one without a
    frequency, which is as many lines as there are."""
    out: dict[str, dict[str, dict[str, Setting]]] = {}
    uses = [(u, at(NAMED[u.name], u, model)) for u in model.effects if u.name in harmonics.LINE_NAMES]
    for key in dict.fromkeys(key for _, keys in uses for key in keys):
        own = {u.name: written(NAMED[u.name], u, model, key).get("frequency", Setting()) for u, ks in uses if key in ks}
        if all(setting.value is not None for setting in own.values()):
            continue
        free = [name for name in harmonics.LINE_NAMES if name not in own]
        count = sum(s.effect == "line" and key in s.settings for s in seen) - len(own)
        for name in free[: max(count, 0)]:
            out.setdefault(name, {})[key] = {}
    return {name: out[name] for name in harmonics.LINE_NAMES if name in out}


def is_identifiable_by_force(use: EffectUse, model: Model) -> bool:
    """Whether it is a sensor's response beside a measured force, which tells it."""
    return use.name in RESPONSE_EFFECTS and bool(
        measured_force_places(model).intersection(at(NAMED[use.name], use, model))
    )


def is_undone_as_given(use: EffectUse, model: Model) -> bool:
    """Whether it is a sensor's response that is undone before anything is known of it: as the rig file gives it."""
    if not is_identifiable_by_force(use, model):
        return use.name in GAIN_AND_DELAY
    names = [q.name for q in NAMED[use.name].parameters]
    return all(own.get(n, Setting()).value is not None for own in use.parameters.values() for n in names)


def with_resolved_parameters(
    model: Model, names: set[str], seen: list[Finding], point: WorkingPoint
) -> tuple[Model, dict[str, Parameter]]:
    """The model with what was found for the effects of these names, and that as parameters."""
    found: dict[str, Parameter] = {}
    effects = []
    for use in model.effects:
        if use.name in names:
            use, own = _with_resolved_use(use, model, seen, point)
            found |= own
        effects.append(use)
    return replace(model, effects=tuple(effects)), found


def parameters_have_moved(before: Mapping[str, Parameter], now: Mapping[str, Parameter]) -> bool:
    """Whether numbers that were found both times differ by more than a part of a standard deviation."""
    pairs = [(before[name], p) for name, p in now.items()]
    if any(p.value is None or q.value is None for p, q in pairs):
        return False
    return any(
        abs((p.value or 0.0) - (q.value or 0.0)) > MAX_SETTLED_CHANGE_SD * (q.sd or 0.0) for p, q in pairs if q.sd
    )


def _with_resolved_use(
    use: EffectUse, model: Model, seen: list[Finding], point: WorkingPoint
) -> tuple[EffectUse, dict[str, Parameter]]:
    """The use with what was found for it at each of its places, and that as parameters."""
    effect = NAMED[use.name]
    found: dict[str, Parameter] = {}
    new: dict[str, dict[str, Setting]] = {}
    for key in at(effect, use, model):
        old = written(effect, use, model, key)
        own = _found_at_location(use, key, old, model, seen, point)
        new[key] = {}
        for q in effect.parameters:
            setting, name = old.get(q.name, Setting()), f"{key}.{use.name}.{q.name}"
            if setting.fixed and setting.value is not None:
                found[name] = Parameter(setting.value, 0.0, q.unit, True, "given")
            elif q.name in own:
                found[name] = own[q.name]
                setting = replace(setting, value=own[q.name].value)
            else:
                blind = use.name in GAIN_AND_DELAY and not is_identifiable_by_force(use, model)
                found[name] = _not_found(blind, q)
                setting = setting if blind else replace(setting, value=None)
            new[key][q.name] = setting
    return replace(use, parameters=new), found


def _found_at_location(
    use: EffectUse, key: str, old: Mapping[str, Setting], model: Model, seen: list[Finding], point: WorkingPoint
) -> dict[str, Parameter]:
    """Name -> number of a use at a canonical place; of several lines the one nearest to the frequency written."""
    if use.name == "sensor_noise" and key in point.data.places:
        return {"rms": noisy_sensor.sensor_noise_rms(point, point.data.places.index(key))}
    if use.name == "bow":
        return _bow_of_imbalance(model, [s.settings[key] for s in seen if s.effect == "imbalance"])
    if use.name in harmonics.LINE_NAMES:
        return _line_at_location(
            use, key, model, [s.settings[key] for s in seen if s.effect == "line" and key in s.settings]
        )
    return next((s.settings[key] for s in seen if s.effect == use.name and key in s.settings), {})


def _line_at_location(use: EffectUse, key: str, model: Model, seen: list[dict[str, Parameter]]) -> dict[str, Parameter]:
    """Of the lines seen at a place the one nearest to the frequency written; without one the strongest that no other
    line of the model has."""
    lines = {
        u.name: written(NAMED[u.name], u, model, key).get("frequency", Setting()).value
        for u in model.effects
        if u.name in harmonics.LINE_NAMES and key in at(NAMED[u.name], u, model)
    }
    left = list(seen)
    for name, hz in sorted(lines.items(), key=lambda one: not one[1]):
        if not left:
            break
        own = left.pop(min(range(len(left)), key=lambda k: abs((left[k]["frequency"].value or 0.0) - hz) if hz else k))
        if name == use.name:
            return own
    return {}


def _bow_of_imbalance(model: Model, seen: list[dict[str, Parameter]]) -> dict[str, Parameter]:
    """The line at the shaft's speed as the work of a bow, where it was found as that of an imbalance."""
    if not seen:
        return {}
    rotation = np.array([2 * np.pi * (model.speed_rpm or 0.0) / 60.0])
    through = complex(harmonics.cap_force_per_shaft_force(model, "bearing1.x", rotation)[0])
    ratio = through / (through - 0.5)
    a, b = seen[0]["a"], seen[0]["b"]
    force = ratio * complex(a.value or 0.0, b.value or 0.0)
    sd = abs(ratio) * (a.sd or 0.0)
    return {"a": Parameter(force.real, sd, "N"), "b": Parameter(force.imag, sd, "N")}


def _not_found(blind: bool, q: EffectParameter) -> Parameter:
    if blind:
        why = "the bearings are too weakly coupled to identify it: measure the force, or give it with fixed = true"
    else:
        why = harmonics.NOT_IDENTIFIABLE_TEXT
    return Parameter(None, None, q.unit, False, why)
