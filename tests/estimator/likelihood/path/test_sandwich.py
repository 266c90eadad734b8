"""What the tangents of a fold do in its score: the Jacobian's gradient with them; intervals of damping laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference_rig import COULOMB, RATE, rig_model, rig_record

from estimator.identification.batch.maximum import inverse
from estimator.identification.batch.measured_force import analyse
from estimator.identification.batch.report import SpectralFit
from estimator.likelihood.motion.law_columns import Columns
from estimator.likelihood.path.gram_likelihood import Likelihood, evidence_of
from estimator.likelihood.path.sandwich import fold_tangent_scores


@pytest.fixture(scope="module")
def solution() -> SpectralFit:
    friction = np.zeros((4, 7))
    friction[:, COULOMB] = 0.07
    return analyse(rig_model("cubic", "coulomb", "cross_coupling"), rig_record(16.0, seed=8, hidden=friction), RATE)


@pytest.mark.slow
def test_it_is_the_gradient_with_the_tangents_of_the_fold_less_that_with_the_mean(solution: SpectralFit) -> None:
    bank, local = solution.bank, solution.local
    evidence = evidence_of(bank, solution.start.nodes)
    mean = np.average(bank.fold_tangents, axis=0, weights=bank.blocks)
    likelihood = Likelihood(replace(evidence, tangents=mean))
    found = fold_tangent_scores(likelihood, local, bank)
    assert found.sum(axis=0) == pytest.approx(0.0, abs=1e-9 * np.abs(found).max())
    B = evidence.balance.coefficients(local.point.beta)
    A = B @ likelihood.R
    line = likelihood.line(B, A)
    whole, _ = likelihood._jacobian(A, line, local.point, local.spread, hessian=False)
    for fold in (0, 7):
        other = Likelihood(replace(evidence, tangents=bank.fold_tangents[fold]))
        own, _ = other._jacobian(A, replace(line, R=other.R), local.point, local.spread, hessian=False)
        assert found[fold] == pytest.approx(bank.blocks[fold] * (likelihood.T @ (own - whole)), rel=1e-6, abs=1e-12)


@pytest.mark.slow
def test_tangents_of_the_folds_are_those_of_their_rows(solution: SpectralFit) -> None:
    bank, record, grid = solution.bank, solution.record, solution.record.grid
    columns = Columns(solution.balance, record.scales, solution.start.widths, solution.start.linear)
    start = round(bank.start[1] * record.rate_hz)
    n = int(bank.blocks[1])
    _, sums = columns.evaluate(record.stretch(start, start + (n + 1) * grid.hop))
    assert bank.fold_tangents[1] == pytest.approx(sums / ((n + 1) * grid.hop), rel=0.35)
    assert bank.fold_tangents.mean(axis=0) == pytest.approx(bank.tangents, rel=0.05)


def test_the_interval_of_damping_beside_friction_is_hardly_wider_than_the_hessian_says(solution: SpectralFit) -> None:
    sd, bare = np.sqrt(np.diag(solution.covariance)), np.sqrt(np.diag(inverse(solution.local)))
    ratio = sd / bare
    c = [j for j, name in enumerate(solution.balance.names) if name.endswith(".c")]
    assert 0.7 < np.median(ratio[c]) < 1.3  # with the mean tangents of the record 1.5
