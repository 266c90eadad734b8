"""The full fit: all effects of a model fitted to a record, the laws of the states and the disturbances.

Disturbances are periodic forces, spectral shapes of the excitation, common excitation and sensor faults. They are found
in the residual force of the model without them; then the laws are fitted together with them. A value that the rig file
fixes is kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, replace

import numpy as np

from estimator.arrays import Array
from estimator.effects import CATALOGUE, LINE_NAMES
from estimator.effects.excitation.coloured_excitation import COLOURED_EXCITATION
from estimator.errors import NoResonanceError, NotFiniteError
from estimator.identification.machine.line_bands import with_lines_left_out
from estimator.identification.residual import harmonic_fit, measured_path, stiffness_order
from estimator.identification.search import search
from estimator.identification.structure import spectral_models, spectral_shape
from estimator.identification.structure.background_search import find_background
from estimator.likelihood.fitting.fitted_values import Estimate, fitted_parameters
from estimator.likelihood.motion import harmonics, shaft_law
from estimator.likelihood.motion.known_spectra import FORCE_SHAPES, excitation_shapes
from estimator.likelihood.motion.located_law import has_nonlinear_memory
from estimator.likelihood.motion.prepare import prepare, shortening_messages
from estimator.likelihood.path import excitation_level
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.response.modal_response import modal_responses
from estimator.model.rig import EffectUse, Model, Setting
from estimator.results import Message, Parameter, with_unidentifiable_at
from estimator.signals.channel_response import GAIN_AND_DELAY, RESPONSE_EFFECTS
from estimator.signals.shaft_angle import with_measured_speed

from . import unknown_mass, upper_edge
from .disturbance_numbers import (
    further_lines_found,
    is_corrected_as_given,
    is_identifiable_by_force,
    parameters_have_moved,
    with_further_effects,
    with_resolved_parameters,
)
from .grid_start import fit_record
from .line_motion import line_messages, with_judged_lines
from .thresholds import LIMITS
from .unmeasured_end import unmeasured_end_messages

SPECTRAL_AND_SENSOR_EFFECTS = tuple(
    name
    for name, e in CATALOGUE.items()
    if e.found_by in ("spectrum", "coherence", "samples") and e.kind != "memory" and not e.flat_magnitude
)


@dataclass(frozen=True, slots=True)
class FullFit:
    """A model fitted with all of its effects.

    model : the model with the numbers found for its disturbances.
    point : the working point of the fit.
    disturbances : parameters of the disturbances, by full name.
    messages : one line each, for the user.
    masses : cap masses that the rig file leaves out and the shaft gives, kg, by full name.
    """

    model: Model
    point: WorkingPoint
    disturbances: dict[str, Parameter]
    messages: tuple[Message, ...] = ()
    _: KW_ONLY
    masses: dict[str, Parameter] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Every parameter by full name with its standard deviation."""
        return self.with_estimates(None)

    def with_estimates(self, estimates: Mapping[str, Estimate] | None) -> dict[str, Parameter]:
        """Every parameter by full name. estimates : of the fitted ones; None: those of the working point."""
        found = fitted_parameters(self.point, estimates) | self.disturbances
        found = unknown_mass.with_mass_uncertainty(self.model, found, self.masses)
        scaleless = unknown_mass.unscaled_places(self.model, self.masses)
        return with_unidentifiable_at(scaleless, unknown_mass.NO_MASS_REASON, found, "N") | self.masses


def is_disturbance(use: EffectUse) -> bool:
    """Whether an effect is a periodic force, a spectral shape or a sensor fault: no law of the states."""
    return use.name in (*harmonics.PERIODIC_EFFECTS, *SPECTRAL_AND_SENSOR_EFFECTS, *GAIN_AND_DELAY)


def fit_all_effects(model: Model, y: Array, rate_hz: float) -> FullFit:
    """Fit all effects of a model to a record, the laws of the states and the disturbances.

    Parameters
    ----------
    model : Model
        The rig. Values that are None are fitted. The shaft speed of a tacho channel replaces the given one.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``. NaN where a sample is missing or clipped.
    rate_hz : float
        Sampling rate, Hz.

    Returns
    -------
    FullFit
        The model with the disturbances found, and the working point of the fit.

    Raises
    ------
    DataError
        The record is too short, or a place without a measured force does not resonate in the band.
    """
    given = with_lines_left_out(with_measured_speed(model, y, rate_hz), y, rate_hz)
    model, masses = unknown_mass.with_masses_of_shaft(given, y, rate_hz)
    full = _fit_with_stiffness_order(model, y, rate_hz)
    background = find_background(full.model, full.point)
    if background is not None and not background.agrees_with(model.background):
        full = _with_background(full, replace(model, background=background), y, rate_hz)
    model, point = with_judged_lines(full.model, full.point)
    full = replace(full, model=model, point=point)
    refuse_without_resonance(full.point)
    data = full.point.data
    notes = (
        *shortening_messages(data, y),
        *unknown_mass.mass_messages(masses),
        *unknown_mass.ratio_messages(full.model, full.point, masses),
        *upper_edge.upper_edge_messages(full.model, full.point),
        *excitation_level.uneven_message(data.level),
        *_background_messages(full.model),
        *line_messages(full.model, data),
        *unmeasured_end_messages(full.model, dict(zip(data.places, full.point.kL.tolist(), strict=True))),
        *_hysteresis_messages(full.point),
        *_periodic_messages(full.model, full.point),
        *shaft_law.comb_message(data, [use.effect for use in full.point.placed]),
    )
    return replace(full, messages=(*notes, *full.messages), masses=masses)


