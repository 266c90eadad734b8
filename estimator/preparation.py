"""A record as the model sees it: sensor effects of the model undone, then cut into blocks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .model import MOTION, Model
from .motion_blocks import MotionBlocks, cut

Array = NDArray[np.float64]
BLIND = ("sensor_gain", "sensor_skew")  # caps that are not coupled say nothing of them: diagnosis.md


def prepare(model: Model, y: Array, rate_hz: float) -> MotionBlocks:
    """Blocks of a record y (n, channels), SI. Raises DataError as `cut` does."""
    return cut(model, sensors_undone(model, y, rate_hz), rate_hz)


def sensors_undone(model: Model, y: Array, rate_hz: float) -> Array:
    """The record with the gain errors and delays that the model knows of taken back."""
    out = y
    for use in model.effects:
        if use.name not in BLIND:
            continue
        for k, channel in enumerate(model.channels):
            own = [s for key, s in use.parameters.items() if key in (channel.place, channel.node, channel.name)]
            if not own or channel.kind not in MOTION:
                continue
            values = {n: s.value for n, s in own[0].items()}
            if out is y:
                out = y.copy()
            if values.get("error") is not None:
                out[:, k] /= 1.0 + float(values["error"] or 0.0)
            if values.get("delay"):
                gap = np.isnan(out[:, k])
                w = 2j * np.pi * np.fft.rfftfreq(len(out), 1 / rate_hz)
                moved = np.fft.irfft(
                    np.fft.rfft(np.nan_to_num(out[:, k])) * np.exp(w * float(values["delay"] or 0.0)), len(out)
                )
                out[:, k] = np.where(gap, np.nan, moved)
    return out
