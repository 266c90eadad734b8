"""Excitation that is not white."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.model.effect import Effect, searched


def shape(f_hz: NDArray[np.float64], p: Sequence[float]) -> NDArray[np.float64]:
    """Multiplier of S at each frequency."""
    return np.asarray(1.0 + p[0] / (1.0 + (np.asarray(f_hz) / p[1]) ** 2), dtype=np.float64)


COLOURED_EXCITATION = Effect(
    name="coloured_excitation",
    kind="excitation",
    parameters=(
        searched("gain", "1", "excess of S at low frequency over that at high frequency", (-0.98, 1000.0, 3.0)),
        searched("corner", "Hz", "frequency at which half of the excess is gone", (0.05, 8.0, 0.7), scale="hz_peak"),
    ),
    equation="S(f) = S (1 + gain / (1 + (f / corner)^2))",
    signature=(
        "the inferred excitation is not flat in frequency and depends on no state; the same slope in all channels "
        "that share a source"
    ),
    confused_with=("sensor_resonance", "pedestal", "sensor_noise"),
    distinguish=(
        "smooth over octaves and in the force, so the shape is seen through the resonance; a pedestal makes a "
        "peak and a dip, noise fills the valleys of the measured spectrum"
    ),
    reference="Bendat and Piersol, Random Data, 4th ed., Wiley 2010 (first-order shaping filter)",
    check="spectrum of the simulated force against the formula",
    on_machine="turbulence, gear mesh or combustion: process forces fall off with frequency; fit it and go on",
    shape=shape,
    found_by="spectrum",
    spectral_factor=shape,
    typical={"gain": (1.0, 4.0)},
)
