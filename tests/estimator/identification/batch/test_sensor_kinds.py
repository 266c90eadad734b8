"""Noise that is white in the unit of a sensor grows with frequency as a force, unlike a shaped force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, ROOT, one_bearing

from daq.rig.rig import load_rig
from estimator.diagnosis.comparison.comparison import compare
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.structure import spectral_shape
from estimator.model.rig import EffectUse, Setting
from estimator.simulation.simulator import simulate


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "noise"), [("velocity", 1e-5), ("displacement", 4e-10)])
def test_a_noisy_sensor_of_another_kind(kind: str, noise: float) -> None:
    rig = one_bearing()
    rig = replace(rig, channels=tuple(replace(c, kind=kind) for c in rig.channels))
    y = simulate(rig, RATE, 12.0, seed=5, noise=noise)
    point = fit_all_effects(rig, y, RATE).point
    found = point.nu * point.S
    assert found == pytest.approx([noise**2 / (RATE / 2)] * 2, rel=0.25), "one-sided PSD, unit^2/Hz"
    assert compare(rig, y, RATE).adequate


def test_a_displacement_sensor_that_is_noisier_than_its_neighbour_is_named() -> None:
    """Its noise is loudest at the top of the band: there it is compared with the force, not at the low end."""
    rig = one_bearing()
    rig = replace(rig, channels=tuple(replace(c, kind="displacement") for c in rig.channels))
    y = simulate(rig, RATE, 12.0, seed=5, noise=1e-10)
    y[:, 0] += 4e-9 * np.random.default_rng(1).standard_normal(len(y))
    found = spectral_shape.find_spectral_shapes(rig, fit_all_effects(rig, y, RATE).point)
    assert [(s.effect, s.at) for s in found] == [("sensor_noise", ("bearing1.x",))]
    rms = found[0].settings["bearing1.x"]["rms"]
    assert rms.value == pytest.approx(4e-9, rel=0.05)
    assert rms.unit == "m"


@pytest.mark.parametrize("rms", [0.35, 0.38, 0.42, 0.45])
def test_the_noise_of_a_sensor_is_no_point_of_a_grid(rms: float) -> None:
    """It was sought on a grid of 31 %: up to 7 % off, four standard deviations of 20 s."""
    rig = one_bearing()
    y = simulate(rig, RATE, 6.0, seed=5)
    y += rms * np.random.default_rng(2).standard_normal(y.shape)
    point = fit_all_effects(rig, y, RATE).point
    found = [spectral_shape.sensor_noise_rms(point, i) for i in range(2)]
    off = [(p.value - rms) / p.sd for p in found if p.value is not None and p.sd is not None]
    assert np.sqrt(np.mean(np.square(off))) < 1.7


def test_sensors_of_two_kinds_are_not_each_others_measure() -> None:
    """An accelerometer was 9500 times as noisy as the displacement sensor at the other bearing: m/s^2 over m."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    kinds = {"bearing1": "acceleration", "bearing2": "displacement"}
    rig = replace(rig, channels=tuple(replace(c, kind=kinds[c.node]) for c in rig.channels))
    point = fit_all_effects(rig, simulate(rig, RATE, 6.0, seed=5), RATE).point
    quiet = np.array([0.02, 0.02, 1e-10, 1e-10]) ** 2 / (RATE / 2)
    assert not spectral_shape.find_noisy_sensors(rig, point, quiet, ())


def test_a_sensor_of_a_known_shape_is_no_measure_of_its_neighbours_noise() -> None:
    """Beside a resonance that was fitted the noise of that sensor was 0, and a sound one was 31 times as noisy."""
    rig = one_bearing()
    point = fit_all_effects(rig, simulate(rig, RATE, 6.0, seed=5), RATE).point
    noise = np.array([0.0, 0.5]) ** 2 / (RATE / 2)
    resonant = EffectUse("sensor_resonance", {"bearing1.x": {"frequency": Setting(7e3), "quality": Setting(8.0)}})
    assert [s.at for s in spectral_shape.find_noisy_sensors(rig, point, noise, ())] == [("bearing1.y",)]
    assert not spectral_shape.find_noisy_sensors(replace(rig, effects=(*rig.effects, resonant)), point, noise, ())
