"""A record as the model sees it: sensor effects of the model undone, then cut into blocks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .model import Model
from .motion_blocks import MotionBlocks, cut
from .sensor_response import undone

Array = NDArray[np.float64]


def prepare(model: Model, y: Array, rate_hz: float) -> MotionBlocks:
    """Blocks of a record y (n, channels), SI. Raises DataError as `cut` does."""
    return cut(model, undone(model, y, rate_hz), rate_hz)
