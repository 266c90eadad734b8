"""A channel that cannot be a motion is said by name, by fit and by all that compares."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.diagnosis.comparison.comparison import compare
from estimator.errors import DataError
from estimator.identification.batch import spectral
from estimator.model.rig import Channel, Model

MODEL = Model(channels=(Channel("a", "bearing1", "x"), Channel("b", "bearing1", "y")), band=(100.0, 1000.0))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda z: 0 * z, "b is zero throughout"),
        (lambda z: 0 * z + 3.3, "b is constant at 3.3"),
        (lambda z: 1e300 * z, "b .*check its unit"),
        (lambda z: 1e-300 * z, "b .*check its (unit|offset)"),
        (lambda z: z * np.nan, "b has no valid samples"),
    ],
)
def test_a_channel_that_is_no_motion(make: object, said: str) -> None:
    y = np.random.default_rng(1).standard_normal((100_000, 2))
    y[:, 1] = make(y[:, 1])  # type: ignore[operator]
    for ask in (compare, spectral.fit_spectral):
        with pytest.raises(DataError, match=said):
            ask(MODEL, y, 5000.0)  # type: ignore[operator]
