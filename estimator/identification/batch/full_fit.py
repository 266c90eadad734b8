"""The whole model on a record: besides the laws of the states also what has no place in their fit.

Periodic forces, shaped or shared excitation and faulty sensors are found where diagnosis finds them, in what a model
without them leaves; then the rest is fitted with them in place. A number that the rig file fixes is kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import starmap

import numpy as np

from estimator.arrays import Array
from estimator.identification.machine import harmonic_fit, stiffness_order
from estimator.identification.record import clipping
from estimator.identification.record.declip import LOST, RESTORED, SPOILED, restored
from estimator.identification.search import search
from estimator.identification.structure import (
    coupled_caps,
    recorder_fall,
    recorder_phase,
    spectral_models,
    spectral_shape,
    transfer_bias,
)
from estimator.likelihood.fitting.fitted_values import fitted_parameters
from estimator.likelihood.motion import harmonics, shaft_law
from estimator.likelihood.motion.known_spectra import FORCE_SHAPES, SPECTRAL_SHAPES
from estimator.likelihood.motion.known_spectra import excitation_shapes as colours_of
from estimator.likelihood.motion.located_law import clipped_places
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.motion.prepare import prepare, shortening_messages
from estimator.likelihood.path import excitation_level
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model import recorder
from estimator.model.rig import EffectUse, Model, Setting
from estimator.results import Fit, Message, Parameter, with_unidentifiable_at
from estimator.signals.channel_response import GAIN_AND_DELAY, RESPONSE_EFFECTS
from estimator.signals.shaft_angle import with_measured_speed

from . import unknown_mass, unmeasured_end
from .disturbance_numbers import (
    further_lines_found,
    is_identifiable_by_force,
    is_undone_as_given,
    parameters_have_moved,
    with_further_effects,
    with_resolved_parameters,
)
from .grid_start import fit_record
from .linear_start import refuse_without_resonance, resonates

SPECTRAL_AND_SENSOR_EFFECTS = (*SPECTRAL_SHAPES, "correlated_force", "sensor_clipping", "sensor_noise")
MIN_RESOLVING_ROUNDS = 2  # of the numbers of periodic forces and colours, which the rest of the fit depends on
MAX_RESOLVING_ROUNDS = 6  # while the answers of two caps to each other still move


@dataclass(frozen=True, slots=True)
class FullFit:
    """A model fitted with all of its effects.

    model : the model with the numbers found for its disturbances.
    point : the working point of the fit.
    disturbances : parameters of the disturbances, by full name.
    messages : one line each, for the user.
    masses : cap masses that the rig file leaves out and the shaft gives, kg, by full name.
    S_sd_rel : relative standard deviation of S by an anti-alias roll-off that is too weak to be found.
    """

    model: Model
    point: WorkingPoint
    disturbances: dict[str, Parameter]
    messages: tuple[Message, ...] = ()
    masses: dict[str, Parameter] = field(default_factory=dict)
    S_sd_rel: float = 0.0

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Every parameter by full name with its standard deviation."""
        found = with_unidentifiable_at(self.point.data.lost, SPOILED, fitted_parameters(self.point)) | self.disturbances
        seen = {place: off.doubt for place, off in (self.model.roll_off or {}).items()}
        found = recorder.doubted(seen or dict.fromkeys(self.point.data.places, self.S_sd_rel), found)
        found = unknown_mass.with_mass_uncertainty(self.model, found, self.masses)
        scaleless = unknown_mass.places_without_mass(self.model)
        return with_unidentifiable_at(scaleless, unknown_mass.NO_MASS_REASON, found, "N") | self.masses

    def to_fit(self) -> Fit:
        """The result of `fit`, without the model and the working point."""
        return Fit(
            parameters=self.parameters,
            log_likelihood=self.point.fit.log_likelihood,
            samples=self.point.data.blocks * self.point.data.block,
            method="spectral",
            messages=self.messages,
        )


def is_disturbance(use: EffectUse) -> bool:
    """Whether an effect is none of the laws that a fit of the states has columns for."""
    return use.name in (*harmonics.PERIODIC_EFFECTS, *SPECTRAL_AND_SENSOR_EFFECTS, *GAIN_AND_DELAY)


