"""What a faulty sensor makes of the motion, as a response: measured over true, by frequency.

They are undone in the record before anything is fitted. Beside a measured force they can be told (transfer_faults.py).
Without one, a gain and a delay are undone as far as the rig file gives them; a resonance is a shape of the spectrum of
the force, and undone by the numbers that this shows: with its phase left in, what is answered through
a stiff shaft is not the rotor's (a shaft half as stiff as the bearings, a resonance at four times theirs: c 9 % off).
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
    """(f,) of all that is undone in the motion channel at a place: faults of the model and, as far as the band goes,
    the recorder's filter."""
    out = _faults(model, place, w)
    own = anti_alias_filter(model, place)
    return out if own is None else out * own.response(np.minimum(w / (2 * np.pi), model.band[1]))


def anti_alias_filter(model: Model, place: str) -> Filter | None:
    """The recorder's filter that is undone at a place, in the channel of a measured force, too, which went through it:
    the path between the two is as it was, and laws have the motion as it is."""
    return (model.roll_off or {}).get(place)


def folded_images(model: Model, place: str, kind: str, f_hz: Array) -> Array:
    """(images, f) PSD of the acceleration that the recorder at a place folds back from each image, over that of a free
    mass, once the responses are undone: the sensor had its own at the image."""
    own = anti_alias_filter(model, place)
    if own is None or own.nepers:
        return np.zeros((0, f_hz.size))
    heard = np.abs(_faults(model, place, 2 * np.pi * images(own.rate_hz, f_hz))) ** 2
    return np.asarray(own.echoes(f_hz, kind) * heard / np.abs(channel_response(model, place, 2 * np.pi * f_hz)) ** 2)


def passed_of_images(model: Model, place: str, rate_hz: float, f_hz: Array) -> Complexes:
    """(2, f) what the sensor at a place lets through of the acceleration that is folded to f from below and from beyond
    the rate, the first backwards, once its response is undone: -w / w' and w / w'' of a sensor of velocity."""
    kind = next(c.kind for c in model.channels if c.place == place and c.kind in MOTION)

    def through(f_hz: Array) -> Complexes:
        w = 2 * np.pi * f_hz
        return _faults(model, place, w) / to_acceleration([kind], w)[:, 0]

    below, beyond = (through(rate_hz + side * f_hz) for side in (-1, 1))
    return np.asarray(np.stack([below.conj(), beyond]) / through(f_hz))


def fitted_shape(model: Model, place: str, effect: str) -> tuple[float, float] | None:
    """Numbers of a shape of the spectrum at a place, an effect of SHAPES, as the model has it."""
    numbers = [_numbers(use, model, place) for use in model.effects if use.name == effect]
    a, b = (numbers[0].get(name) if numbers else None for name in SHAPE_PARAMETERS[effect])
    return (a, b) if a and b else None


def _faults(model: Model, place: str, w: Array) -> Complexes:
    """Of the sensor, of the shape of w."""
    out = np.ones(w.shape, complex)
    for use in model.effects:
        if use.name not in RESPONSE_EFFECTS:
            continue
        out *= fault_response(use.name, _numbers(use, model, place), w)
    return out


def _numbers(use: EffectUse, model: Model, place: str) -> dict[str, float | None]:
    """What a use says of the motion channel at a place; nothing if it is of another."""
    channels = {c.name for c in model.channels if c.place == place and c.kind in MOTION}
    own = [s for key, s in use.parameters.items() if key in (place, place.split(".")[0]) or key in channels]
    return {name: setting.value for name, setting in own[0].items()} if own else {}


def corrected_record(model: Model, y: Array, rate_hz: float) -> Array:
    """The record (n, channels), SI, with the responses of its sensors that the model knows of taken back."""
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
