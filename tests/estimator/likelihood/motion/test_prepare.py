"""A channel that cannot be a motion is said by name, by fit and by all that compares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.diagnosis.comparison.comparison import compare
from estimator.errors import DataError
from estimator.identification.batch import spectral
from estimator.likelihood.motion.prepare import prepare
from estimator.model.rig import Channel, LineBand, Model

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


@pytest.mark.parametrize(("swept", "said"), [(False, "narrow lines .*widen"), (True, "orders .*constant speed")])
def test_a_band_that_lines_fill_is_refused_with_what_to_do(swept: bool, said: str) -> None:
    y = np.random.default_rng(1).standard_normal((100_000, 2))
    line = LineBand(low_hz=110.0, high_hz=990.0, power_over_psd_hz=1e3, swept=swept)
    model = replace(MODEL, mass={"bearing1": 1.0}, line_bands=(line,))
    with pytest.raises(DataError, match=said):
        prepare(model, y, 5000.0)
