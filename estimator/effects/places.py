"""Where an effect of a model acts, and with which numbers.

Canonical places. scope "direction": "bearing1.x". scope "node": "bearing1" (one set of parameters for x and y). scope
"bearings": the direction at the first of two bearings, "bearing1.x". kind disc or shaft: a disc, such as "disc". kind
sensor: the place of the channel. A node-scope entry written "bearing1.x" (or a direction-scope entry written
"bearing1") is understood.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.errors import ModelError
from estimator.model.bearing_theory import kinematics
from estimator.model.effect import Effect
from estimator.model.rig import CAP_DIRECTIONS, EffectUse, Model, Setting


def places(effect: Effect, model: Model) -> tuple[str, ...]:
    """Canonical locations that an effect can act at in a model.

    Parameters
    ----------
    effect : Effect
        Of the catalogue or the user.
    model : Model
        The rig. Without measured caps, the locations of `model.linear` count.

    Returns
    -------
    tuple of str
        Such as "bearing1.x", "bearing1" (scope node) or "disc"; empty where the effect cannot act.
    """
    caps = model.places or tuple(model.linear)
    if effect.kind in ("disc", "shaft"):
        return model.discs if effect.kind == "disc" or model.rotor is None else ()
    if effect.scope == "bearings":
        both = (d for d in CAP_DIRECTIONS if all(f"{n}.{d}" in caps for n in model.bearings))
        return tuple(f"{model.bearings[0]}.{d}" for d in both) if len(model.bearings) == 2 else ()
    if effect.scope == "node":
        measured = ([f"{n}.{d}" in caps for d in CAP_DIRECTIONS] for n in model.bearings)
        enough = any if effect.one_direction else all
        return tuple(n for n, own in zip(model.bearings, measured, strict=True) if enough(own))
    return tuple(caps)


def at(effect: Effect, use: EffectUse, model: Model) -> tuple[str, ...]:
    """Canonical places of a use, each once. Raises ModelError for a place where the effect cannot act."""
    can = places(effect, model)
    found: dict[str, None] = {}
    for written in use.parameters:
        node = written.split(".")[0]
        matches = [p for p in can if p in (written, node) or p.split(".")[0] == written]
        if effect.kind in ("disc", "shaft") and written not in can:
            matches = [p for p in can if p == written] or list(can[:1])
        if effect.scope == "bearings":
            matches = [p for p in can if written in model.bearings or written.split(".")[-1] == p.split(".")[1]]
        if effect.kind == "sensor" and not matches:
            matches = [c.place for c in model.channels if c.name == written]
        if not matches:
            raise ModelError(f"effect {use.name} cannot act at {written!r}; possible: {', '.join(can) or 'no place'}")
        found |= dict.fromkeys(matches)
    return tuple(found)


def values(effect: Effect, use: EffectUse, model: Model, place: str) -> NDArray[np.float64]:
    """(k,) parameters at a canonical place, SI, in declared order.

    Kinematic orders and the number of balls come from the rig where they are not given. Raises ModelError naming
    what is missing (a missing parameter never means "off") or impossible.
    """
    settings = written(effect, use, model, place)
    out: list[float] = []
    for p in effect.parameters:
        value = settings[p.name].value if p.name in settings else None
        if value is None:
            value = kinematic(p.scale, model)
        if value is None and p.given:
            value = p.default
        if value is None:
            raise ModelError(f"effect {use.name} at {place} has no {p.name} ({p.unit}): give it, or fit first")
        if not np.isfinite(value) or (p.low >= 0.0 and value < 0.0) or (p.given and not p.low <= value <= p.high):
            limits = f"{p.low:g} to {p.high:g}" if p.given else "a number of at least 0" if p.low >= 0.0 else "a number"
            raise ModelError(f"effect {use.name} at {place}: {p.name} is {value:g} {p.unit}, it must be {limits}")
        out.append(float(value))
    return np.array(out)


def written(effect: Effect, use: EffectUse, model: Model, place: str) -> dict[str, Setting]:
    """Settings of each parameter of a use at a canonical place, in whichever form the use gives the place.

    What is written for the very place comes before what is written for its node; a value before none.
    """
    node, names = place.split(".")[0], {c.name for c in model.channels if c.place == place}

    def holds(key: str) -> bool:
        if effect.scope == "bearings":
            return key in model.bearings or key.endswith(place[-2:])
        same = effect.scope == "node" and key.split(".")[0] == node
        return same or key in (place, node, *names) or (effect.kind in ("disc", "shaft") and key not in model.discs)

    out: dict[str, Setting] = {}
    for key in sorted(filter(holds, use.parameters), key=lambda key: (key != place, key != node)):
        for name, setting in use.parameters[key].items():
            if name not in out or (out[name].value is None and setting.value is not None):
                out[name] = setting
    return out


def kinematic(scale: str, model: Model) -> float | None:
    """A number that the rig's geometry gives: scale "bpfo" | "balls"; None if the geometry is unknown."""
    if scale == "balls" and model.bearing is not None:
        return float(model.bearing.balls)
    if scale == "bpfo":
        if model.ball_pass_order is not None:
            return model.ball_pass_order
        if model.bearing is not None:
            return kinematics(model.bearing)["BPFO"]
    return None
