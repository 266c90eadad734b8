"""Responses of sensors and of the recorder's filter, measured over true by frequency, and their correction.

The responses that the model knows are undone in the record before anything is fitted. A gain and a delay are
identifiable together with a measured force only; otherwise they are undone as the rig file gives them. A sensor
resonance is found as a spectral shape of the excitation and undone with its phase, as the phase matters on a stiff
shaft.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.effects import CATALOGUE
from estimator.model.recorder import Filter, images
from estimator.model.rig import MOTION, EffectUse, Model
from estimator.parallel import map_threads

from .band_limit import to_acceleration

# sensor faults that are a linear response
RESPONSE_EFFECTS = tuple(name for name, e in CATALOGUE.items() if e.channel_response is not None)
# identifiable beside a measured force or on coupled bearing caps only
GAIN_AND_DELAY = tuple(n for n in RESPONSE_EFFECTS if CATALOGUE[n].flat_magnitude)
SHAPE_PARAMETERS = {
    name: tuple(q.name for q in e.parameters) for name, e in CATALOGUE.items() if e.spectral_factor is not None
}
FILTER_GRID_POINTS = 8192  # of a filter's response, linear between: error 1e-6


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


def channel_response(model: Model, place: str, w: Array) -> Complexes:
    """(f,) response that is undone in the motion channel at a place, at w (f,) rad/s.

    It has the sensor faults of the model and, up to the upper band edge, the recorder's filter.
    """
    out = _faults(model, place, w)
    own = anti_alias_filter(model, place)
    return out if own is None else out * own.response(np.minimum(w / (2 * np.pi), model.band[1]))


def anti_alias_filter(model: Model, place: str) -> Filter | None:
    """The recorder's filter that is undone at a place, in the channels of motion and of force; None without."""
    return (model.roll_off or {}).get(place)


def folded_images(model: Model, place: str, kind: str, f_hz: Array) -> Array:
    """(images, f) PSD of the acceleration aliased from each image at a place, over that of a free mass, corrected."""
    own = anti_alias_filter(model, place)
    if own is None or own.nepers:
        return np.zeros((0, f_hz.size))
    heard = np.abs(_faults(model, place, 2 * np.pi * images(own.rate_hz, f_hz))) ** 2
    return np.asarray(own.echoes(f_hz, kind) * heard / np.abs(channel_response(model, place, 2 * np.pi * f_hz)) ** 2)


def passed_of_images(model: Model, place: str, rate_hz: float, f_hz: Array) -> Complexes:
    """(2, f) response of the corrected sensor to acceleration aliased to f from below and from beyond the rate.

    The first is conjugate, as its frequency axis is reversed; a velocity sensor has -w / w' and w / w''.
    """
    kind = next(c.kind for c in model.channels if c.place == place and c.kind in MOTION)

    def through(f_hz: Array) -> Complexes:
        w = 2 * np.pi * f_hz
        return _faults(model, place, w) / to_acceleration([kind], w)[:, 0]

    below, beyond = (through(rate_hz + side * f_hz) for side in (-1, 1))
    return np.asarray(np.stack([below.conj(), beyond]) / through(f_hz))


def fitted_shape(model: Model, place: str, effect: str) -> tuple[float, float] | None:
    """Parameters of a spectral shape at a place in the model; None without. effect : of SHAPE_PARAMETERS."""
    numbers = [_numbers(use, model, place) for use in model.effects if use.name == effect]
    a, b = (numbers[0].get(name) if numbers else None for name in SHAPE_PARAMETERS[effect])
    return (a, b) if a and b else None


def _faults(model: Model, place: str, w: Array) -> Complexes:
    """(f,) response of the sensor faults at a place, at w (f,) rad/s."""
    out = np.ones(w.shape, complex)
    for use in model.effects:
        if use.name not in RESPONSE_EFFECTS:
            continue
        out *= fault_response(use.name, _numbers(use, model, place), w)
    return out


def _numbers(use: EffectUse, model: Model, place: str) -> dict[str, float | None]:
    """Values of an effect's use for the motion channel at a place; empty if it is for another place."""
    channels = {c.name for c in model.channels if c.place == place and c.kind in MOTION}
    own = [s for key, s in use.parameters.items() if key in (place, place.split(".")[0]) or key in channels]
    return {name: setting.value for name, setting in own[0].items()} if own else {}


def corrected_record(model: Model, y: Array, rate_hz: float) -> Array:
    """The record (n, channels), SI, with the channel responses that the model knows undone."""
    if not model.roll_off and not any(use.name in RESPONSE_EFFECTS for use in model.effects):
        return y
    f: Array = np.asarray(np.fft.rfftfreq(len(y), 1 / rate_hz), dtype=np.float64)
    heard = [k for k, channel in enumerate(model.channels) if channel.kind in (*MOTION, "force")]
    filters = {own for k in heard if (own := anti_alias_filter(model, model.channels[k].place)) is not None}
    grid = np.linspace(0.0, model.band[1], FILTER_GRID_POINTS)
    known = {own: np.interp(f, grid, own.response(grid)) for own in filters}

    def column(k: int) -> Array:
        place, z = model.channels[k].place, y[:, k]
        faulty = model.channels[k].kind in MOTION
        H = _faults(model, place, 2 * np.pi * f) if faulty else np.ones(f.size, complex)
        if (own := anti_alias_filter(model, place)) is not None:
            H *= known[own]
        if np.ptp(H) == 0.0:
            return np.asarray(z / float(H[0].real))
        gap = np.isnan(z)
        return np.where(gap, np.nan, np.fft.irfft(np.fft.rfft(np.where(gap, 0.0, z)) / H, len(z)))

    out = y.copy()
    for k, z in zip(heard, map_threads(column, heard), strict=True):
        out[:, k] = z
    return out
