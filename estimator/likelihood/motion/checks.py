"""Checks of a record before anything is estimated from it: shape, rate, dead and implausible channels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import real_samples
from estimator.errors import DataError
from estimator.model.rig import Model

MIN_PEAK_SI, MAX_PEAK_SI = 1e-15, 1e15  # a peak outside is a wrong unit, and its powers overflow


def check_moves(name: str, z: NDArray[np.float64]) -> tuple[float, float]:
    """Smallest and largest of a channel's finite samples, SI. Raises DataError if they cannot be motion or force."""
    if z.size < 2:
        raise DataError(f"channel {name} has no valid samples: check its cable and its signal in the rig file")
    low, high = float(z.min()), float(z.max())
    if low == high:
        what = "is zero throughout" if low == 0 else f"is constant at {low:g}"
        raise DataError(f"channel {name} {what}: check the sensor and its cable")
    largest = max(high, -low)
    if not MIN_PEAK_SI < largest < MAX_PEAK_SI:
        raise DataError(f"channel {name} reaches {largest:.3g} in SI units: check its unit and its scale")
    return low, high


def check_shape(model: Model, y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The record as (n, channels) float64 or float32. Raises DataError if it is none of this model."""
    try:
        y = real_samples(y)
    except ValueError as e:
        raise DataError("the channels are of unequal length: export them with a common start and end") from e
    if y.ndim != 2 or y.shape[1] != len(model.channels):
        raise DataError(
            f"the record has shape {y.shape}, the model {len(model.channels)} channels: (n, channels) needed"
        )
    if not model.places:
        raise DataError("the model has no motion channel on a bearing: nothing can be estimated")
    return y


def check_record(model: Model, y: NDArray[np.float64], rate_hz: float) -> NDArray[np.float64]:
    """The record as (n, channels) float64 or float32. Raises DataError naming the channel and the remedy."""
    y = check_shape(model, y)
    if not np.isfinite(rate_hz) or rate_hz <= 0:
        raise DataError(f"sampling rate {rate_hz} Hz: it must be positive")
    for i, channel in enumerate(model.channels):
        if channel.kind != "tacho":
            there = np.isfinite(y[:, i])
            check_moves(channel.name, y[:, i] if there.all() else y[there, i])
    for place in model.places:
        for key, sign in (("kL", "positive"), ("c", "positive")):
            setting = model.linear.get(place, {}).get(key)
            if setting is not None and setting.value is not None and setting.value < 0:
                raise DataError(
                    f"the model is unstable: {place}.{key} = {setting.value:g}; give a {sign} value or none"
                )
    return y
