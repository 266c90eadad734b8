"""Structural modes in two forms that move the cap alike."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import ModelError
from estimator.model.background import BearingBackground, StructuralMode, all_under_bearing

S = 2j * np.pi * np.linspace(20.0, 700.0, 400)


def driving_stiffness(stiffness: float, damping: float, modes: list[StructuralMode]) -> np.ndarray:
    """(f,) N/m at the cap, without its inertia."""
    own = BearingBackground(
        modes=tuple(modes), stiffness=stiffness, damping=damping, f_hz=np.ones(2), psd_rel=np.ones(2)
    )
    return (stiffness + damping * S) * own.deflection(S) + own.attached_stiffness(S)


def modes(damping: float) -> list[StructuralMode]:
    return [
        StructuralMode(form="attached", mass=1.6, frequency_hz=105.0, damping=damping),
        StructuralMode(form="attached", mass=1.5, frequency_hz=192.0, damping=damping),
        StructuralMode(form="support", mass=120.0, frequency_hz=300.0, damping=damping),
    ]


def test_masses_on_the_cap_are_modes_under_a_stiffer_bearing() -> None:
    stiffness, damping, under = all_under_bearing(2.5e6, 1.0, modes(1e-5))
    assert stiffness > 2.5e6
    assert [mode.form for mode in under] == ["support"] * 3
    given, found = driving_stiffness(2.5e6, 1.0, modes(1e-5)), driving_stiffness(stiffness, damping, under)
    assert np.quantile(np.abs(found / given - 1.0), 0.98) < 1e-2, "all but the nearest neighbours of a zero"


def test_modes_under_the_bearing_stay_as_they_are() -> None:
    stiffness, damping, under = all_under_bearing(2.5e6, 300.0, modes(0.01)[2:])
    assert (stiffness, damping) == pytest.approx((2.5e6, 300.0), rel=1e-9)
    assert under[0].frequency_hz == pytest.approx(300.0, rel=1e-6)
    assert under[0].mass == pytest.approx(120.0, rel=1e-6)


def test_an_overdamped_bearing_has_no_equivalent() -> None:
    with pytest.raises(ModelError, match="equivalent"):
        all_under_bearing(1.0e3, 1.0e5, modes(0.02))
