"""Whether a channel's values can be a motion or a force at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .errors import DataError

SMALLEST, LARGEST = 1e-15, 1e15  # what is less or more is a mistake, and its powers are no numbers


def check_moves(name: str, z: NDArray[np.float64]) -> tuple[float, float]:
    """Smallest and largest of a channel's finite values. Raises DataError if they cannot be a motion or a force."""
    if z.size < 2:
        raise DataError(f"channel {name} has no valid samples: check its cable and its signal in the rig file")
    low, high = float(z.min()), float(z.max())
    if low == high:
        what = "is zero throughout" if low == 0 else f"is constant at {low:g}"
        raise DataError(f"channel {name} {what}: check the sensor and its cable")
    largest = max(high, -low)
    if not SMALLEST < largest < LARGEST:
        raise DataError(f"channel {name} reaches {largest:.3g} in SI units: check its unit and its scale")
    return low, high
