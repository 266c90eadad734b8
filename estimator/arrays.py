"""Array types that every room shares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Series = NDArray[np.floating[Any]]  # a time series in double or single precision
