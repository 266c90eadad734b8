"""The whole model on a record: besides the laws of the states also what has no place in their fit.

Periodic forces, shaped or shared excitation and faulty sensors are found where diagnosis finds them, in what a model
without them leaves; then the rest is fitted with them in place. A number that the rig file fixes is kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import starmap

import numpy as np
from numpy.typing import NDArray

from . import (
    bends,
    common_fall,
    coupled_caps,
    force_colour,
    force_level,
    force_shapes,
    modulation,
    noise_floor,
    one_end,
    periodic,
    periodic_fit,
    recorder_phase,
    roll_off,
    sensor_faults,
    shaft_law,
    unknown_mass,
)
from .declip import LOST, RESTORED, restored
from .effect import EffectParameter
from .effects import NAMED
from .effects.places import at, written
from .estimate import Parameter, untold_at
from .fit_result import Fit
from .fitted import parameters
from .known_spectra import COLOURS, OF_FORCE
from .known_spectra import colours as colours_of
from .model import EffectUse, Model, Setting
from .model_uses import clipped
from .motion_blocks import MotionBlocks
from .preparation import prepare, shortened
from .search_start import fit_record
from .sensor_response import BLIND, LINEAR, forced
from .shaft_angle import timed
from .start import refuse_without_resonance, resonates
from .suspect import Suspect, as_use
from .suspects import suspects
from .working_point import WorkingPoint

Array = NDArray[np.float64]
SHAPING = (*COLOURS, "correlated_force", "sensor_clipping", "sensor_noise")
ROUNDS = 2  # of the numbers of periodic forces and colours, which the rest of the fit depends on
SETTLED = 0.5  # standard deviations by which a colour may still move


@dataclass(frozen=True, slots=True)
class Whole:
    """model : with the numbers found for what is no law of the states. beside : these, by full name.
    messages : what was found on the way, for the user. masses : those that the rig file leaves out, by full name."""

    model: Model
    point: WorkingPoint
    beside: dict[str, Parameter]
    messages: tuple[str, ...] = ()
    masses: dict[str, Parameter] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Every parameter by full name with its standard deviation."""
        data = self.point.data
        lost = {place for i, place in enumerate(data.places) if i not in data.judged}
        found = untold_at(lost, LOST, parameters(self.point)) | self.beside
        found = unknown_mass.widened(self.model, found, self.masses)
        return untold_at(unknown_mass.unknown(self.model), unknown_mass.FREE, found, "N") | self.masses


def beside_the_laws(use: EffectUse) -> bool:
    """Whether an effect is none of the laws that a fit of the states has columns for."""
    return use.name in (*periodic.PERIODIC, *SHAPING, *BLIND)


def fit_whole(model: Model, y: Array, rate_hz: float) -> Whole:
    """Fit everything in a model to (n, channels) rows, SI, NaN where missing. A tacho channel gives the speed.

    Raises DataError, also where no force is measured and a place does not resonate in the band: nothing is told of its
    stiffness and damping then, and so of what is missing beside them.
    """
    given = timed(model, y, rate_hz)
    model, masses = unknown_mass.weighed(given, y, rate_hz)
    begun = _glanced(model, y, rate_hz)
    off = common_fall.find(model, begun) if begun and all(starmap(resonates, _means(begun).values())) else None
    if off and unknown_mass.of_shaft(given):  # what the shaft tells of them is told without the filter
        return fit_whole(replace(given, roll_off=off), y, rate_hz)
    if off and begun:
        begun = begun.rowless()
    whole = _turning(replace(model, roll_off=off) if off else model, y, rate_hz, begun)
    if not begun and not model.roll_off and (off := common_fall.find(whole.model, whole.point)):
        whole = _turning(replace(model, roll_off=off), y, rate_hz, whole.point)
    _refuse(whole.point)
    if not model.roll_off and (late := recorder_phase.found(whole.model, whole.point)):
        whole = _turning(replace(model, roll_off=late), y, rate_hz, whole.point)
    if whole.model.roll_off != model.roll_off and unknown_mass.of_shaft(given):
        return fit_whole(replace(given, roll_off=whole.model.roll_off), y, rate_hz)
    data = whole.point.data
    said = (
        *shortened(data, y),
        *unknown_mass.said(masses),
        *unknown_mass.ratios(whole.model, whole.point),
        *roll_off.said(whole.model.roll_off, data.places),
        *force_level.said(data.level),
        *one_end.said(whole.model, dict(zip(data.places, whole.point.kL.tolist(), strict=True))),
        *shaft_law.said(data, [use.effect for use in whole.point.placed]),
    )
    return replace(whole, messages=(*said, *whole.messages), masses=masses)


