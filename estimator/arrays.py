"""Array types that every room shares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Series = NDArray[np.floating[Any]]  # a time series in double or single precision


def real_samples(y: Any) -> Array:
    """An array in double precision, or in single precision if it comes so: a long record is not copied."""
    z: Array = np.asarray(y)
    return z if z.dtype in (np.float32, np.float64) else z.astype(np.float64)
