"""Power of the residual force in bins that a line takes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from estimator.identification.structure.spectral_models import mean_power


def test_a_bin_that_a_line_takes_has_the_power_of_its_neighbours() -> None:
    """It had none, over a share of none: the fit of the spectrum ended with an error."""
    kept = np.array([[1.0, 0.0, 1.0, 0.5]])
    Z = np.sqrt(kept[0] / 2.0).repeat(2)[None].repeat(3, axis=0).astype(np.float32)
    point: Any = SimpleNamespace(
        spectra=[Z], data=SimpleNamespace(blocks=3),
        whitening=SimpleNamespace(weight=np.full((1, 4), 0.5), leakage=SimpleNamespace(kept=kept)),
    )  # fmt: skip
    assert np.allclose(mean_power(point, 0), 2.0)