def _with_background(full: FullFit, model: Model, y: Array, rate_hz: float) -> FullFit:
    """The fit of a model with a background; the fit without it where the fit with it does not converge."""
    try:
        return _fit_with_stiffness_order(model, y, rate_hz)
    except (np.linalg.LinAlgError, NotFiniteError):
        return full


def _background_messages(model: Model) -> tuple[Message, ...]:
    """Remarks on structural modes and on the spectrum of the force, both part of the fit."""
    at = {} if model.background is None else model.background.at
    modes = {place: ", ".join(f"{m.frequency_hz:.0f}" for m in own.modes) for place, own in at.items() if own.modes}
    swing = {place: 10.0 * float(np.log10(own.psd_rel.max() / own.psd_rel.min())) for place, own in at.items()}
    uneven = {place: db for place, db in swing.items() if db > LIMITS.min_reported_swing_db}
    out = []
    if modes:
        listed = "; ".join(f"{place} {hz} Hz" for place, hz in modes.items())
        out.append(Message("structural_modes", f"structural modes beside the bearings are part of the fit: {listed}"))
    if uneven:
        listed = ", ".join(f"{place} by {db:.0f} dB" for place, db in uneven.items())
        text = f"the spectrum of the force is part of the fit and varies along the band: {listed}"
        out.append(Message("force_spectrum", text))
    return tuple(out)


def _hysteresis_messages(point: WorkingPoint) -> tuple[Message, ...]:
    """A message for each place where a law that remembers acts beside one whose tangent fluctuates much."""
    out = []
    for i, place in enumerate(point.data.places):
        own = [u.effect.name for u in point.placed if i in u.at and has_nonlinear_memory(u, point.lin[i])]
        here = point.fluctuations[i]
        if own and here is not None and here.total[0].std() > LIMITS.max_tangent_sd_rel * point.kL[i]:
            text = f"{place}: {own[0]} beside a strongly nonlinear law: its numbers may be off by some per cent"
            out.append(Message("hysteresis_uncorrected", text, place))
    return tuple(out)


def _periodic_messages(model: Model, point: WorkingPoint) -> tuple[Message, ...]:
    """Messages on periodic forces that the fit leaves out: a changing speed, and motion below the band."""
    data, own = point.data, harmonics.periodic_effects(model)
    rows = np.linspace(0, data.phase.size - 1, LIMITS.speed_pieces + 1).astype(int)
    speed = np.diff(data.phase[rows]) / np.diff(data.t[rows])
    change = float(np.ptp(speed) / max(np.abs(speed).max(), 1e-12))
    out = []
    if change > LIMITS.max_speed_change_rel and any(one.effect.turns for one in own):
        text = f"the speed changes by {100 * change:.0f} %: forces that turn with the shaft are those at the mean speed"
        out.append(Message("speed_changes", f"{text}; take a part at constant speed (--from, --to)"))
    below = sorted({one.hz for one in own if one.hz < data.band[0]})
    if below and point.placed:
        text = f"laws do not see the motion by the periodic force at {below[0]:.1f} Hz: it lies below the band"
        out.append(Message("line_below_band", text))
    return tuple(out)


def stiffness_and_damping_held(point: WorkingPoint) -> tuple[Array, Array]:
    """(places,) N/m and N s/m of the mean response of each cap with the disc held.

    Of a given rotor: of an oscillator of the cap's mass with the mode that has most of its strain in the bearing.
    """
    data = point.data
    if data.rotor is not None and data.disc is None:
        responses = modal_responses(data.mass, point.mean_tangent, data.rotor)
        main = [r.poles[np.argmax(np.abs(r.residues / r.poles))] for r in responses]
        return data.mass * np.abs(main) ** 2, -2.0 * data.mass * np.real(main)
    held = (0.0, 0.0) if data.rotor is None else data.rotor.held
    k, c = np.einsum("iik->ki", point.mean_tangent) + np.reshape(held, (2, 1))
    return k, c


