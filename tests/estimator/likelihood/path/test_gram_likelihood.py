"""Derivatives against differences, the thinned Jacobian against the full one, the causality of the dressing."""

from dataclasses import replace

import numpy as np
import pytest
from reference_rig import RATE, rig_model, rig_record
from rolling_record import evidence_of, started

from estimator.identification.rolling.start import RollingStart
from estimator.likelihood.motion.force_balance import build_balance
from estimator.likelihood.motion.stream_record import Record
from estimator.likelihood.path.gram_likelihood import Evidence, Likelihood, Point, inverse, maximise
from estimator.likelihood.path.jacobian import levels
from estimator.likelihood.response.modal_response import single_mass_response
from estimator.likelihood.response.second_order import pair_energies
from estimator.signals.blocks import frequency_nodes


@pytest.fixture(scope="module")
def fitted() -> tuple[Record, RollingStart, Evidence]:
    record, start = started(rig_model("cubic", "cross_coupling"), rig_record(8.0, seed=3), RATE)
    balance = build_balance(record.model, start.sizes)
    return record, start, evidence_of(record, balance, start.widths, start.linear, start.nodes)


def test_gradient_and_hessian_are_those_of_the_likelihood(fitted: tuple[Record, RollingStart, Evidence]) -> None:
    _, start, evidence = fitted
    likelihood = Likelihood(evidence)
    # sensor noise of one part in a thousand at the lower edge: S hardly varies within a cell, where it is averaged
    point = start.point(evidence.balance)
    point = Point(point.beta * 1.01, point.S * 0.97, np.full(4, 1e-9))
    local = likelihood.at(point)
    p = point.beta.size
    for k in range(p):
        h = np.zeros(p)
        h[k] = 0.3 / np.sqrt(abs(local.hessian[k, k]))
        up, here, down = (likelihood.at(replace(point, beta=point.beta + s * h)).nll for s in (1, 0, -1))
        scale = np.sqrt(abs(local.hessian[k, k]))
        assert (up - down) / (2 * h[k]) == pytest.approx(local.gradient[k], rel=2e-3, abs=0.05 * scale)
        assert (up + down - 2 * here) / h[k] ** 2 == pytest.approx(local.hessian[k, k], rel=2e-2)
    for i in range(4):
        values = [
            likelihood.at(replace(point, S=point.S * np.exp(s * 0.01 * (np.arange(4) == i)))).nll for s in (1, 0, -1)
        ]
        assert (values[0] - values[2]) / 0.02 == pytest.approx(local.gradient[p + i], rel=1e-2, abs=1.0)


def test_few_nodes_do_what_every_bin_does(fitted: tuple[Record, RollingStart, Evidence]) -> None:
    _, start, evidence = fitted
    point = start.point(evidence.balance)
    full, _ = maximise(Likelihood(replace(evidence, nodes=frequency_nodes(evidence.grid))), point)
    thin, _ = maximise(Likelihood(evidence), point)
    sd = np.sqrt(np.diag(inverse(full)))[: point.beta.size]
    assert start.nodes.f_hz.size < 0.15 * evidence.grid.bins.size
    assert start.nodes.weight.sum() == evidence.grid.bins.size
    assert np.abs((thin.point.beta - full.point.beta) / sd).max() < 0.02


def test_force_and_noise_levels_come_back_from_cell_powers() -> None:
    rng = np.random.default_rng(0)
    count = np.full(24, 2000.0)
    gain = np.geomspace(1e3, 1e-3, 24)
    for S, noise in ((2.0, 0.0), (2.0, 1e-3), (1e-4, 1.0)):
        power = (S + noise * gain) * rng.gamma(count, 1 / count)
        floor = np.zeros((24, 1, 1))
        floor[:, 0, 0] = gain
        start = Point(np.zeros(0), np.ones(1), np.zeros(1))
        got_S, got_noise = levels(power[:, None], floor, count, start.S, start.noise)
        assert got_S[0] == pytest.approx(S, rel=0.02 if S > 1e-3 else 1.0)
        assert got_noise[0] == pytest.approx(noise, rel=0.05, abs=1e-4)


def test_dressing_is_causal_it_moves_response_but_adds_none() -> None:
    m, c, k, dt, lags = 1.0, 20.0, (2 * np.pi * 100.0) ** 2, 1e-4, 8192
    tau = np.arange(lags) * dt
    C = np.zeros((1, 1, 2, 2, lags))
    C[0, 0, 1, 1] = 30.0 * np.exp(-tau / 1e-3)  # covariance of the tangent damping of one law, per unit of it
    f = np.linspace(0.5, 4999.5, 20000)
    sigma = pair_energies(C, dt, np.ones(1), single_mass_response(m, c, k), f)[:, 0, 0]
    iw = 2j * np.pi * f
    D = k + iw * c + iw**2 * m
    # E[phi' G_v] = (1 - Sigma) G_v per unit mean tangent 1: the integral over all f of its real part is that of the
    # impulse response at 0+, 1 / (2 m), less the tail beyond the grid
    bare = np.trapezoid((iw / D).real, f) * 2
    both = np.trapezoid((iw / (D - sigma)).real, f) * 2
    added = np.trapezoid((sigma / (D - sigma)).real, f) * 2
    assert both == pytest.approx(bare, rel=0.02)
    assert abs(added) < 0.1 * np.trapezoid(np.abs((sigma / (D - sigma)).real), f) * 2
