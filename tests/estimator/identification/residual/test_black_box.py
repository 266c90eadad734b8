"""What the black box sees of noisy sensors is what laws see; it has no columns where the motion hardly is."""

from __future__ import annotations

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing

from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.residual.black_box import MIN_VISIT_SAMPLES, group_pool, hat_knots
from estimator.simulation.simulator import simulate

OWN = (".kL", ".c", ".kNL", ".cx", ".rate", ".curvature")


@pytest.mark.parametrize(("name", "column"), [("displacement_damping", "level.1"), ("stiffness_drift", "time.0")])
def test_a_law_of_the_model_is_no_column_of_its_own_in_noise(name: str, column: str) -> None:
    """Made of the noisy displacement a fifth of x^2 v was left beside the law, and won 290 nats behind a mean over a
    sample, which folds noise into the displacement; of a drift 0.4 %, with the mean tangent of the record and not of
    each fold, and 41 nats behind a Bessel filter."""
    rig, effect = one_bearing(), CATALOGUE[name]
    values = strengths(effect, size(rig, "bearing1.x", RATE), 0.06, rig, 4.0)
    model = with_effect(rig, effect, values, "bearing1.x")
    point = fit_all_effects(model, simulate(model, RATE, 4.0, seed=2, noise=0.6), RATE).point
    assert point.data.denoise_correction is not None
    problem, _ = group_pool(point, 0, (1.0,))
    names = ["", *problem.base, *problem.extra]
    rows = [k for k, name in enumerate(names) if name.endswith(OWN) or name == column]
    G = problem.gram.G.sum(axis=(0, 1))[np.ix_(rows, rows)]
    rms = np.sqrt(np.diag(G))
    C = G / np.multiply.outer(rms, rms)
    assert 1.0 - C[-1, :-1] @ np.linalg.solve(C[:-1, :-1], C[:-1, -1]) < 1e-4


def test_hats_reach_as_far_as_the_motion_does() -> None:
    """A hat that one sample touches has hardly a force, and the mean slope of one that the sample is in the middle of:
    in the determinant 790 nats were won by that."""
    z = np.random.default_rng(0).uniform(-2.0, 2.0, 100_000)
    z[7] = 3.6
    knots = hat_knots(z, 1.0, 0.5)
    assert knots[-1] == -knots[0] == 2.0
    assert np.sum(z > knots[-2]) >= MIN_VISIT_SAMPLES
    gaussian = np.random.default_rng(0).standard_normal(500_000)
    assert hat_knots(gaussian, 1.0, 0.5)[-1] == 4.0
