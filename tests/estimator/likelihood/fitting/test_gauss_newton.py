"""A step of a fit where a number stops at its limit."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from estimator.likelihood.fitting.gauss_newton import step_within_limits


def point(delta: np.ndarray, covariance: np.ndarray, scales: np.ndarray) -> SimpleNamespace:
    names = tuple("abc"[: delta.size])
    return SimpleNamespace(fit=SimpleNamespace(names=names, delta=delta, covariance=covariance, scales=scales))


@given(st.integers(0, 2**32 - 1))
def test_the_others_go_to_their_best_with_the_held_one_where_it_is(seed: int) -> None:
    """Of a quadratic -(d - d0)' H (d - d0) / 2, solved anew with one number fixed: they had been left where the
    unlimited step had put them, and k of a Hertz contact ran away where its preload could not follow."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3))
    curvature, best, scales = root @ root.T + 0.1 * np.eye(3), rng.normal(size=3), rng.uniform(0.5, 2.0, 3)
    high = 0.5 * best[1] * scales[1]  # half of the way, in the unit of the parameter
    limits = {"b": (min(high, 0.0), max(high, 0.0))}
    step = step_within_limits(point(best, np.linalg.inv(curvature), scales), limits)  # type: ignore[arg-type]
    others = [0, 2]
    pull = curvature[np.ix_(others, [1])] @ (best[[1]] - step[[1]])
    expected = best[others] + np.linalg.solve(curvature[np.ix_(others, others)], pull)
    np.testing.assert_allclose(step[1] * scales[1], high)
    np.testing.assert_allclose(step[others], expected, rtol=1e-6, atol=1e-9)


def test_a_step_within_all_limits_is_taken_as_it_is() -> None:
    best = np.array([0.3, -0.2, 0.1])
    step = step_within_limits(point(best, np.eye(3), np.ones(3)), {"a": (-1.0, 1.0), "c": (0.0, 0.2)})  # type: ignore[arg-type]
    np.testing.assert_array_equal(step, best)
