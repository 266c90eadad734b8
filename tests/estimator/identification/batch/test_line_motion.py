"""Lines at which the bearings deflect, and lines at which they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing

from estimator.identification.batch.full_fit import FullFit, fit_all_effects
from estimator.model.rig import EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

LINE_HZ = 200.0
RECORD_S = 6.0
STRENGTH_N_M3 = 2.5e18


@pytest.fixture(scope="module")
def rig() -> Model:
    """A bearing with a cubic spring at 1.1 kHz."""
    bare = one_bearing()
    return replace(bare, effects=(EffectUse("cubic", {p: {"kNL": Setting(STRENGTH_N_M3)} for p in bare.places}),))


def fitted(rig: Model, y: np.ndarray, *, lines_deflect: bool) -> FullFit:
    loose = {p: {"kNL": Setting(None)} for p in rig.places}
    found = fit_all_effects(replace(rig, effects=(EffectUse("cubic", loose),)), y, RATE)
    assert any(band.low_hz < LINE_HZ < band.high_hz for band in found.model.line_bands)
    assert found.model.deflects_at_lines is lines_deflect
    return found


def error_sd(found: FullFit) -> float:
    """rms error of the cubic stiffness of all places, standard deviations."""
    values = [p for name, p in found.parameters.items() if name.endswith("kNL")]
    return float(np.sqrt(np.mean([((p.value - STRENGTH_N_M3) / p.sd) ** 2 for p in values])))


def test_no_law_sees_the_hum_of_a_sensor(rig: Model) -> None:
    y = simulate(rig, RATE, RECORD_S, seed=4)
    hum = 0.1 * y.std() * np.sin(2 * np.pi * LINE_HZ * np.arange(len(y)) / RATE)
    assert error_sd(fitted(rig, y + hum[:, None], lines_deflect=False)) < 2.5


def test_a_law_sees_the_deflection_by_a_periodic_force(rig: Model) -> None:
    force = {p: {"frequency": Setting(LINE_HZ), "a": Setting(4.0), "b": Setting(0.0)} for p in rig.places}
    y = simulate(replace(rig, effects=(*rig.effects, EffectUse("line", force))), RATE, RECORD_S, seed=4)
    assert error_sd(fitted(rig, y, lines_deflect=True)) < 2.5