def _glanced(model: Model, y: Array, rate_hz: float) -> WorkingPoint | None:
    """The model's laws near enough to see a filter, which is undone before they are fitted in earnest. None where the
    model has more than laws of the states, or a filter."""
    if model.roll_off or modulation.laws(model) or any(beside_the_laws(u) for u in model.effects):
        return None
    return fit_record(model, prepare(model, y, rate_hz), glance=True)


def _means(point: WorkingPoint) -> dict[str, tuple[float, float, float, tuple[float, float]]]:
    """By place m, c and k of the mean response, and the band; of places that are judged and have no measured force."""
    data, slopes = point.data, point.slopes
    own = () if data.measured_force else data.judged
    return {data.places[i]: (float(data.mass[i]), slopes[i, i, 1], slopes[i, i, 0], data.band) for i in own}


def _refuse(point: WorkingPoint) -> None:
    """Refuses places that do not resonate in the band."""
    for place, mean in _means(point).items():
        refuse_without_resonance(place, *mean)


def _turning(model: Model, y: Array, rate_hz: float, begun: WorkingPoint | None = None) -> Whole:
    """The same at the speed that the model gives, the ball-pass order from the record where the model leaves it.
    begun : the same nearly fitted, or before a filter was undone."""
    if not modulation.sought(model):
        return _fitted(model, y, rate_hz, begun)
    if laws := modulation.laws(model):
        bare = replace(model, effects=tuple(u for u in model.effects if u not in laws))
        model, said = modulation.turned(model, _fitted(bare, y, rate_hz).point)
        return replace(_fitted(modulation.begun(model) if said else model, y, rate_hz), messages=said)
    whole = _fitted(model, y, rate_hz, begun)
    model, said = modulation.turned(whole.model, whole.point)
    return replace(whole, model=model, messages=(*whole.messages, *said))


def _fitted(model: Model, y: Array, rate_hz: float, begun: WorkingPoint | None = None) -> Whole:
    """The same at the ball-pass order that the model gives."""
    uses = [u for u in model.effects if beside_the_laws(u)]
    if not uses:
        data = replace(begun.data) if begun and not model.roll_off else prepare(model, y, rate_hz)  # seen anew
        return Whole(model, fit_record(model, data, begun), {})
    limited, (y, off) = y, restored(model, y, clipped(model))

    def prepared(model: Model) -> MotionBlocks:
        data = prepare(model, y, rate_hz)
        return replace(data, drawn=np.array([off.get(p, 0.0) for p in data.places])) if off else data

    undone = [u for u in uses if _undone(u, model)]
    bare = replace(model, effects=tuple(u for u in model.effects if u not in uses or u in undone))
    point = fit_record(bare, prepared(bare))
    numbered = {u.name for u in uses if u not in undone or not _told(u, model)}
    seen = suspects(bare, point, y, everywhere=True)
    seen += sensor_faults.find(bare, limited) if limited is not y else []
    further = _further_lines(model, seen)
    model, found = _all_numbered(with_uses(model, further), numbered | further.keys(), seen, point)
    point = fit_record(model, prepared(model))
    colours = {u.name for u in uses if u.name in OF_FORCE}
    for _ in range(ROUNDS if colours else 0):  # found among laws that they distort
        data = point.data
        flat = replace(point, data=replace(data, colour=colours_of(bare, data.places, data.f_hz, OF_FORCE)))
        renewed, again = _all_numbered(model, colours, force_colour.find(bare, flat), flat)
        if not _moved(found, again):
            break
        model, found = renewed, found | again
        point = fit_record(model, prepared(model))
    for _ in range(ROUNDS if any(u.name in (*periodic.PERIODIC, *LINEAR) for u in uses) else 0):
        model, bent = bends.refined(model, point)
        model, mutual = coupled_caps.refined(model, point)
        model, stepped = periodic_fit.settled(model, point)
        stepped |= bent | mutual
        found |= stepped
        if stepped:
            point = fit_record(model, prepared(model))
    told = (f"{place}: {RESTORED if error < np.inf else LOST}" for place, error in sorted(off.items()))
    messages = (*_several(model, further), *told)
    return Whole(model, point, found | _levels(model, found, point), messages)


