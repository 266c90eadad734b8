"""The fit of a working point: sensor noise beside the parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing

from estimator.likelihood.fitting import gauss_newton
from estimator.likelihood.fitting.fitted_values import fitted_parameters
from estimator.likelihood.fitting.noise_level import grid_minimum
from estimator.likelihood.motion.located_law import located_laws
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path import working_point
from estimator.model.rig import EffectUse, Setting
from estimator.signals import band_limit
from estimator.simulation.simulator import simulate


def test_the_noise_is_that_of_the_values_after_a_step() -> None:
    """Of those before it, noise and stiffness went to and fro, a round apart."""
    rig = one_bearing()
    data = prepare(rig, simulate(rig, RATE, 10.0, seed=4, noise=0.1, full_scale=490.5), RATE)
    point = gauss_newton.fit_model(data, located_laws(rig, data))
    S = np.array([rig.linear[p]["S"].value or 0.0 for p in rig.places])
    true = 0.1**2 / (RATE / 2) / S
    np.testing.assert_allclose(point.nu, true, rtol=0.4)
    off = working_point.point_at(point.data, 0.9 * point.kL, 1.2 * point.c, point.nu, point.S, list(point.placed))
    np.testing.assert_allclose(gauss_newton.sensor_noise_ratio(off)[0], true, rtol=0.4)


def test_a_law_that_was_still_zero_can_be_looked_at_on_part_of_the_record() -> None:
    """It has no column for its gap yet, and the part has none either."""
    rig = one_bearing()
    y = simulate(rig, RATE, 4.0, seed=1, noise=0.02, full_scale=490.5)
    uses = {f"bearing1.{d}": {"k": Setting(0.0), "gap": Setting(2e-7)} for d in "xy"}
    model = replace(rig, effects=(*rig.effects, EffectUse("clearance", uses)))
    data = prepare(model, y, RATE)
    point = gauss_newton.fit_model(data, located_laws(model, data), rounds=0)
    part = working_point.point_on_part(point, 1.0)
    assert part.data.blocks < point.data.blocks
    assert part.whitened.names == point.whitened.names


def test_the_least_of_a_grid_lies_between_its_points_and_a_flat_one_stays() -> None:
    grid = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 31)])
    for truth in (0.02, 0.5, 7.0):
        assert grid_minimum(grid, np.log(np.maximum(grid, 1e-9) / truth) ** 2) == pytest.approx(truth, rel=1e-6)
    flat = np.ones(grid.size)
    flat[5:9] = 0.0
    assert grid_minimum(grid, flat) <= grid[5] * 1.3
    assert grid_minimum(grid, grid) == 0.0
    assert grid_minimum(grid, -grid) == grid[-1]


def test_what_laws_do_not_see_is_that_of_the_rotor_behind_strong_noise() -> None:
    """From a stiffness that noise in the displacement had halved it was twice that, and a clearance 40 % too wide."""
    rig = replace(one_bearing(), effects=(), band=(120.0, 8000.0))
    m, kL, c, S = 0.2, *(rig.linear["bearing1.y"][name].value or 0.0 for name in ("kL", "c", "S"))
    rms = np.sqrt(0.03 * S / m**2 * RATE / 2)  # integrated, as much as the displacement itself
    data = prepare(rig, simulate(rig, RATE, 8.0, seed=4, noise=float(rms)), RATE)
    own = band_limit.out_of_band_sd(*(np.array([z]) for z in (m, c, kL, S)), rig.band, RATE, ["acceleration"])
    point = gauss_newton.fit_model(data, located_laws(rig, data))
    assert point.data.out_of_band_sd[1] == pytest.approx(own[0], rel=0.1)


def test_without_its_rows_a_fit_says_the_same_and_another_begins_from_it() -> None:
    """Held whole while the next was made it took improve of a minute from 1.45 to 1.93 GB."""
    rig = one_bearing()
    data = prepare(rig, simulate(rig, RATE, 4.0, seed=1, noise=0.02, full_scale=490.5), RATE)
    point = gauss_newton.fit_model(data, located_laws(rig, data))
    bare = point.without_rows()
    assert bare.data.x.size == bare.force.size == bare.whitening.data.x.size == 0
    assert fitted_parameters(bare) == fitted_parameters(point)
    again = gauss_newton.fit_model(replace(data), list(bare.placed), bare)
    np.testing.assert_allclose(again.kL, point.kL, rtol=1e-4)