def refuse_without_resonance(point: WorkingPoint) -> None:
    """Raise NoResonanceError if a place without a measured force does not resonate in the band."""
    data, (low, high) = point.data, point.data.band
    k, c = stiffness_and_damping_held(point)
    f0 = np.sqrt(np.maximum(k, 0.0) / data.mass) / (2 * np.pi)
    resonates = (1.02 * low < f0) & (f0 < 0.98 * high) & (c <= 1.8 * np.sqrt(np.maximum(k, 0.0) * data.mass))
    for i in () if data.measured_force else np.flatnonzero(~resonates):
        raise NoResonanceError(
            f"the fit finds no resonance of {data.places[i]} inside the band {low:g}-{high:g} Hz: choose a band around "
            "the resonance of the bearing alone, and check that the channel is the bearing's",
            data.places[i],
        )


def _fit_with_stiffness_order(model: Model, y: Array, rate_hz: float) -> FullFit:
    """A full fit at a known shaft speed; a ball-pass order that the model leaves open is found in the record."""
    if not stiffness_order.lacks_stiffness_order(model):
        return _fit_at_given_order(model, y, rate_hz)
    if laws := stiffness_order.ball_pass_uses(model):
        bare = replace(model, effects=tuple(u for u in model.effects if u not in laws))
        model, notes = stiffness_order.with_found_order(model, _fit_at_given_order(bare, y, rate_hz).point)
        return replace(
            _fit_at_given_order(stiffness_order.with_start_orders(model) if notes else model, y, rate_hz),
            messages=notes,
        )
    full = _fit_at_given_order(model, y, rate_hz)
    model, notes = stiffness_order.with_found_order(full.model, full.point)
    return replace(full, model=model, messages=(*full.messages, *notes))


def _fit_at_given_order(model: Model, y: Array, rate_hz: float) -> FullFit:
    """A full fit at the ball-pass order of the model."""
    uses = [u for u in model.effects if is_disturbance(u)]
    if not uses:
        return FullFit(model, fit_record(model, prepare(model, y, rate_hz)), disturbances={})
    corrected_uses = [u for u in uses if is_corrected_as_given(u, model)]
    bare = replace(model, effects=tuple(u for u in model.effects if u not in uses or u in corrected_uses))
    point = fit_record(bare, prepare(bare, y, rate_hz))
    resolved_names = {u.name for u in uses if u not in corrected_uses or not is_identifiable_by_force(u, model)}
    findings = search(bare, point, y)
    further = further_lines_found(model, findings)
    model, found = with_resolved_parameters(
        with_further_effects(model, further), resolved_names | further.keys(), findings, point
    )
    point = fit_record(model, prepare(model, y, rate_hz))
    shape_names = {u.name for u in uses if u.name in FORCE_SHAPES}
    for _ in range(LIMITS.resolving_rounds if shape_names else 0):  # shapes and laws distort each other
        shape = excitation_shapes(bare, point.data.places, point.data.f_hz)
        flat = replace(point, data=replace(point.data, excitation_shape=shape))
        renewed, found_again = with_resolved_parameters(
            model, shape_names, spectral_shape.find_spectral_shapes(bare, flat), flat
        )
        if not parameters_have_moved(found, found_again):
            break
        model, found = renewed, found | found_again
        point = fit_record(model, prepare(model, y, rate_hz))
    refines = any(u.name in (*harmonics.PERIODIC_EFFECTS, *RESPONSE_EFFECTS) for u in uses)
    for _ in range(LIMITS.resolving_rounds if refines else 0):
        model, of_path = measured_path.refine_sensor_faults(model, point)
        model, refined_now = harmonic_fit.settle_harmonics(model, point)
        refined_now |= of_path
        found |= refined_now
        if refined_now:
            point = fit_record(model, prepare(model, y, rate_hz))
    messages = _several_lines_message(model, further)
    return FullFit(model, point, found | _coloured_levels(model, found, point), messages)


def _several_lines_message(
    model: Model, further: Mapping[str, Mapping[str, Mapping[str, Setting]]]
) -> tuple[Message, ...]:
    """A message if several lines were found where the model has one of unknown frequency."""
    names = [u.name for u in model.effects if u.name in further]
    every = ", ".join([LINE_NAMES[0], *names])
    text = f"the effect line stands for several lines ({every}): fit --out writes each of them"
    return (Message("several_lines", text),) if names else ()


def _coloured_levels(model: Model, found: Mapping[str, Parameter], point: WorkingPoint) -> dict[str, Parameter]:
    """S of the places whose coloured excitation was found, by full name."""
    out = {}
    for i, place in enumerate(point.data.places):
        gain, corner = (found.get(f"{place}.{COLOURED_EXCITATION.name}.{n}") for n in ("gain", "corner"))
        if gain and corner and gain.value is not None and corner.value is not None and (gain.sd or corner.sd):
            out[f"{place}.S"] = spectral_models.coloured_force_level(point, i, gain.value, corner.value)
    return out
