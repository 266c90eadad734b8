from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimator.errors import DataError
from estimator.model.bearing_theory import curve, kinematics, radial_force, taylor, theory
from estimator.model.hertz_contact import (
    STEEL_CONTACT_MODULUS_PA,
    delta_star,
    ellipse_ratio,
    load_deflection,
    point_contact,
    raceways,
)
from estimator.model.rig import BearingGeometry, Channel, EffectUse, Model, Setting
from estimator.results import Fit, Parameter

SKF6200 = BearingGeometry(6, 6e-3, 20e-3, 3.09e-3, preload=0.3e-6)

# Dimensionless approach against curvature difference: Harris, Rolling Bearing Analysis, 4th ed., Table 6.1.
HARRIS = [
    (0.1075, 0.9974), (0.3204, 0.9761), (0.5916, 0.9077), (0.6716, 0.8733), (0.7332, 0.8394), (0.7948, 0.7961),
    (0.83495, 0.7602), (0.87366, 0.7169), (0.90999, 0.6636), (0.93657, 0.6112), (0.95738, 0.5551), (0.97290, 0.4960),
    (0.983797, 0.4352), (0.990902, 0.3745), (0.995112, 0.3176),
]  # fmt: skip


@pytest.mark.parametrize(("difference", "published"), HARRIS)
def test_delta_star_against_the_published_table(difference: float, published: float) -> None:
    assert delta_star(ellipse_ratio(difference)) == pytest.approx(published, abs=6e-5)


def test_ball_on_plane_is_the_closed_form_of_hertz() -> None:
    """Sphere of radius R on a plane: Q = (4/3) E* sqrt(R) delta^1.5 (Johnson, Contact Mechanics, 1985, eq. 4.23)."""
    radius = 5e-3
    e_star = STEEL_CONTACT_MODULUS_PA * 3.0 / (4.0 * math.sqrt(2.0))  # E / (2 (1 - nu^2))
    contact = point_contact((1.0 / radius, 1.0 / radius), (0.0, 0.0))
    assert contact.stiffness == pytest.approx(4.0 / 3.0 * e_star * math.sqrt(radius), rel=1e-9)


def test_steel_constant_is_the_modulus_within_its_rounding() -> None:
    exact = 4.0 * math.sqrt(2.0) / 3.0 * 2.07e11 / (2.0 * (1.0 - 0.3**2))
    assert pytest.approx(exact, rel=3e-3) == STEEL_CONTACT_MODULUS_PA


def test_the_papers_bearing() -> None:
    inner, outer = raceways(SKF6200)
    assert inner.delta_star == pytest.approx(0.5464, abs=5e-5)
    assert outer.delta_star == pytest.approx(0.6318, abs=5e-5)
    assert load_deflection(SKF6200) / 10**4.5 == pytest.approx(2.813e5, rel=2e-4)  # N/mm^1.5
    assert kinematics(SKF6200) == pytest.approx({"FTF": 0.350, "BPFO": 2.100, "BPFI": 3.900, "BSF": 1.517}, abs=5e-4)


@pytest.mark.parametrize(("g_um", "kL"), [(0.2, 1.80), (0.3, 2.20), (0.4, 2.54), (0.5, 2.84), (0.6, 3.11)])
def test_linear_stiffness_by_preload(g_um: float, kL: float) -> None:
    """The list of physics.md section 4, 1e4 N/mm; the exact small-x law 4.5 K_n sqrt(g) lies 0.3-0.6 % below it."""
    exact, _ = taylor(SKF6200, g_um * 1e-6)
    assert exact * 1e-7 == pytest.approx(kL, rel=7e-3)
    assert exact == pytest.approx(4.5 * load_deflection(SKF6200) * math.sqrt(g_um * 1e-6), rel=1e-12)


def test_softens_by_a_fifth_to_x_near_g_then_hardens() -> None:
    x = np.linspace(0.0, 8.0, 400) * 0.3e-6
    for phase in (0.0, math.pi / 6.0):  # a ball under the load, the load between two balls
        _, tangent, _ = radial_force(SKF6200, 0.3e-6, x, phase)
        least = int(np.argmin(tangent))
        assert -0.30 < tangent[least] / tangent[0] - 1.0 < -0.20
        assert 0.5 < x[least] / 0.3e-6 < 1.6
        assert tangent[-1] > 1.2 * tangent[0]


