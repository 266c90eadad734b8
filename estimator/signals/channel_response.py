"""Responses of sensors, measured over true by frequency, and their correction.

The responses that the model knows are undone in the record before anything is fitted. A gain and a delay are
identifiable together with a measured force only; otherwise they are undone as the rig file gives them. A sensor
resonance is found as a spectral shape of the excitation and undone with its phase, as the phase matters on a stiff
shaft. The recorder's filter is undone by the band limit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.effects import CATALOGUE
from estimator.model.rig import MOTION_UNITS, EffectUse, Model
from estimator.parallel import map_threads

# sensor faults that are a linear response
RESPONSE_EFFECTS = tuple(name for name, e in CATALOGUE.items() if e.channel_response is not None)
# identifiable beside a measured force only
GAIN_AND_DELAY = tuple(n for n in RESPONSE_EFFECTS if CATALOGUE[n].flat_magnitude)
SHAPE_PARAMETERS = {
    name: tuple(q.name for q in e.parameters) for name, e in CATALOGUE.items() if e.spectral_factor is not None
}


def measured_force_places(model: Model) -> frozenset[str]:
    """Places whose force is measured."""
    return frozenset(c.place for c in model.channels if c.kind == "force")


def fault_response(name: str, values: Mapping[str, float | None], w: Array) -> Complexes:
    """(f,) response of one fault, measured over true, at w (f,) rad/s; 1 where a number is not known or 0."""
    effect = CATALOGUE[name]
    p = [values.get(q.name) for q in effect.parameters]
    if effect.channel_response is None or not all(p):
        return np.ones(w.shape, complex)
    return np.asarray(effect.channel_response(w, p))


def anti_alias_response(model: Model, rate_hz: float) -> Callable[[Array], Complexes] | None:
    """The response (f,) at f (f,) Hz of the recorder's filter that the rig file gives; None without one.

    Beyond the upper band edge the response is that at the edge, as nothing is known there.
    """
    anti_alias = model.anti_alias
    return None if anti_alias is None else lambda f_hz: anti_alias.response(np.minimum(f_hz, model.band[1]), rate_hz)


def fitted_shape(model: Model, place: str, effect: str) -> tuple[float, float] | None:
    """Parameters of a spectral shape at a place in the model; None without. effect : of SHAPE_PARAMETERS."""
    numbers = [_numbers(use, model, place) for use in model.effects if use.name == effect]
    a, b = (numbers[0].get(name) if numbers else None for name in SHAPE_PARAMETERS[effect])
    return (a, b) if a and b else None


def channel_response(model: Model, place: str, w: Array) -> Complexes:
    """(f,) response that is undone in the motion channel at a place, at w (f,) rad/s: its sensor's faults."""
    out = np.ones(w.shape, complex)
    for use in model.effects:
        if use.name in RESPONSE_EFFECTS:
            out *= fault_response(use.name, _numbers(use, model, place), w)
    return out


def _numbers(use: EffectUse, model: Model, place: str) -> dict[str, float | None]:
    """Values of an effect's use for the motion channel at a place; empty if it is for another place."""
    channels = {c.name for c in model.channels if c.place == place and c.kind in MOTION_UNITS}
    settings = [s for key, s in use.parameters.items() if key in (place, place.split(".")[0]) or key in channels]
    return {name: setting.value for name, setting in settings[0].items()} if settings else {}


def corrected_record(model: Model, y: Array, rate_hz: float) -> Array:
    """The record (n, channels), SI, with the sensor faults that the model knows undone."""
    faulty = [k for k, c in enumerate(model.channels) if c.kind in MOTION_UNITS and _has_fault(model, c.place)]
    if not faulty:
        return y
    w: Array = 2 * np.pi * np.asarray(np.fft.rfftfreq(len(y), 1 / rate_hz), dtype=np.float64)

    def column(k: int) -> Array:
        H, z = channel_response(model, model.channels[k].place, w), y[:, k]
        if np.ptp(H) == 0.0:
            return np.asarray(z / float(H[0].real))
        gap = np.isnan(z)
        return np.where(gap, np.nan, np.fft.irfft(np.fft.rfft(np.where(gap, 0.0, z)) / H, len(z)))

    out = y.copy()
    for k, z in zip(faulty, map_threads(column, faulty), strict=True):
        out[:, k] = z
    return out


def _has_fault(model: Model, place: str) -> bool:
    """Whether the model has a sensor fault of known size at a place."""
    uses = [use for use in model.effects if use.name in RESPONSE_EFFECTS]
    return any(all(own.values()) for use in uses if (own := _numbers(use, model, place)))
