"""The determinant of coupled places: parts of a record add up to the whole, however the places are parted."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.likelihood.whitening.determinant import Jacobian, line_weights

S = 2j * np.pi * np.linspace(50.0, 400.0, 200)


def mass_matrix() -> np.ndarray:
    """(bins, 3, 3) kg: places 0 and 2 on a shaft, place 1 in the other direction."""
    K = np.diag([1.0e6, 0.4e6, 0.7e6]).astype(complex)
    K[0, 2] = K[2, 0] = -2.0e5
    return np.eye(3) + (K + S[:, None, None] * 40.0 * np.eye(3)) / (S**2)[:, None, None]


@pytest.mark.parametrize("parts", [[[0, 1, 2]], [[0], [1], [2]], [[0, 1], [2]], [[0, 2], [1]]])
def test_parts_add_up_to_the_whole(parts: list[list[int]]) -> None:
    """A law of both directions joins two of three places: models with and without it were parted differently."""
    whole = Jacobian(mass_matrix(), line_weights(S))
    none = np.zeros((0, 3, 3, S.size), complex), np.zeros(0)
    values = [whole.of_places(np.array(p)).value(none[0][:, : len(p), : len(p)], none[1]) for p in parts]
    assert sum(values) == pytest.approx(whole.value(*none), rel=1e-12)
