"""A channel that saturates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.model.effect import Effect, searched


def apply(y: NDArray[np.float64], rate_hz: float, p: Sequence[float], rng: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(np.clip(y, -p[0], p[0]))


SENSOR_CLIPPING = Effect(
    name="sensor_clipping",
    kind="sensor",
    parameters=(searched("level", "m/s^2", "largest value that passes", (0.3, 8.0, 2.5), scale="a"),),
    equation="measured = true, limited to +-level",
    signature=(
        "values pile up at the ends of the range; kurtosis below 3 in that channel; odd harmonics over the whole band"
    ),
    confused_with=("cubic", "quintic"),
    distinguish=(
        "hard corners of the measured value, not of the displacement; other channels of the same bearing are fine"
    ),
    reference="Bendat and Piersol, Random Data, 4th ed., Wiley 2010 (clipping of data)",
    check="no sample exceeds the level, and those below it are unchanged",
    on_machine=(
        "wrong range, a supply too low for the swing, or shocks beyond the sensor: choose a range ten times the rms"
    ),
    apply=apply,
    found_by="samples",
    in_likelihood=False,
    typical={"level": (3.0, 2.3)},
)