def _several(model: Model, further: Mapping[str, Mapping[str, Mapping[str, Setting]]]) -> tuple[str, ...]:
    """What to tell the user of a line that is several."""
    names = [u.name for u in model.effects if u.name in further]
    return (f"line stands for several lines, {', '.join(['line', *names])}: fit --out writes them",) if names else ()


def with_uses(model: Model, further: Mapping[str, Mapping[str, Mapping[str, Setting]]]) -> Model:
    """The model with effects at further places. further : name -> canonical place -> parameter name -> Setting."""
    uses = {use.name: use for use in model.effects}
    for name, own in further.items():
        use = uses.get(name, EffectUse(name, {}))
        uses[name] = replace(use, parameters={**use.parameters, **own})
    return replace(model, effects=tuple(uses.values()))


def with_found(model: Model, found: Mapping[str, Mapping[str, Mapping[str, Parameter]]]) -> Model:
    """The model with effects that are no force laws, at the values found. found : by the name of the effect."""
    return with_uses(model, {name: as_use(name, own).parameters for name, own in found.items()})


def _further_lines(model: Model, seen: list[Suspect]) -> dict[str, dict[str, dict[str, Setting]]]:
    """Name -> place -> no numbers, of lines seen that the model has no name for: at a place where it has one without a
    frequency, which is as many lines as there are."""
    out: dict[str, dict[str, dict[str, Setting]]] = {}
    uses = [(u, at(NAMED[u.name], u, model)) for u in model.effects if u.name in periodic.LINE_NAMES]
    for key in dict.fromkeys(key for _, keys in uses for key in keys):
        own = {u.name: written(NAMED[u.name], u, model, key).get("frequency", Setting()) for u, ks in uses if key in ks}
        if all(setting.value is not None for setting in own.values()):
            continue
        free = [name for name in periodic.LINE_NAMES if name not in own]
        count = sum(s.effect == "line" and key in s.settings for s in seen) - len(own)
        for name in free[: max(count, 0)]:
            out.setdefault(name, {})[key] = {}
    return {name: out[name] for name in periodic.LINE_NAMES if name in out}


def _levels(model: Model, found: Mapping[str, Parameter], point: WorkingPoint) -> dict[str, Parameter]:
    """S of the places whose excitation has a colour that was found."""
    out = {}
    for i, place in enumerate(point.data.places):
        gain, corner = (found.get(f"{place}.coloured_excitation.{n}") for n in ("gain", "corner"))
        if gain and corner and gain.value is not None and corner.value is not None and (gain.sd or corner.sd):
            out[f"{place}.S"] = force_shapes.level(point, i, gain.value, corner.value)
    return out


def _told(use: EffectUse, model: Model) -> bool:
    """Whether it is a sensor's response beside a measured force, which tells it."""
    return use.name in LINEAR and bool(forced(model).intersection(at(NAMED[use.name], use, model)))


def _undone(use: EffectUse, model: Model) -> bool:
    """Whether it is a sensor's response that is undone before anything is known of it: as the rig file gives it."""
    if not _told(use, model):
        return use.name in BLIND
    names = [q.name for q in NAMED[use.name].parameters]
    return all(own.get(n, Setting()).value is not None for own in use.parameters.values() for n in names)


def as_fit(whole: Whole) -> Fit:
    """The same as the result of a fit."""
    data = whole.point.data
    samples = data.blocks * data.block
    return Fit(whole.parameters, whole.point.fit.log_likelihood, samples, "spectral", whole.messages)


def _all_numbered(
    model: Model, names: set[str], seen: list[Suspect], point: WorkingPoint
) -> tuple[Model, dict[str, Parameter]]:
    """The model with what was found for the effects of these names, and that as parameters."""
    found: dict[str, Parameter] = {}
    effects = []
    for use in model.effects:
        if use.name in names:
            use, own = _numbered(use, model, seen, point)
            found |= own
        effects.append(use)
    return replace(model, effects=tuple(effects)), found


