"""Sensors whose noise exceeds that of their neighbours, from the residual force."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from estimator.arrays import Array
from estimator.effects.sensor.sensor_noise import SENSOR_NOISE
from estimator.identification.finding import Finding
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import MOTION_UNITS, Model
from estimator.results import Parameter
from estimator.signals.channel_response import SHAPE_PARAMETERS, fitted_shape

NOISE_RATIO = 6.0  # power of a faulty sensor's noise over that of its neighbours


def find_noisy_sensors(model: Model, point: WorkingPoint, noise: Array, shaped: Collection[int]) -> list[Finding]:
    """Sensors whose noise exceeds that of other sensors of the same kind.

    noise : (places,) PSD of the sensors' noise in their own unit. shaped : locations whose spectrum differs from that
    of white force and white noise: their noise is not known. A location whose spectral shape the model has is no
    reference for others, as the two numbers of the shape take up the noise.
    """
    data = point.data
    out, heard = [], data.noise_referred_to_force(point.A)
    have = {place for u in model.effects if u.name == SENSOR_NOISE.name for place in u.parameters}
    known = [k for k in range(len(data.places)) if k not in shaped]
    plain = [k for k in known if not any(fitted_shape(model, data.places[k], name) for name in SHAPE_PARAMETERS)]
    for i in known:
        place, kind = data.places[i], data.kinds[i]
        others = noise[[k for k in plain if k != i and data.kinds[k] == kind]]
        if others.size == 0 or place in have:
            continue
        # noise counts where it is loudest: that of an accelerometer low in the band, that of displacement at its top
        floor = max(float(np.median(others)), 0.2 * point.S[i] / float(heard[i].max()))
        if noise[i] < NOISE_RATIO * floor:
            continue
        rms = float(np.sqrt(noise[i] * data.rate_hz / 2))
        gain = 0.5 * data.blocks * float(np.sum(np.log1p(noise[i] * heard[i] / point.S[i]) ** 2) / 2)
        sd, ratio = rms / np.sqrt(2 * max(gain, 1.0)), np.sqrt(noise[i] / floor)
        name, unit = next(c.name for c in model.channels if c.place == place), MOTION_UNITS[data.kinds[i]]
        out.append(
            Finding(
                effect=SENSOR_NOISE.name,
                at=(place,),
                gain_nats=gain,
                dof=1,
                p_value=float(np.exp(-min(gain, 700.0))),
                power_N2={i: float(noise[i] * np.mean(heard[i]) * (data.band[1] - data.band[0]))},
                against="frequency",
                region=f"noise of {name}: {rms:.2g} {unit} rms, over {ratio:.1f} times that of its neighbours",
                settings={place: {"rms": Parameter(rms, float(sd), unit)}},
            )
        )
    return out


def sensor_noise_rms(point: WorkingPoint, i: int) -> Parameter:
    """Rms of the noise of a location's sensor over the whole band, if the noise is white, in the sensor's unit."""
    data = point.data
    density = point.nu[i] * point.S[i]
    floor = density * data.noise_referred_to_force(point.A)[i]
    share = floor / (point.S[i] * data.excitation_shape[i] + floor)
    sd = 1.0 / np.sqrt(max(data.blocks * float(np.sum(share**2)), 1e-300))  # of ln(density), by the Whittle likelihood
    rms = float(np.sqrt(density * data.rate_hz / 2))
    return Parameter.from_estimate(rms, 0.5 * rms * sd, MOTION_UNITS[data.kinds[i]])
