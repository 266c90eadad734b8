"""Compiled sums over frequency: the same as the ones written with arrays, and a gradient by differences."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from reference_rig import RATE, rig_model, rig_record
from rolling_record import evidence_of, record_of

from estimator.likelihood.motion.stream_record import Record
from estimator.likelihood.path.gram_likelihood import Likelihood, Line, Point
from estimator.likelihood.path.jacobian import levels, log_determinant

Floats = NDArray[np.float64]


class InArrays(Likelihood):
    """The same sums written with arrays."""

    def _spread_slope(self, A: Floats, point: Point) -> Floats:
        """(cells, E) derivative of the spread of its row by each entry."""
        if not point.noise.any():
            return np.zeros((self.evidence.grid.starts.size, self.row.size))
        weighted = A[:, self.row].conj() * self.R[:, self.column] * self.noise_shape[:, None, :]
        return self.evidence.nodes.mean_by_cell(2.0 * (weighted @ point.noise).real, self.evidence.grid.per_cell)

    def _jacobian(
        self, A: Floats, line: Line, point: Point, spread: Floats, hessian: bool = True
    ) -> tuple[Floats, Floats]:
        """Gradient (E,) and Hessian (E, E) of 1/2 sum over bins of log |det A|^2."""
        nodes = self.evidence.nodes
        inside = point.S + (np.abs(A) ** 2 * self.noise_shape[:, None, :]) @ point.noise
        kappa = inside / spread[nodes.cell] * nodes.weight[:, None]  # 1 per bin where S is flat within the cell
        Y = line.R[:, self.column] @ np.linalg.inv(line.A)  # (f, E, P)
        X = Y[:, :, self.row]  # tr(A^-1 dA_e A^-1 dA_e') = X_ee' X_e'e
        g = np.einsum("fe,fe->e", np.einsum("fee->fe", X).real, kappa[:, self.row])
        if not hessian:
            return g, np.empty((0, 0))
        root = np.sqrt(kappa[:, self.row])[:, :, None]
        X = X * root
        flat = X.reshape(-1, X.shape[1], X.shape[2])
        h = -np.einsum("fab,fba->ab", flat, flat, optimize=True).real
        return g, h


def spectrum_of_force(power: Floats, floor: Floats, count: Floats, start: Point) -> tuple[Floats, Floats]:
    """`levels` written with arrays."""
    S, noise = start.S.copy(), start.noise.copy()
    for i in range(S.size):
        g = floor[:, i, i]
        y = np.maximum(power[:, i] - floor[:, i] @ noise + g * noise[i], 1e-3 * power[:, i])
        coarse = np.geomspace(1e-3 / g.max(), 1e4 / g.min(), 32)
        ratios = np.concatenate([[0.0], coarse])
        for narrow in (None, 0.3, 0.03, 0.003):
            if narrow is not None:
                if S[i] == 0.0 or noise[i] == 0.0:
                    break
                ratios = noise[i] / S[i] * np.exp(narrow * np.linspace(-1.3, 1.3, 13))
            shape = 1.0 + ratios[:, None] * g
            level = (count * y / shape).sum(axis=1) / count.sum()
            best = int(np.argmin(count.sum() * np.log(level) + (count * np.log(shape)).sum(axis=1)))
            S[i], noise[i] = level[best], level[best] * ratios[best]
    return S, noise


@pytest.fixture(scope="module")
def record() -> Record:
    return record_of(rig_model("cubic", "coulomb", "cross_coupling"), rig_record(3.0, seed=6), RATE)


@pytest.mark.parametrize("noise", [0.0, 3e-7])
def test_value_gradient_and_hessian_are_those_of_the_likelihood(record: Record, noise: float) -> None:
    from estimator.likelihood.motion.force_balance import build_balance

    balance = build_balance(record.model, search=False)
    evidence = evidence_of(record, balance, 0.05 * record.scales)
    rng = np.random.default_rng(1)
    beta = np.array([{"kL": 1e7, "c": 60.0}.get(f.name.rsplit(".", 1)[-1], 0.1) for f in balance.free])
    point = Point(beta * rng.uniform(0.9, 1.1, beta.size), np.full(4, 9e-5), np.full(4, noise))
    a, b = InArrays(evidence).at(point), Likelihood(evidence).at(point)
    assert b.nll == pytest.approx(a.nll, rel=1e-13)
    assert b.gradient == pytest.approx(a.gradient, rel=1e-9, abs=1e-9 * np.abs(a.gradient).max())
    size = np.sqrt(np.abs(np.diag(a.hessian)) + (np.diag(a.hessian) == 0))
    assert b.hessian / np.outer(size, size) == pytest.approx(a.hessian / np.outer(size, size), abs=1e-10)


def test_gradient_of_the_log_determinant_by_differences() -> None:
    rng = np.random.default_rng(2)
    R = rng.normal(size=(5, 6, 2)) + 1j * rng.normal(size=(5, 6, 2))
    B, kappa = rng.normal(size=(2, 6)), np.ones((5, 2))
    row, column = np.repeat([0, 1], 6), np.tile(np.arange(6), 2)

    def value(step: Floats) -> float:
        return float(np.log(np.abs(np.linalg.det((B + step.reshape(2, 6)) @ R))).sum())

    g, h = log_determinant(B @ R, R, row, column, kappa)
    e = 1e-4 * np.eye(12)
    assert g == pytest.approx([(value(d) - value(-d)) / 2e-4 for d in e], rel=1e-5, abs=1e-5)
    second = [[(value(d + k) - value(d - k) - value(k - d) + value(-d - k)) / 4e-8 for k in e] for d in e]
    assert h == pytest.approx(np.array(second), rel=1e-3, abs=1e-3)


def test_levels_are_those_of_the_array_form() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        floor = np.exp(rng.normal(size=(24, 3, 3))) * np.geomspace(1e-2, 1e2, 24)[:, None, None]
        count = rng.integers(4, 400, 24).astype(float)
        S, noise = np.exp(rng.normal(size=3)), rng.choice([0.0, 0.1, 1.0], 3)
        power = (S + floor @ noise) * (1 + rng.normal(size=(24, 3)) / np.sqrt(count)[:, None] / 3)
        start = Point(np.zeros(0), np.ones(3), np.full(3, 0.05))
        exact = np.array(spectrum_of_force(power, floor, count, start))
        assert np.array(levels(power, floor, count, start.S, start.noise)) == pytest.approx(exact, rel=1e-9)
