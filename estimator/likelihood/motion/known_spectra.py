"""Spectra that the model gives before a fit: shaft, excitation shape, noise of corrected channels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.effects import CATALOGUE
from estimator.likelihood.thresholds import LIMITS
from estimator.model.rig import Model, Setting
from estimator.model.rotor import rotor_matrices
from estimator.signals.channel_response import channel_response, measured_force_places

from .force_balance import shaft_notches

# effects that shape the spectrum of the force
FORCE_SHAPES = tuple(name for name, e in CATALOGUE.items() if e.spectral_factor is not None and e.kind == "excitation")


def shaft_response(model: Model, places: tuple[str, ...], f_hz: Array) -> NDArray[np.complex128]:
    """(f, places, places) N/m, dynamic stiffness of shaft and disc at the measured bearing caps."""
    matrices = rotor_matrices(model)
    rotor = None if matrices is None else matrices.at(places)
    if rotor is None:
        return np.zeros((f_hz.size, len(places), len(places)), complex)
    return rotor.dynamic(2 * np.pi * f_hz)


def fitted_bins(model: Model, rate_hz: float, block: int) -> NDArray[np.int64]:
    """Indices of the bins of a block spectrum that are fitted: the band without lines and sharp modes of the shaft."""
    f = np.fft.rfftfreq(block, 1 / rate_hz)
    lobe = LIMITS.line_lobe_bins * rate_hz / block
    inside = (f >= model.band[0]) & (f <= model.band[1])
    for low, high in shaft_notches(model):
        inside &= (f < low) | (f > high)
    for line in model.line_bands:
        inside &= (f < line.low_hz - lobe) | (f > line.high_hz + lobe)
    return np.flatnonzero(inside)


def undone_noise_gain(model: Model, places: tuple[str, ...], f_hz: Array) -> Array:
    """(places, f) power gain of undoing the faults of the sensors."""
    return np.array([1.0 / np.abs(channel_response(model, p, 2 * np.pi * f_hz)) ** 2 for p in places])


def excitation_shapes(model: Model, places: tuple[str, ...], f_hz: Array) -> Array:
    """(places, f) spectral shape of the excitation by the effects of the model; 1 where a force is measured."""
    known = measured_force_places(model)
    out = np.ones((len(places), f_hz.size))
    for use in model.effects:
        factor = CATALOGUE[use.name].spectral_factor if use.name in FORCE_SHAPES else None
        if factor is None:
            continue
        for i, place in enumerate(places):
            if place in known:  # a measured force has the colour that it has, and its sensor is undone
                continue
            own = [s for k, s in use.parameters.items() if k in (place, place.split(".")[0])]
            if not own:
                continue
            p = [own[0].get(q.name, Setting()).value for q in CATALOGUE[use.name].parameters]
            if None in p:
                continue
            out[i] *= factor(f_hz, p)
    return out