@settings(max_examples=40, deadline=None)
@given(st.integers(5, 16), st.floats(0.05, 2.0), st.floats(0.0, 1.0))
def test_small_x_law(balls: int, g_um: float, fraction: float) -> None:
    """Taylor coefficients against finite differences of the solved force, odd ball counts included."""
    bearing = BearingGeometry(balls, 6e-3, 20e-3, 3.09e-3)
    g = g_um * 1e-6
    kL, kNL = taylor(bearing, g)
    h = g * np.array([0.01, 0.02])
    _, k, _ = radial_force(bearing, g, np.concatenate([h, -h]))
    even = 0.5 * (k[:2] + k[2:])
    assert kNL is not None
    assert (even[0] - even[1]) / 3.0 / (h[0] ** 2 - h[1] ** 2) == pytest.approx(kNL, rel=5e-3)
    _, isotropic, _ = radial_force(bearing, g, np.zeros(1), phase=fraction * 2.0 * math.pi / balls)
    assert isotropic[0] == pytest.approx(kL, rel=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-2.0, 2.0), st.integers(4, 12), st.floats(0.0, 1.0))
@example(0.0, 0.75, 4, 9.3e-82)
def test_transverse_force_balances_and_tangent_is_the_slope(g: float, x: float, balls: int, phase: float) -> None:
    """y is a root (checked with scipy's brentq where there is contact) and k = dF/dx along the balanced path."""
    from scipy.optimize import brentq

    bearing = BearingGeometry(balls, 6e-3, 20e-3, 3.09e-3)
    K = load_deflection(bearing)
    th = phase + 2.0 * math.pi * np.arange(balls) / balls
    where = np.array([x]) * 1e-6
    force, tangent, y = radial_force(bearing, g * 1e-6, where, phase)

    def transverse(y: float) -> float:
        d = np.maximum(g * 1e-6 + where[0] * np.cos(th) + y * np.sin(th), 0.0)
        return float(K * d**1.5 @ np.sin(th))

    assert abs(transverse(float(y[0]))) <= 1e-9 * K * (3e-6) ** 1.5
    if transverse(-8e-6) < 0.0 < transverse(8e-6) and abs(force[0]) > 1e-3:
        root = brentq(transverse, -8e-6, 8e-6, xtol=1e-18)
        d = np.maximum(g * 1e-6 + where[0] * np.cos(th) + root * np.sin(th), 0.0)
        assert force[0] == pytest.approx(K * d**1.5 @ np.cos(th), rel=1e-6)
        h = 1e-11
        near, _, _ = radial_force(bearing, g * 1e-6, np.array([where[0] - h, where[0] + h]), phase)
        assert (near[1] - near[0]) / (2.0 * h) == pytest.approx(tangent[0], rel=2e-2, abs=2e4)


def test_clearance_has_no_stiffness_at_rest() -> None:
    found = curve(SKF6200, -0.2e-6)
    assert found.kL == 0.0
    assert found.kNL is None
    assert (found.force[np.abs(found.x) < 0.19e-6] == 0.0).all()
    assert found.force[-1] > 0.0


def test_theory_beside_a_fit_and_its_json() -> None:
    model = Model((Channel("b1x", "bearing1", "x"),), (150.0, 8000.0), bearing=SKF6200)
    kL, kNL = taylor(SKF6200, 0.25e-6)
    fit = Fit(
        {
            "bearing1.x.kL": Parameter(kL, 0.01 * kL, "N/m"),
            "bearing1.x.cubic.kNL": Parameter(kNL, None, "N/m^3"),
            "bearing1.y.kL": Parameter(None, None, "N/m", False, reason="mass unknown"),
        },
        None,
        1000,
        "score-matching",
    )
    result = theory(model, fit)
    row = result.fitted[0]
    assert row.preload_implied == pytest.approx(0.25e-6)
    assert row.preload_sd == pytest.approx(0.02 * 0.25e-6)
    assert row.theory_kNL == pytest.approx(kNL)
    assert result.fitted[1].preload_implied is None
    assert [c.preload for c in result.curves] == pytest.approx([0.2e-6, 0.3e-6, 0.4e-6, 0.5e-6, 0.6e-6])
    text = json.dumps(result.to_json(), allow_nan=False)
    assert json.loads(text)["schema"] == 1
    assert len(result.table()) == 7


def test_theory_beside_the_rig_files_own_values() -> None:
    linear = {"bearing1.x": {"kL": Setting(1e7)}, "bearing2.x": {"c": Setting(3.0)}}
    cubic = EffectUse("cubic", {"bearing1.x": {"kNL": Setting(1.3e18)}})
    model = Model((Channel("b1x", "bearing1", "x"),), (150.0, 8000.0), bearing=SKF6200, linear=linear, effects=(cubic,))
    (row,) = theory(model).fitted
    assert row.kL.value == 1e7
    assert row.kNL is not None
    assert row.kNL.value == 1.3e18
    assert row.preload_sd is None


def test_no_geometry_is_said() -> None:
    with pytest.raises(DataError, match="ball_diameter_mm"):
        theory(Model((Channel("b1x", "bearing1", "x"),), (150.0, 8000.0)))


def test_a_line_contact_is_refused() -> None:
    with pytest.raises(ValueError, match="groove"):
        raceways(BearingGeometry(6, 6e-3, 20e-3, 1.0e-3))
