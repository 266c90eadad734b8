"""What a faulty sensor makes of the motion, as a response: measured over true, by frequency.

Beside a measured force these faults can be told (bent_path.py) and are undone in the record before anything is fitted.
Without one, a gain and a delay are undone as far as the rig file gives them, and a resonance is a shape of the force.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from .model import MOTION, Model

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
BLIND = ("sensor_gain", "sensor_skew")  # caps that are not coupled say nothing of them: diagnosis.md
LINEAR = (*BLIND, "sensor_resonance")  # faults that are a response


def forced(model: Model) -> frozenset[str]:
    """Places whose force is measured."""
    return frozenset(c.place for c in model.channels if c.kind == "force")


def response(name: str, values: Mapping[str, float | None], w: Array) -> Complexes:
    """(f,) of one fault at w (f,) rad/s; 1 where a number is not known."""
    if name == "sensor_gain":
        return np.full(w.size, 1.0 + (values.get("error") or 0.0), complex)
    if name == "sensor_skew":
        return np.asarray(np.exp(-1j * w * (values.get("delay") or 0.0)))
    f0, quality = values.get("frequency"), values.get("quality")
    if not f0 or not quality:
        return np.ones(w.size, complex)
    r = w / (2 * np.pi * f0)
    return np.asarray(1.0 / (1.0 - r**2 + 1j * r / quality))


def of_place(model: Model, place: str, w: Array) -> Complexes:
    """(f,) of all that is undone in the motion channel at a place: faults of the model and, as far as the band goes,
    the recorder's filter."""
    out = np.ones(w.size, complex)
    if model.roll_off and place in model.roll_off and place not in forced(model):
        out = model.roll_off[place].response(np.minimum(w / (2 * np.pi), model.band[1]))
    for use in model.effects:
        if use.name not in (LINEAR if place in forced(model) else BLIND):
            continue
        channels = {c.name for c in model.channels if c.place == place and c.kind in MOTION}
        own = [s for key, s in use.parameters.items() if key in (place, place.split(".")[0]) or key in channels]
        if own:
            out *= response(use.name, {n: s.value for n, s in own[0].items()}, w)
    return out


def undone(model: Model, y: Array, rate_hz: float) -> Array:
    """The record (n, channels), SI, with the responses of its sensors that the model knows of taken back."""
    out = y
    if not model.roll_off and not any(use.name in LINEAR for use in model.effects):
        return out
    for k, channel in enumerate(model.channels):
        if channel.kind not in MOTION:
            continue
        f: Array = np.asarray(np.fft.rfftfreq(len(y), 1 / rate_hz), dtype=np.float64)
        H = of_place(model, channel.place, 2 * np.pi * f)
        if np.ptp(H) == 0.0:
            factor = float(H[0].real)
            if factor != 1.0:
                out = y.copy() if out is y else out
                out[:, k] /= factor
            continue
        out = y.copy() if out is y else out
        gap = np.isnan(out[:, k])
        moved = np.fft.irfft(np.fft.rfft(np.nan_to_num(out[:, k])) / H, len(out))
        out[:, k] = np.where(gap, np.nan, moved)
    return out
