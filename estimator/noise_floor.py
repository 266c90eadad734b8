"""A sensor whose noise stands out of its neighbours'."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .estimate import Parameter
from .model import MOTION, Model
from .suspect import Suspect
from .working_point import WorkingPoint

Array = NDArray[np.float64]
FOLDED = 0.01  # of what sampling folds back, that noise of a sensor has to be NOISE_RATIO times as strong as
NOISE_RATIO = 6.0  # in power, of one sensor's noise over its neighbours', to call it faulty


def noisy(model: Model, point: WorkingPoint, noise: Array) -> list[Suspect]:
    """A sensor whose noise floor stands out of its neighbours' of the same kind: others have another unit."""
    data = point.data
    out, heard = [], data.heard(point.A)
    have = {place for u in model.effects if u.name == "sensor_noise" for place in u.parameters}
    for i, place in enumerate(data.places):
        alike = [k for k, kind in enumerate(data.kinds) if k != i and kind == data.kinds[i] and data.driven[k] == 0.0]
        others = noise[alike]
        if others.size == 0 or place in have:
            continue
        # noise counts where it is loudest: that of an accelerometer low in the band, that of displacement at its top
        white = data.noise_shape[i]
        folded = point.S[i] * float(np.sum(data.folded[i]) / np.sum(white))
        floor = max(float(np.median(others)), 0.2 * point.S[i] / float(heard[i].max()), FOLDED * folded)
        if noise[i] < NOISE_RATIO * floor:
            continue
        rms = float(np.sqrt(noise[i] * data.rate_hz / 2))
        gain = 0.5 * data.blocks * float(np.sum(np.log1p(noise[i] * heard[i] / point.S[i]) ** 2) / 2)
        sd = rms / np.sqrt(2 * max(gain, 1.0))
        name, unit = next(c.name for c in model.channels if c.place == place), MOTION[data.kinds[i]]
        out.append(
            Suspect(
                "sensor_noise", (place,), gain, 1, float(np.exp(-min(gain, 700.0))),
                {i: float(noise[i] * np.mean(heard[i]) * (data.band[1] - data.band[0]))}, "frequency",
                f"noise floor of {name}: {rms:.2g} {unit} rms, {np.sqrt(noise[i] / floor):.1f} times its neighbours'",
                {place: {"rms": Parameter(rms, float(sd), unit)}},
            )
        )  # fmt: skip
    return out


def sensor_noise(point: WorkingPoint, i: int) -> Parameter:
    """rms over the whole band of the noise of a place's sensor, if it is white."""
    data = point.data
    density = point.nu[i] * point.S[i]
    floor = density * data.heard(point.A)[i]
    share = floor / (point.S[i] * data.colour[i] + floor)
    sd = 1.0 / np.sqrt(max(data.blocks * float(np.sum(share**2)), 1e-300))  # of ln(density), by the Whittle likelihood
    rms = float(np.sqrt(density * data.rate_hz / 2))
    return Parameter.judged(rms, 0.5 * rms * sd, MOTION[data.kinds[i]])
