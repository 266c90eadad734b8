"""Held-out gains of a fit that a fold calls impossible."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from estimator.likelihood.path.subproblem import heldout_gain
from estimator.likelihood.thresholds import LIMITS


def problem(by_fold: list[float], plain: list[float]) -> Any:
    """A problem whose likelihood of each fold is known, and that of the problem without trial regressors."""

    def of(values: list[float]) -> Any:
        return SimpleNamespace(fit=lambda *_: None, likelihood=lambda _, here: values[int(here[0])])

    own = of(by_fold)
    own.without_extra = lambda: of(plain)
    return own


def test_a_fold_that_is_impossible_is_a_finite_loss() -> None:
    """The standard error of the gains was no number, with a warning of numpy."""
    gains = heldout_gain(problem([-np.inf, 4.0, 4.0, 4.0, 4.0, 4.0], [1.0, 1.0, 1.0, 1.0, 1.0, -np.inf]))
    assert gains.tolist() == [-LIMITS.impossible_nats, 3.0, 3.0, 3.0, 3.0, 0.0]