def fit_all_effects(model: Model, y: Array, rate_hz: float) -> FullFit:
    """Fit everything in a model to (n, channels) rows, SI, NaN where missing. A tacho channel gives the speed.

    Raises DataError, also where no force is measured and a place does not resonate in the band: nothing is told of its
    stiffness and damping then, and so of what is missing beside them.
    """
    given = with_measured_speed(model, y, rate_hz)
    model, masses = unknown_mass.with_masses_of_shaft(given, y, rate_hz)
    begun = _coarse_fit(model, y, rate_hz)
    off = (
        recorder_fall.find_roll_off(model, begun)
        if begun and all(starmap(resonates, _mean_oscillators(begun).values()))
        else None
    )
    if off and unknown_mass.places_scaled_by_shaft(given):  # what the shaft tells of them is told without the filter
        return fit_all_effects(replace(given, roll_off=off), y, rate_hz)
    if off and begun:
        begun = begun.without_rows()
    whole = _fit_with_stiffness_order(replace(model, roll_off=off) if off else model, y, rate_hz, begun)
    if not begun and not model.roll_off and (off := recorder_fall.find_roll_off(whole.model, whole.point)):
        begun = whole.point.without_rows()
        del whole  # two at once would be much memory
        whole = _fit_with_stiffness_order(replace(model, roll_off=off), y, rate_hz, begun)
    _refuse_without_resonance(whole.point)
    if not model.roll_off and (late := recorder_phase.found(whole.model, whole.point)):
        begun = whole.point.without_rows()
        del whole
        whole = _fit_with_stiffness_order(replace(model, roll_off=late), y, rate_hz, begun)
    if whole.model.roll_off != model.roll_off and unknown_mass.places_scaled_by_shaft(given):
        return fit_all_effects(replace(given, roll_off=whole.model.roll_off), y, rate_hz)
    data = whole.point.data
    S_sd_rel = 0.0 if whole.model.roll_off else recorder_fall.level_doubt(whole.model, whole.point)
    said = (
        *shortening_messages(data, y),
        *unknown_mass.mass_messages(masses),
        *unknown_mass.ratio_messages(whole.model, whole.point),
        *recorder.recorder_messages(whole.model.roll_off, data.places),
        *excitation_level.uneven_message(data.level),
        *unmeasured_end.unmeasured_end_messages(
            whole.model, dict(zip(data.places, whole.point.kL.tolist(), strict=True))
        ),
        *shaft_law.comb_message(data, [use.effect for use in whole.point.placed]),
    )
    return replace(whole, messages=(*said, *whole.messages), masses=masses, S_sd_rel=S_sd_rel)


def _coarse_fit(model: Model, y: Array, rate_hz: float) -> WorkingPoint | None:
    """The model's laws near enough to see a filter, which is undone before they are fitted in earnest. None where the
    model has more than laws of the states, or a filter."""
    if model.roll_off or stiffness_order.ball_pass_uses(model) or any(is_disturbance(u) for u in model.effects):
        return None
    return fit_record(model, prepare(model, y, rate_hz), glance=True)


def _mean_oscillators(point: WorkingPoint) -> dict[str, tuple[float, float, float, tuple[float, float]]]:
    """By place m, c and k of the mean response while the disc stands still, and the band; of places that are judged and
    have no measured force."""
    data = point.data
    k, c = np.einsum("iik->ki", point.mean_tangent) + np.reshape(
        (0.0, 0.0) if data.disc is None else data.disc.held, (2, 1)
    )
    own = () if data.measured_force else data.judged
    return {data.places[i]: (float(data.mass[i]), float(c[i]), float(k[i]), data.band) for i in own}


def _refuse_without_resonance(point: WorkingPoint) -> None:
    """Refuses places that do not resonate in the band."""
    for place, mean in _mean_oscillators(point).items():
        refuse_without_resonance(place, *mean)


def _fit_with_stiffness_order(model: Model, y: Array, rate_hz: float, begun: WorkingPoint | None = None) -> FullFit:
    """The same at the speed that the model gives, the ball-pass order from the record where the model leaves it.
    begun : the same nearly fitted, or before a filter was undone."""
    if not stiffness_order.lacks_stiffness_order(model):
        return _fit_at_given_order(model, y, rate_hz, begun)
    if laws := stiffness_order.ball_pass_uses(model):
        bare = replace(model, effects=tuple(u for u in model.effects if u not in laws))
        model, said = stiffness_order.with_found_order(model, _fit_at_given_order(bare, y, rate_hz).point)
        return replace(
            _fit_at_given_order(stiffness_order.with_start_orders(model) if said else model, y, rate_hz), messages=said
        )
    whole = _fit_at_given_order(model, y, rate_hz, begun)
    model, said = stiffness_order.with_found_order(whole.model, whole.point)
    return replace(whole, model=model, messages=(*whole.messages, *said))


