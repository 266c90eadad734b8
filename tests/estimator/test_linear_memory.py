"""The exact response of a linear force with memory."""

from __future__ import annotations

import numpy as np

from estimator.effects import CATALOGUE
from estimator.linear_memory import response


def test_a_pedestal_is_the_two_springs_in_series() -> None:
    """-(k + i w c)^2 / (k + i w c + M (w0^2 - w^2 + 2 i zeta w w0)): the cap's own spring and what it stands on."""
    M, f0, zeta, kL, c = 0.4, 2000.0, 0.05, 1e7, 60.0
    T = response(CATALOGUE["pedestal"], np.array([M, f0, zeta]), np.array([0.2, kL, c]))
    assert T is not None
    w = 2 * np.pi * np.geomspace(10.0, 12800.0, 200)
    w0, D = 2 * np.pi * f0, kL + 1j * w * c
    np.testing.assert_allclose(T(w), -D * D / (D + M * (w0**2 - w**2 + 2j * zeta * w * w0)), rtol=1e-6)


def test_friction_that_remembers_is_not_linear() -> None:
    for slip in (2e-7, 1e-2):  # whether it slips in this motion or not
        assert response(CATALOGUE["bouc_wen"], np.array([1e6, slip]), np.array([0.2, 1e7, 60.0])) is None
