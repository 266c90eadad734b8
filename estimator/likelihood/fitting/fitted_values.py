"""Fitted values of a working point, written into the model and as parameters with standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.likelihood.path.uncertainty import joint_covariance
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import LINEAR_UNITS, EffectUse, Model, Setting
from estimator.results import Parameter

LAW_NOT_REACHED = "the motion in this record is too small to reach this law"


def fitted_model(model: Model, point: WorkingPoint) -> Model:
    """The model with the values of the working point; effects that only the point has are added."""
    linear: dict[str, Mapping[str, Setting]] = dict(model.linear)
    for i, place in enumerate(point.data.places):
        old = dict(linear.get(place, {}))
        for name, value in (("kL", point.kL[i]), ("c", point.c[i]), ("S", point.S[i])):
            old[name] = replace(old.get(name, Setting()), value=float(value))
        linear[place] = old
    effects = [_with_values(use, [p for p in point.placed if p.effect.name == use.name]) for use in model.effects]
    known = {use.name for use in model.effects}
    for name in dict.fromkeys(p.effect.name for p in point.placed if p.effect.name not in known):
        laws = [p for p in point.placed if p.effect.name == name]
        law = next((use.custom for use in model.candidates if use.name == name), None)
        effects.append(_with_values(EffectUse(name, {}, law), laws))
    left = tuple(use for use in model.candidates if use.name not in {e.name for e in effects})
    return replace(model, linear=linear, effects=tuple(effects), candidates=left)


def _with_values(use: EffectUse, placed: list[LocatedLaw]) -> EffectUse:
    """An effect of a model with the values of its laws."""
    parameters = {k: dict(v) for k, v in use.parameters.items()}
    for p in placed:
        canonical = p.key.rsplit(".", 1)[0]
        node = canonical.split(".")[0]
        old = parameters.get(canonical, parameters.get(node, {}))
        parameters[canonical] = {
            q.name: replace(old.get(q.name, Setting()), value=float(p.p[k])) for k, q in enumerate(p.effect.parameters)
        }
    if placed:
        covered = {p.key.rsplit(".", 1)[0] for p in placed}
        for node in [k for k in parameters if k not in covered and any(c.startswith(k + ".") for c in covered)]:
            del parameters[node]
    return replace(use, parameters=parameters)


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A fitted value with its standard deviation, both in `unit`, before the decision whether it is identifiable."""

    value: float
    sd: float
    unit: str


def fitted_estimates(point: WorkingPoint) -> dict[str, Estimate]:
    """Every fitted parameter of a working point by full name, and S of every place."""
    places, k = point.data.places, len(point.fit.names)
    spread = np.sqrt(np.diag(joint_covariance(point)))
    sd = dict(zip(point.fit.names, spread[:k] * point.fit.scales, strict=True))
    values: dict[str, tuple[float, str]] = {}
    background = {} if point.data.background is None else point.data.background.at
    for place, own in background.items():
        i = places.index(place)
        for key, value, more in (("kL", point.kL[i], own.stiffness_sd_rel), ("c", point.c[i], own.damping_sd_rel)):
            name = f"{place}.{key}"
            sd |= {name: float(np.hypot(sd[name], more * value))} if name in sd else {}
    for i, place in enumerate(places):
        linear = {"kL": (point.kL[i], "N/m"), "c": (point.c[i], "N s/m"), "m": (point.data.mass[i], "kg")}
        values |= {f"{place}.{key}": z for key, z in linear.items()}
        values[f"{place}.S"] = float(point.S[i]), "N^2/Hz"
        sd[f"{place}.S"] = float(point.S[i] * spread[k + i])
    for use in point.placed:
        values |= {use.name(j): (use.p[j], q.unit) for j, q in enumerate(use.effect.parameters)}
    found = {name: (float(value), float(sd[name]), unit) for name, (value, unit) in values.items() if name in sd}
    return {name: Estimate(value=value, sd=s, unit=unit) for name, (value, s, unit) in found.items()}


def fitted_parameters(point: WorkingPoint, estimates: Mapping[str, Estimate] | None = None) -> dict[str, Parameter]:
    """Every parameter of a working point by full name, with its standard deviation.

    estimates : of the fitted ones by full name; None: those of the point.
    """
    found = fitted_estimates(point) if estimates is None else estimates
    out = {name: Parameter.from_estimate(e.value, e.sd, e.unit) for name, e in found.items()}
    out |= {k: Parameter(v, 0.0, LINEAR_UNITS[k.rsplit(".", 1)[1]], reason="given") for k, v in point.data.held.items()}
    for use in point.placed:
        for k, q in enumerate(use.effect.parameters):
            if use.name(k) not in out:
                out[use.name(k)] = (
                    Parameter(None, None, q.unit, identifiable=False, reason=LAW_NOT_REACHED)
                    if use.free[k]
                    else Parameter(float(use.p[k]), 0.0, q.unit)
                )
    return out


def unidentifiable_laws(point: WorkingPoint) -> list[str]:
    """Keys ("bearing1.x.cubic") of the laws none of whose free amplitudes is identifiable."""
    out = []
    values = fitted_parameters(point)
    for use in point.placed:
        amplitudes = [values[use.name(k)] for k, q in enumerate(use.effect.parameters) if q.linear and use.free[k]]
        if amplitudes and not any(p.identifiable for p in amplitudes):
            out.append(use.key)
    return out
