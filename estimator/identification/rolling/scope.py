"""What of a model a rolling estimate follows, what it holds at given numbers, and what it leaves to a fit and says so.

Laws of the states are estimated. Forces with memory and shapes of the force's spectrum (coloured excitation, a sensor's
resonance) are held at the numbers of the rig file; without them nothing sound can be said of their places. Periodic
forces show as lines, which are left out. What else there is does not move the rest, and is left to a fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from estimator.effects.engine.custom import effect_of
from estimator.effects.places import at, kinematic, written
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.known_spectra import SPECTRAL_SHAPES
from estimator.model.disc import disc_of
from estimator.model.effect import Effect
from estimator.model.rig import DIRECTIONS, EffectUse, Model, Setting
from estimator.results import Parameter
from estimator.signals.channel_response import GAIN_AND_DELAY

FIT_HINT = "rotorscope fit has its numbers"
CLIPPED_REASON = "its sensor is clipped: what that took away is missing from the motion"
BREATHING_SHAFT_REASON = f"beside a shaft that breathes: {FIT_HINT}"
MIN_CRACK_STIFFNESS_REL = 1e-3  # of a stiffness
WRITE_HINT = "rotorscope fit --out writes what it finds"


@dataclass(frozen=True, slots=True)
class RollingScope:
    """What of a model a rolling estimate follows.

    model : the model with the effects that are estimated or held at given numbers, and no other.
    not_estimated : parameters that are given, or left to a fit, by full name.
    lacking : place -> why no number of that place can be given.
    """

    model: Model
    not_estimated: Mapping[str, Parameter]
    lacking: Mapping[str, str]

    def shown(self, found: Mapping[str, Parameter]) -> dict[str, Parameter]:
        """What was found, but for the places of which nothing can be said; and the rest."""
        out = dict(found)
        for name, p in found.items():
            node, direction = name.split(".")[:2]
            own = f"{node}.{direction}" if direction in DIRECTIONS else node  # of both directions of a node
            why = next((w for place, w in self.lacking.items() if own in (place, place.split(".")[0])), "")
            if why and p.sd != 0.0:  # what is given stays
                out[name] = Parameter(None, None, p.unit, False, why)
        return out | dict(self.not_estimated)


def rolling_scope(model: Model) -> RollingScope:
    """Sorts the effects of a model. Raises ModelError for an effect at a place where it cannot act."""
    kept: list[EffectUse] = []
    not_estimated: dict[str, Parameter] = {}
    lacking: dict[str, str] = {}
    remembers = any(effect_of(use).kind == "memory" for use in model.effects)
    for use in model.effects:
        effect, new = effect_of(use), {}
        for key in at(effect, use, model):
            own = written(effect, use, model, key)
            names = {q.name: f"{key}.{use.name}.{q.name}" for q in effect.parameters}
            held = _held_parameters(effect, model, remembers)
            missing = [name for name in held if own.get(name, Setting()).value is None]
            if not _is_estimated_or_held(effect) or missing:
                why = _reason_not_estimated(effect, missing)
                not_estimated |= {names[q.name]: Parameter(None, None, q.unit, False, why) for q in effect.parameters}
                if effect.kind == "shaft" and effect.name not in PERIODIC_EFFECTS:
                    lacking |= {p: BREATHING_SHAFT_REASON for p in model.places if _crack_is_felt(own, model, p)}
                elif effect.name == "sensor_clipping":
                    lacking |= dict.fromkeys([key], CLIPPED_REASON)
                elif missing and effect.name != "sensor_gain":
                    places = (p for p in model.places if key in (p, p.split(".")[0]))
                    lacking |= dict.fromkeys(
                        places, f"not without the {', '.join(missing)} of {use.name}: {WRITE_HINT}"
                    )
                continue
            new[key] = {name: replace(s, fixed=s.fixed or name in held) for name, s in own.items()}
            for q in effect.parameters:
                s = new[key].get(q.name)
                if s is not None and s.fixed and s.value is not None:
                    not_estimated[names[q.name]] = Parameter(s.value, 0.0, q.unit, True, "given")
        if new:
            kept.append(replace(use, parameters=new))
    return RollingScope(replace(model, effects=tuple(kept)), not_estimated, lacking)


def _crack_is_felt(own: Mapping[str, Setting], model: Model, place: str) -> bool:
    """Whether what a crack takes of the shaft is anything beside the stiffness at a place; if in doubt, it is."""
    values = [s.value for s in own.values()]
    kL = model.linear.get(place, {}).get("kL", Setting()).value
    if not values or None in values or not kL:
        return disc_of(model) is not None
    return 0.5 * sum(abs(v or 0.0) for v in values) > MIN_CRACK_STIFFNESS_REL * kL


def _is_estimated_or_held(effect: Effect) -> bool:
    """Whether an effect is estimated or held, not left to a fit."""
    return _is_state_law(effect) or effect.kind == "memory" or effect.name in (*SPECTRAL_SHAPES, "sensor_gain")


def _is_state_law(effect: Effect) -> bool:
    return effect.kind == "force" and effect.name not in PERIODIC_EFFECTS


def _held_parameters(effect: Effect, model: Model, remembers: bool) -> list[str]:
    """Parameters that are not estimated. remembers : beside hidden states no shape of a law is searched.

    Nor is the order at which stiffness turns: the first seconds tell it to some thousandths of a turn a second, and the
    phase is lost within the memory.
    """
    if effect.name in (*SPECTRAL_SHAPES, "sensor_gain"):
        return [q.name for q in effect.parameters]
    if effect.kind != "memory" and not _is_state_law(effect):
        return []
    searched = [q for q in effect.parameters if not q.linear and not q.given and kinematic(q.scale, model) is None]
    all_of_them = effect.kind == "memory" or remembers
    return [q.name for q in searched if all_of_them or q.scale == "bpfo"]


def _reason_not_estimated(effect: Effect, missing: list[str]) -> str:
    if missing and effect.name != "sensor_gain":
        return f"to be given: {WRITE_HINT}"
    if effect.name in PERIODIC_EFFECTS:
        return f"as it rolls its lines are left out: {FIT_HINT}"
    if effect.name in GAIN_AND_DELAY:
        return "bearings that hardly feel each other say nothing of it: give it"
    return f"not estimated as it rolls: {FIT_HINT}"
