"""Noise of a sensor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.model.effect import Effect, searched


def apply(y: NDArray[np.float64], rate_hz: float, p: Sequence[float], rng: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(y + p[0] * rng.standard_normal(len(y)))


SENSOR_NOISE = Effect(
    name="sensor_noise",
    kind="sensor",
    parameters=(
        searched("rms", "m/s^2", "rms of white noise from 0 to half the sampling rate", (0.001, 3.0, 0.1), scale="a"),
    ),
    equation="measured = true + white noise",
    signature=(
        "a floor that fills the valleys of the spectrum of one channel, incoherent with all others; velocity and "
        "displacement drift at low frequency"
    ),
    confused_with=("coloured_excitation", "line"),
    distinguish=(
        "flat in what is measured, not in force: it shows where the rotor is quiet and is gone at the resonance"
    ),
    reference=(
        "Serridge and Licht, Piezoelectric Accelerometers and Vibration Preamplifiers, Bruel and Kjaer 1987 "
        "(noise floor)"
    ),
    check="variance of the channel rises by rms^2, spread evenly over the band",
    on_machine="cable, connector, ground loop, an amplifier range far too large, a dying sensor",
    apply=apply,
    found_by="spectrum",
    in_likelihood=False,
    typical={"rms": (0.03, 0.1)},
)
