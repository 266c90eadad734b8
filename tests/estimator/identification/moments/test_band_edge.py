from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from estimator.identification.moments.band_edge import BandEdge
from estimator.signals.band_limit import passband

RATE, BAND = 25600.0, (282.0, 8000.0)


@pytest.mark.parametrize(("m", "c", "k"), [(0.2, 60.0, 1e7), (0.245, 20.0, 1.5e7), (0.1, 200.0, 3e7)])
def test_work_is_the_integral_inside_the_band(m: float, c: float, k: float) -> None:
    """S * integral |G|^2 Re H df over the band by scipy's quad: what is missing outside is what is seen inside."""
    S = 9e-5

    def receptance(f: float) -> complex:
        w = 2 * np.pi * f
        return 1.0 / (k - m * w**2 + 1j * w * c)

    def gain2(f: float) -> float:
        return float(passband(np.array([f]), RATE, BAND)[0] ** 2)

    f0 = np.sqrt(k / m) / 2 / np.pi
    points = [0.5 * BAND[0], BAND[0], f0 - 30, f0, f0 + 30, BAND[1], 1.25 * BAND[1]]

    def integral(g: object) -> float:
        return float(sum(quad(g, a, b, limit=400)[0] for a, b in zip(points[:-1], points[1:], strict=True)))

    expected = S * integral(lambda f: gain2(f) * receptance(f).real)
    xx, vv, aa = (
        S * integral(lambda f, p=p: gain2(f) * abs(receptance(f)) ** 2 * (2 * np.pi * f) ** p) for p in (0, 2, 4)
    )
    edge = BandEdge.of(RATE, BAND)
    # (m a + k x) of a white-force record: S B - c^2 E[v^2] in the band, to the accuracy of the power balance there
    found = edge.work(k, m, xx, vv, aa)
    assert found.real == pytest.approx(expected, rel=0.06, abs=2e-5 * k * xx)
    assert abs(expected) / (k * xx) < 0.02


def test_no_correction_without_a_force() -> None:
    edge = BandEdge.of(RATE, BAND)
    assert edge.work(1e7, 0.2, 1e-14, 0.0 + 1e-30, 0.0) == 0.0