def _fit_at_given_order(model: Model, y: Array, rate_hz: float, begun: WorkingPoint | None = None) -> FullFit:
    """The same at the ball-pass order that the model gives."""
    uses = [u for u in model.effects if is_disturbance(u)]
    if not uses:
        data = replace(begun.data) if begun and not model.roll_off else prepare(model, y, rate_hz)  # seen anew
        return FullFit(model, fit_record(model, data, begun), {})
    limited, (y, off) = y, restored(model, y, clipped_places(model))

    def prepared(model: Model) -> MotionRecord:
        data = prepare(model, y, rate_hz)
        return replace(data, drawn=data.passed_on(off)) if off else data

    undone = [u for u in uses if is_undone_as_given(u, model)]
    bare = replace(model, effects=tuple(u for u in model.effects if u not in uses or u in undone))
    point = fit_record(bare, prepared(bare))
    numbered = {u.name for u in uses if u not in undone or not is_identifiable_by_force(u, model)}
    seen = search(bare, point, y, everywhere=True)
    seen += clipping.find_clipping(bare, limited) if limited is not y else []
    further = further_lines_found(model, seen)
    model, found = with_resolved_parameters(
        with_further_effects(model, further), numbered | further.keys(), seen, point
    )
    point = fit_record(model, prepared(model))
    colours = {u.name for u in uses if u.name in FORCE_SHAPES}
    for _ in range(MIN_RESOLVING_ROUNDS if colours else 0):  # found among laws that they distort
        data = point.data
        flat = replace(point, data=replace(data, colour=colours_of(bare, data.places, data.f_hz, FORCE_SHAPES)))
        renewed, again = with_resolved_parameters(model, colours, spectral_shape.find_spectral_shapes(bare, flat), flat)
        if not parameters_have_moved(found, again):
            break
        model, found = renewed, found | again
        point = fit_record(model, prepared(model))
    for done in range(
        MAX_RESOLVING_ROUNDS if any(u.name in (*harmonics.PERIODIC_EFFECTS, *RESPONSE_EFFECTS) for u in uses) else 0
    ):
        model, bent = transfer_bias.refine_sensor_faults(model, point)
        model, mutual = coupled_caps.refined(model, point)
        model, stepped = harmonic_fit.settle_harmonics(model, point)
        stepped |= bent | mutual
        last = done + 1 >= MIN_RESOLVING_ROUNDS and not parameters_have_moved(
            found, mutual
        )  # a late cap far from its number is not linear
        found |= stepped
        if stepped:
            point = fit_record(model, prepared(model))
        if last:
            break
    told = [
        Message("clipped_restored", f"{place}: {RESTORED}", place)
        if error < np.inf else Message("clipped_lost", f"{place}: {LOST}", place)
        for place, error in sorted(off.items())
    ]  # fmt: skip
    told += [
        Message("clipped_neighbour", f"{place}: no value is reliable: {SPOILED}", place)
        for place in sorted(point.data.lost.difference(off))
    ]
    messages = (*_several_lines_message(model, further), *told)
    return FullFit(model, point, found | _coloured_levels(model, found, point), messages)


def _several_lines_message(
    model: Model, further: Mapping[str, Mapping[str, Mapping[str, Setting]]]
) -> tuple[Message, ...]:
    """What to tell the user of a line that is several."""
    names = [u.name for u in model.effects if u.name in further]
    text = f"the effect line stands for several lines ({', '.join(['line', *names])}): fit --out writes each of them"
    return (Message("several_lines", text),) if names else ()


def _coloured_levels(model: Model, found: Mapping[str, Parameter], point: WorkingPoint) -> dict[str, Parameter]:
    """S of the places whose excitation has a colour that was found."""
    out = {}
    for i, place in enumerate(point.data.places):
        gain, corner = (found.get(f"{place}.coloured_excitation.{n}") for n in ("gain", "corner"))
        if gain and corner and gain.value is not None and corner.value is not None and (gain.sd or corner.sd):
            out[f"{place}.S"] = spectral_models.coloured_force_level(point, i, gain.value, corner.value)
    return out
