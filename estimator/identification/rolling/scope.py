"""The scope of a rolling estimate: effects that it estimates, holds at given values, or leaves to a fit.

Laws of the states are estimated. The spectral shape of the excitation and the gain of a sensor are held at the values
of the rig file; without these values no parameter of their places is identifiable. Beside a force with memory or a
resonant sensor none is either. Periodic forces are left out as lines. All other effects do not bias the rest, and are
left to a fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from estimator.effects.engine.custom import effect_of
from estimator.effects.places import at, kinematic, written
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.known_spectra import FORCE_SHAPES
from estimator.likelihood.response.below_band import has_even_part, usual_parameters, usual_sizes
from estimator.model.disc import disc_of
from estimator.model.effect import Effect
from estimator.model.rig import CAP_DIRECTIONS, EffectUse, Model, Setting
from estimator.results import Parameter
from estimator.signals.channel_response import GAIN_AND_DELAY

from .thresholds import LIMITS

FIT_HINT = "rotorscope fit has its numbers"
CLIPPED_REASON = "its sensor is clipped: what that took away is missing from the motion"
BREATHING_SHAFT_REASON = f"beside a shaft that breathes: {FIT_HINT}"
EVEN_LAW_REASON = f"an accelerometer does not show the slow displacement that a law makes here: {FIT_HINT}"
WRITE_HINT = "rotorscope fit --out writes what it finds"


@dataclass(frozen=True, slots=True)
class RollingScope:
    """Treatment of each effect of a model in a rolling estimate.

    model : the model with the effects that are estimated or held at given numbers, and no other.
    not_estimated : parameters that are given, or left to a fit, by full name.
    lacking : place -> why no number of that place can be given.
    approximate : places of laws with an even part: an accelerometer does not show the slow displacement that they make.
    """

    model: Model
    not_estimated: Mapping[str, Parameter]
    lacking: Mapping[str, str]
    approximate: frozenset[str] = frozenset()

    def _beside_even_law(self, name: str, p: Parameter) -> Parameter:
        """A parameter as it is shown where a law makes a slow displacement: no number for a law, and a linear parameter
        with the reason of its small bias."""
        if not p.identifiable or p.sd == 0.0 or not any(name.startswith(f"{place}.") for place in self.approximate):
            return p
        if name.count(".") > 2:
            return Parameter(None, None, p.unit, identifiable=False, reason=EVEN_LAW_REASON)
        return replace(p, reason=EVEN_LAW_REASON)

    def shown(self, found: Mapping[str, Parameter]) -> dict[str, Parameter]:
        """All parameters by full name: those found, without the places that lack something, and those not estimated."""
        out = {name: self._beside_even_law(name, p) for name, p in found.items()}
        for name, p in found.items():
            node, direction = name.split(".")[:2]
            own = f"{node}.{direction}" if direction in CAP_DIRECTIONS else node  # of both directions of a node
            why = next((w for place, w in self.lacking.items() if own in (place, place.split(".")[0])), "")
            if why and p.sd != 0.0:  # what is given stays
                out[name] = Parameter(None, None, p.unit, identifiable=False, reason=why)
        return out | dict(self.not_estimated)


def rolling_scope(model: Model) -> RollingScope:
    """The scope of a model. Raises ModelError for an effect at a place where it cannot act."""
    kept: list[EffectUse] = []
    not_estimated: dict[str, Parameter] = {}
    lacking: dict[str, str] = {}
    for use in model.effects:
        effect, new = effect_of(use), {}
        for key in at(effect, use, model):
            own = written(effect, use, model, key)
            names = {q.name: f"{key}.{use.name}.{q.name}" for q in effect.parameters}
            held = _held_parameters(effect, model)
            missing = [name for name in held if own.get(name, Setting()).value is None]
            if missing or not (_is_state_law(effect) or _is_corrected_as_given(effect)):
                why = _reason_not_estimated(effect, missing)
                not_estimated |= {
                    names[q.name]: Parameter(None, None, q.unit, identifiable=False, reason=why)
                    for q in effect.parameters
                }
                lacking |= _biased(use, effect, model, key, missing)
                continue
            new[key] = {name: replace(s, fixed=s.fixed or name in held) for name, s in own.items()}
            for q in effect.parameters:
                s = new[key].get(q.name)
                if s is not None and s.fixed and s.value is not None:
                    not_estimated[names[q.name]] = Parameter(s.value, 0.0, q.unit, reason="given")
        if new:
            kept.append(replace(use, parameters=new))
    shown = {c.place for c in model.channels if c.kind == "displacement"}
    even = [u for u in kept if has_even_part(e := effect_of(u), usual_parameters(e), usual_sizes(e))]
    return RollingScope(
        replace(model, effects=tuple(kept)),
        not_estimated,
        lacking,
        frozenset(key for u in even for key in u.parameters if not any(key in (c, c.split(".")[0]) for c in shown)),
    )


def _biased(use: EffectUse, effect: Effect, model: Model, key: str, missing: list[str]) -> dict[str, str]:
    """Places whose parameters are biased as an effect at `key` is left out, with the reason that is shown."""
    places = [p for p in model.places if key in (p, p.split(".")[0])]
    if effect.kind == "shaft" and effect.name not in PERIODIC_EFFECTS:
        settings = written(effect, use, model, key)
        return {p: BREATHING_SHAFT_REASON for p in model.places if _crack_is_felt(settings, model, p)}
    if effect.found_by == "samples":
        return {key: CLIPPED_REASON}
    if missing and not effect.scales_channel:
        return dict.fromkeys(places, f"not without the {', '.join(missing)} of {use.name}: {WRITE_HINT}")
    if effect.kind == "memory" or (effect.spectral_factor is not None and effect.name not in FORCE_SHAPES):
        return dict.fromkeys(places, f"beside {use.name}: {FIT_HINT}")
    return {}


def _crack_is_felt(settings: Mapping[str, Setting], model: Model, place: str) -> bool:
    """Whether a crack changes the stiffness at a place noticeably; True if its values are not known."""
    values = [s.value for s in settings.values()]
    kL = model.linear.get(place, {}).get("kL", Setting()).value
    if not values or None in values or not kL:
        return disc_of(model) is not None
    return 0.5 * sum(abs(v or 0.0) for v in values) > LIMITS.min_crack_stiffness_rel * kL


def _is_corrected_as_given(effect: Effect) -> bool:
    """Whether an effect is a known shape of the excitation or a gain, inverted at the values of the rig file."""
    return effect.name in FORCE_SHAPES or effect.scales_channel


def _is_state_law(effect: Effect) -> bool:
    """Whether an effect is a force law of the states."""
    return effect.kind == "force" and effect.name not in PERIODIC_EFFECTS


def _held_parameters(effect: Effect, model: Model) -> list[str]:
    """Names of the parameters that are held at given values.

    A shaft order of a parametric stiffness is never searched: the first seconds do not give it well enough to keep the
    phase.
    """
    if _is_corrected_as_given(effect):
        return [q.name for q in effect.parameters]
    orders = [q for q in effect.parameters if q.scale == "bpfo" and not (q.linear or q.given)]
    return [q.name for q in orders if _is_state_law(effect) and kinematic(q.scale, model) is None]


def _reason_not_estimated(effect: Effect, missing: list[str]) -> str:
    """Why a rolling estimate has no parameters of an effect. missing : held parameters without a value."""
    if missing and not effect.scales_channel:
        return f"to be given: {WRITE_HINT}"
    if effect.name in PERIODIC_EFFECTS:
        return f"as it rolls its lines are left out: {FIT_HINT}"
    if effect.name in GAIN_AND_DELAY:
        return "only a calibration or a measured force says it: give it"
    return f"not estimated as it rolls: {FIT_HINT}"
