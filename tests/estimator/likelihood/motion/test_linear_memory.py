"""The exact response of a linear force with memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing

from estimator.effects import CATALOGUE
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.likelihood.motion.linear_memory import linear_response, response_derivative
from estimator.model.rig import EffectUse, Setting
from estimator.simulation.simulator import simulate

M, f0, zeta, kL, c = 0.4, 2000.0, 0.05, 1e7, 60.0


def test_a_pedestal_is_the_two_springs_in_series() -> None:
    """-(k + i w c)^2 / (k + i w c + M (w0^2 - w^2 + 2 i zeta w w0)): the cap's own spring and what it stands on."""
    T = linear_response(CATALOGUE["pedestal"], np.array([M, f0, zeta]), np.array([0.2, kL, c]))
    assert T is not None
    w = 2 * np.pi * np.geomspace(10.0, 12800.0, 200)
    w0, D = 2 * np.pi * f0, kL + 1j * w * c
    np.testing.assert_allclose(T(w), -D * D / (D + M * (w0**2 - w**2 + 2j * zeta * w * w0)), rtol=1e-6)


def test_friction_that_remembers_is_not_linear() -> None:
    for slip in (2e-7, 1e-2):  # whether it slips in this motion or not
        assert linear_response(CATALOGUE["bouc_wen"], np.array([1e6, slip]), np.array([0.2, 1e7, 60.0])) is None


@pytest.mark.parametrize("which", [1, 2])
def test_a_response_changes_with_the_stiffness_and_damping_beside_it(which: int) -> None:
    effect, p, lin = CATALOGUE["pedestal"], np.array([M, f0, zeta]), np.array([0.2, kL, c])
    found = response_derivative(effect, p, lin, which)
    assert found is not None
    w = 2 * np.pi * np.geomspace(100.0, 8000.0, 50)
    D, pedestal = kL + 1j * w * c, M * ((2 * np.pi * f0) ** 2 - w**2 + 2j * zeta * w * 2 * np.pi * f0)
    by_D = -D * (D + 2 * pedestal) / (D + pedestal) ** 2  # of -D^2 / (D + pedestal)
    np.testing.assert_allclose(found(w), by_D * (1.0 if which == 1 else 1j * w), rtol=1e-5)
    assert response_derivative(CATALOGUE["bouc_wen"], np.array([1e6, 2e-7]), lin, which) is None


def test_beside_a_pedestal_numbers_are_as_uncertain_as_they_are() -> None:
    """Against the information in the spectrum of the motion, whose shape is known in closed form. With x and v alone
    for columns of kL and c, as if the pedestal did not answer by them, c was said to be 40 % more certain than it can
    be."""
    rig, seconds = one_bearing(), 6.0
    own = {"mass": Setting(M), "frequency": Setting(f0), "damping": Setting(zeta)}
    rig = replace(rig, channels=rig.channels[:1], linear={"bearing1.x": rig.linear["bearing1.x"]}, effects=())
    rig = replace(rig, effects=(EffectUse("pedestal", {"bearing1.x": own}),))
    found = fit_all_effects(rig, simulate(rig, RATE, seconds, seed=1), RATE).parameters

    f = np.arange(rig.band[0], rig.band[1], 0.25)

    def log_spectrum(p: np.ndarray) -> np.ndarray:
        T = linear_response(CATALOGUE["pedestal"], p[:3], np.array([0.2, p[3], p[4]]))
        w = 2 * np.pi * f
        return p[5] - 2 * np.log(np.abs(-0.2 * w**2 + 1j * w * p[4] + p[3] + T(w)))  # type: ignore[misc]

    p = np.array([M, f0, zeta, kL, c, np.log(9e-5)])
    steps = 1e-4 * np.diag(np.abs(p))
    J = np.array([(log_spectrum(p + h) - log_spectrum(p - h)) / (2 * np.sum(h)) for h in steps])
    sd = np.sqrt(np.diag(np.linalg.inv(seconds * 0.25 * J @ J.T)))
    for name, bound in zip(("pedestal.mass", "pedestal.frequency", "pedestal.damping", "kL", "c"), sd, strict=False):
        assert found[f"bearing1.x.{name}"].sd == pytest.approx(bound, rel=0.15)
