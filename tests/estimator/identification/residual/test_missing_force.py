"""The missing force: free hat functions of a state, and the same bound to a smooth curve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing, record

from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.residual import black_box, group_fit
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.located_law import located_laws
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path.subproblem import Subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import EffectUse, Setting
from estimator.simulation.simulator import simulate

Hats = tuple[WorkingPoint, Subproblem, tuple[str, ...], np.ndarray]


@pytest.fixture(scope="module")
def hats() -> Hats:
    """A quintic of 1.5 % that the model lacks, seen by hat functions of displacement in 10 s."""
    rig = one_bearing()
    data = prepare(rig, record(rig, "quintic", 0.015), RATE)
    point = fit_model(data, located_laws(rig, data))
    pool, knots = black_box.group_pool(point, 0, (1.0, 2.0))
    names = tuple(n for n in pool.extra if n.startswith("displacement."))
    return point, pool.only(names), names, knots["displacement"]


def test_a_bound_fit_is_the_same_force_in_terms_of_hat_functions(hats: Hats) -> None:
    _, problem, names, knots = hats
    bound, fit, _ = group_fit.fit_polynomial(problem, names, knots)
    back = group_fit.as_hat_functions(problem, bound, fit, names, knots)
    everything = np.arange(len(problem.blocks))
    assert problem.likelihood(back, everything) == pytest.approx(bound.likelihood(fit, everything), abs=1e-3)
    power, _ = group_fit.extra_power(hats[0], problem, back)
    again, _ = group_fit.extra_power(hats[0], bound, fit)
    assert power == pytest.approx(again, rel=0.02)


def test_a_smooth_curve_sees_a_weaker_law_than_free_hat_functions(hats: Hats) -> None:
    _, problem, names, knots = hats
    everything = np.arange(len(problem.blocks))
    plain = problem.without_extra()
    level = plain.likelihood(plain.fit(), everything)
    free = group_fit.fit_with_ridge(problem)
    bound, fit, own = group_fit.fit_polynomial(problem, names, knots)
    p_free = group_fit.group_p_value(problem, free, names, problem.likelihood(free, everything) - level)
    p_bound = group_fit.group_p_value(bound, fit, own, bound.likelihood(fit, everything) - level)
    assert p_bound < 0.1 * p_free


@pytest.mark.parametrize(
    ("effect", "values", "group"),
    [
        ("ball_pass", {"k_cos": 1e6, "k_sin": 0.0, "order": 2.1}, "shaft_angle"),
        ("stiffness_drift", {"rate": 5e5, "curvature": 0.0}, "time"),
        ("displacement_damping", {"cx": 1e15}, "level"),
    ],
)
def test_a_force_that_the_model_has_wins_nothing_again(effect: str, values: dict[str, float], group: str) -> None:
    """The group holds the law itself. With a mean response of its own there it took the law's place and won 37, 29 and
    7 nats: complete models were left with 0.1 to 0.2 % of missing force against the shaft's angle, time or level."""
    own = {name: Setting(value) for name, value in values.items()}
    rig = replace(one_bearing(), effects=(EffectUse(effect, {"bearing1.x": own}),))
    point = fit_all_effects(rig, simulate(rig, RATE, 6.0, seed=2), RATE).point
    pool, _ = black_box.group_pool(point, 0, (1.0, 2.0, 2.1))
    trial = pool.only(tuple(n for n in pool.extra if n.split(".")[0] == group))
    plain, everything = pool.without_extra(), np.arange(point.data.fold_blocks.size)
    won = trial.likelihood(group_fit.fit_with_ridge(trial), everything) - plain.likelihood(plain.fit(), everything)
    assert won < len(trial.extra)  # half of it in the mean, half of its root the scatter


@pytest.mark.slow
def test_hats_of_the_velocity_win_no_more_than_their_number() -> None:
    """Twice the nats of columns that say nothing are their degrees of freedom in the mean. At 5 % damping and a band up
    to four times the resonance hats of half an rms won 28 with 15, for the force of the instant itself."""
    rig = one_bearing()
    mass = rig.cap_mass("bearing1.x") or 1.0
    k = mass * (2 * np.pi * 1822.0) ** 2
    linear = {"kL": Setting(k), "c": Setting(0.1 * np.sqrt(k * mass)), "S": Setting(1e-4)}
    rig = replace(rig, channels=rig.channels[:1], effects=(), band=(300.0, 7349.0), linear={"bearing1.x": linear})
    won, free = [], []
    for seed in range(10):
        point = fit_all_effects(rig, simulate(rig, RATE, 6.0, seed=seed), RATE).point
        pool, _ = black_box.group_pool(point, 0, (1.0, 2.0))
        trial = pool.only(tuple(n for n in pool.extra if n.startswith("velocity")))
        plain, everything = pool.without_extra(), np.arange(point.data.fold_blocks.size)
        fit = group_fit.fit_with_ridge(trial)
        won.append(2 * (trial.likelihood(fit, everything) - plain.likelihood(plain.fit(), everything)))
        free.append(group_fit.effective_dof(trial, fit, trial.extra))
    assert np.mean(won) < 1.6 * np.mean(free)
