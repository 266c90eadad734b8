"""The mean response against the matrix exponential and the exact dynamic stiffness of the rotor."""

from __future__ import annotations

import numpy as np
import pytest
from reference_rig import shaft_at_caps
from scipy.linalg import expm

from estimator.effects import CATALOGUE
from estimator.likelihood.motion import linear_memory
from estimator.likelihood.response.modal_response import modal_responses
from estimator.model.rig import BEARING_NODES, Shaft
from estimator.model.rotor import shaft_matrix
from estimator.model.rotor_matrices import Rotor, lumped_rotor

MASS = np.array([0.16, 0.2, 0.16, 0.2])
PLACES = ("bearing1.x", "bearing2.x", "bearing1.y", "bearing2.y")
DISC, KS, CS = 0.7, 5e6, 1.0


def tangents() -> np.ndarray:
    D = np.zeros((4, 4, 2))
    D[range(4), range(4), 0] = 4e6, 19e6, 5e6, 18e6
    D[range(4), range(4), 1] = 30.0, 40.0, 45.0, 56.0
    D[0, 2, 0], D[2, 0, 0] = 2e5, -2e5  # a cross-coupling
    return D


def rotor(shaft: Shaft, places: tuple[str, ...] = PLACES) -> Rotor:
    made = lumped_rotor(BEARING_NODES, DISC, shaft_matrix(shaft, CS), shaft_matrix(shaft, KS)).at(places)
    assert made is not None
    return made


@pytest.mark.parametrize("shaft", ["chain", "beam"])
def test_each_cap_answers_as_the_rotor_does(shaft: Shaft) -> None:
    w = 2 * np.pi * np.linspace(0.0, 4000.0, 257)
    D = tangents()
    exact = D[..., 0] + 1j * w[:, None, None] * D[..., 1] - np.diag(MASS) * w[:, None, None] ** 2
    caps = shaft_at_caps(shaft, KS, CS, DISC, w)
    for at in ([0, 1], [2, 3]):
        exact[:, np.array(at)[:, None], at] += caps
    G = np.linalg.inv(exact)
    for i, mean in enumerate(modal_responses(MASS, D, rotor(shaft))):
        assert mean.sound
        # modes of a millionth of the largest are left out
        assert np.abs(mean.at(w) - G[:, i, i]).max() < 1e-6 * np.abs(G[:, i, i]).max()
        assert mean.stiffness == pytest.approx(1.0 / G[0, i, i].real, rel=1e-5)


def test_an_impulse_is_followed_as_by_the_matrix_exponential() -> None:
    tau = np.linspace(0.0, 0.02, 65)
    M = np.diag([*MASS[:2], DISC])
    D = tangents()
    K = np.diag([*D[[0, 1], [0, 1], 0], 0.0]) + shaft_matrix("chain", KS)
    C = np.diag([*D[[0, 1], [0, 1], 1], 0.0]) + shaft_matrix("chain", CS)
    free = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    impulse = np.zeros(6)
    impulse[3] = 1.0 / MASS[0]
    exact = np.array([expm(free * t) @ impulse for t in tau])[:, [0, 3]].T
    found = modal_responses(MASS[:2], D[:2, :2], rotor("chain", PLACES[:2]))[0].after(tau)
    assert np.abs(found - exact).max(axis=1) == pytest.approx(0.0, abs=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("c", [2.0, 60.0, 4000.0])  # of 2828 critical
def test_a_cap_by_itself(c: float) -> None:
    m, k = 0.2, 1e7
    (mean,) = modal_responses(np.array([m]), np.array([[[k, c]]]), None)
    w = 2 * np.pi * np.linspace(0.0, 3000.0, 100)
    exact = 1.0 / (k + 1j * w * c - m * w**2)
    assert np.abs(mean.at(w) - exact).max() < 1e-9 * np.abs(exact).max()
    x, v = mean.after(np.array([0.0]))[:, 0]
    assert (x * np.sqrt(k * m), v) == pytest.approx((0.0, 1.0 / m), abs=1e-9)
    if c < 1000.0:
        assert mean.hz == pytest.approx(np.sqrt(k / m) / (2 * np.pi))
        assert mean.decay == pytest.approx(2 * m / c)
        assert mean.quick == pytest.approx(mean.decay)
        assert mean.unfinished(2.0 * mean.decay) == pytest.approx(np.exp(-4.0))
        assert mean.width == pytest.approx(c * np.sqrt(k / m), rel=1e-3)


def test_a_mode_that_grows_is_not_sound() -> None:
    D = tangents()[:2, :2]
    D[1, 1, 1] = -500.0
    assert not modal_responses(MASS[:2], D, rotor("chain", PLACES[:2]))[0].sound  # through the shaft
    assert modal_responses(MASS[:2], D, None)[0].sound


def test_a_pedestal_under_the_cap_answers_with_it() -> None:
    pedestal, p, lin = CATALOGUE["pedestal"], np.array([0.4, 900.0, 0.02]), np.array([0.2, 1e7, 60.0])
    own, answer = linear_memory.state_matrix(pedestal, p, lin), linear_memory.linear_response(pedestal, p, lin)
    assert own is not None
    assert answer is not None
    w = 2 * np.pi * np.linspace(10.0, 3000.0, 100)
    exact = 1.0 / (1e7 + 60j * w - 0.2 * w**2 + answer(w))
    mean = modal_responses(lin[:1], np.array([[[1e7, 60.0]]]), None, [(0, own)])[0]
    assert np.abs(mean.at(w) - exact).max() < 1e-6 * np.abs(exact).max()