def _moved(before: Mapping[str, Parameter], now: Mapping[str, Parameter]) -> bool:
    """Whether numbers that were found both times differ by more than a part of a standard deviation."""
    pairs = [(before[name], p) for name, p in now.items()]
    if any(p.value is None or q.value is None for p, q in pairs):
        return False
    return any(abs((p.value or 0.0) - (q.value or 0.0)) > SETTLED * (q.sd or 0.0) for p, q in pairs if q.sd)


def _numbered(
    use: EffectUse, model: Model, seen: list[Suspect], point: WorkingPoint
) -> tuple[EffectUse, dict[str, Parameter]]:
    """The use with what was found for it at each of its places, and that as parameters."""
    effect = NAMED[use.name]
    found: dict[str, Parameter] = {}
    new: dict[str, dict[str, Setting]] = {}
    for key in at(effect, use, model):
        old = written(effect, use, model, key)
        own = _found(use, key, old, model, seen, point)
        new[key] = {}
        for q in effect.parameters:
            setting, name = old.get(q.name, Setting()), f"{key}.{use.name}.{q.name}"
            if setting.fixed and setting.value is not None:
                found[name] = Parameter(setting.value, 0.0, q.unit, True, "given")
            elif q.name in own:
                found[name] = own[q.name]
                setting = replace(setting, value=own[q.name].value)
            else:
                blind = use.name in BLIND and not _told(use, model)
                found[name] = _unseen(blind, q)
                setting = setting if blind else replace(setting, value=None)
            new[key][q.name] = setting
    return replace(use, parameters=new), found


def _found(
    use: EffectUse, key: str, old: Mapping[str, Setting], model: Model, seen: list[Suspect], point: WorkingPoint
) -> dict[str, Parameter]:
    """Name -> number of a use at a canonical place; of several lines the one nearest to the frequency written."""
    if use.name == "sensor_noise" and key in point.data.places:
        return {"rms": noise_floor.sensor_noise(point, point.data.places.index(key))}
    if use.name == "bow":
        return _bow(model, [s.settings[key] for s in seen if s.effect == "imbalance"])
    if use.name in periodic.LINE_NAMES:
        return _line(use, key, model, [s.settings[key] for s in seen if s.effect == "line" and key in s.settings])
    return next((s.settings[key] for s in seen if s.effect == use.name and key in s.settings), {})


def _line(use: EffectUse, key: str, model: Model, seen: list[dict[str, Parameter]]) -> dict[str, Parameter]:
    """Of the lines seen at a place the one nearest to the frequency written; without one the strongest that no other
    line of the model has."""
    lines = {
        u.name: written(NAMED[u.name], u, model, key).get("frequency", Setting()).value
        for u in model.effects
        if u.name in periodic.LINE_NAMES and key in at(NAMED[u.name], u, model)
    }
    left = list(seen)
    for name, hz in sorted(lines.items(), key=lambda one: not one[1]):
        if not left:
            break
        own = left.pop(min(range(len(left)), key=lambda k: abs((left[k]["frequency"].value or 0.0) - hz) if hz else k))
        if name == use.name:
            return own
    return {}


def _bow(model: Model, seen: list[dict[str, Parameter]]) -> dict[str, Parameter]:
    """The line at the shaft's speed as the work of a bow, where it was found as that of an imbalance."""
    if not seen:
        return {}
    rotation = np.array([2 * np.pi * (model.speed_rpm or 0.0) / 60.0])
    through = complex(periodic.to_cap(model, "bearing1.x", rotation)[0])
    ratio = through / (through - 0.5)
    a, b = seen[0]["a"], seen[0]["b"]
    force = ratio * complex(a.value or 0.0, b.value or 0.0)
    sd = abs(ratio) * (a.sd or 0.0)
    return {"a": Parameter(force.real, sd, "N"), "b": Parameter(force.imag, sd, "N")}


def _unseen(blind: bool, q: EffectParameter) -> Parameter:
    if blind:
        why = "bearings that hardly feel each other say nothing of it: measure the force, or give it with fixed = true"
    else:
        why = periodic.UNTOLD
    return Parameter(None, None, q.unit, False, why)
