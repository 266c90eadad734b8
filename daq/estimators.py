"""The rolling estimators by the name that a rig file gives them (`[estimator] method`)."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import numpy as np

from estimator.estimate import OnlineEstimator
from estimator.model import Model

METHODS = {
    "spectral": ("estimator.rolling", "RollingSpectral"),
    "score-matching": ("estimator.score_matching", "RollingScoreMatching"),
}
WARM_UP_S = 2.0

MakeEstimator = Callable[[Model, float], OnlineEstimator]


def maker(method: str, time_constant_s: float) -> MakeEstimator:
    """What makes the estimator called `method` for a model and a rate. Imported when first made: it is heavy."""
    module, name = METHODS[method]

    def make(model: Model, rate_hz: float) -> OnlineEstimator:
        estimator: OnlineEstimator = getattr(import_module(module), name)(model, rate_hz, time_constant_s)
        return estimator

    return make


def warm_up(make: MakeEstimator, model: Model, rate_hz: float, rows: int) -> None:
    """Have everything compiled before data come: two seconds of noise through an estimator that is then dropped."""
    estimator = make(model, rate_hz)
    rng = np.random.default_rng(0)
    for _ in range(max(1, int(WARM_UP_S * rate_hz / rows))):
        estimator.update(rng.standard_normal((rows, len(model.channels))))
    estimator.snapshot()
