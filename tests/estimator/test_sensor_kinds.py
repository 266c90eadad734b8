"""Noise that is white in the unit of a sensor grows with frequency as a force: so it is told from a shaped force."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden_effects import RATE, one_bearing

from estimator.compare import compare
from estimator.simulate import simulate
from estimator.whole import fit_whole


@pytest.mark.parametrize(("kind", "noise"), [("velocity", 1e-5), ("displacement", 4e-10)])
def test_a_noisy_sensor_of_another_kind(kind: str, noise: float) -> None:
    rig = one_bearing()
    rig = replace(rig, channels=tuple(replace(c, kind=kind) for c in rig.channels))
    y = simulate(rig, RATE, 12.0, seed=5, noise=noise)
    point = fit_whole(rig, y, RATE).point
    found = point.nu * point.S
    assert found == pytest.approx([noise**2 / (RATE / 2)] * 2, rel=0.25), "one-sided PSD, unit^2/Hz"
    assert compare(rig, y, RATE).adequate
