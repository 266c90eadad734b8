"""Gain error of a sensor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.model.effect import Effect, searched


def apply(y: NDArray[np.float64], rate_hz: float, p: Sequence[float], rng: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(y * (1.0 + p[0]))


def channel_response(w: NDArray[np.float64], p: Sequence[float]) -> NDArray[np.complex128]:
    return np.full(w.shape, 1.0 + p[0], complex)


SENSOR_GAIN = Effect(
    name="sensor_gain",
    kind="sensor",
    parameters=(searched("error", "1", "relative error; -2 is an inverted channel", (-3.0, 9.0, 0.1)),),
    equation="measured = (1 + error) true",
    signature=(
        "one channel is too large or too small at all frequencies by the same factor; equal bearings look "
        "unequal, S of that channel off by its square; inverted: phase turned by half a turn"
    ),
    confused_with=("correlated_force", "anisotropy"),
    distinguish=(
        "frequencies, damping and shape of the spectrum are right; only a scale is wrong, and forces through the "
        "shaft no longer balance"
    ),
    reference="ISO 16063-21, calibration by comparison with a reference transducer",
    check="rms of the channel changes by 1 + error exactly",
    on_machine=(
        "sensitivity typed wrongly, loose mounting, a swapped or inverted cable: shake it with a calibrator; it is "
        "found beside a measured force only, and undone where the rig file gives it"
    ),
    apply=apply,
    found_by="spectrum",
    channel_response=channel_response,
    typical={"error": (0.05, 0.2)},
)
