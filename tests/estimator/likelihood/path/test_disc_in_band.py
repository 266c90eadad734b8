"""The disc's own resonance inside the band: the bins that no filter can hold are left out, the rest are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, ROOT

from daq.rig.rig import load_rig
from estimator.diagnosis.comparison.comparison import compare
from estimator.identification.batch import spectral
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.structure import spectral_models, spectral_shape
from estimator.model.rig import Model, Setting
from estimator.simulation.simulator import simulate


def ringing() -> Model:
    """Two bearings in one direction on a shaft of a third of their stiffness, its disc at 500 Hz."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    ks = 0.3 * 1e7
    disc = 2.0 * ks / (2 * np.pi * 500.0) ** 2
    rig = replace(rig, shaft="chain", shaft_stiffness=ks, shaft_damping=2.0, mass={**rig.mass, "disc": disc})
    return replace(rig, channels=tuple(c for c in rig.channels if c.place.endswith(".x")), effects=())


@pytest.mark.slow
def test_a_sharp_disc_resonance_in_the_band_is_no_missing_force() -> None:
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    disc = 4.0 * 4e5 / (2 * np.pi * 300.0) ** 2  # 300 Hz, Q about 2000
    rig = replace(rig, shaft="beam", shaft_stiffness=4e5, shaft_damping=0.1, mass={**rig.mass, "disc": disc})
    y = simulate(rig, RATE, 12.0, seed=3, noise=0.02, full_scale=490.5)
    found = compare(rig, y, RATE)
    assert found.adequate, [(w.channel, w.against, w.region) for w in found.where]
    for place in rig.places:
        p, truth = found.parameters[f"{place}.c"], rig.linear[place]["c"].value
        assert abs((p.value or 0.0) - truth) < 4.0 * (p.sd or 0.0), place


def test_noise_through_the_shaft_moves_no_stiffness_of_a_fit() -> None:
    """`fit` took the forces as independent: kL of the quiet bearing was 5.5 standard deviations high (20 records)."""
    rig = ringing()
    y = simulate(rig, RATE, 20.0, seed=1, noise=0.02)
    y[:, 0] += 2.0 * np.random.default_rng(101).standard_normal(len(y))
    found = spectral.fit_spectral(rig, y, RATE)
    assert found.messages == ()
    for place in rig.places:
        for name in ("kL", "c"):
            p, truth = found.parameters[f"{place}.{name}"], rig.linear[place][name].value or 0.0
            assert abs((p.value or 0.0) - truth) < 3.0 * (p.sd or 0.0), (place, name)


def test_what_rings_from_block_to_block_is_no_force_beside_the_bins_left_out() -> None:
    """Noise of a sensor through a stiff shaft, at the disc's 500 Hz: the deviance of the spectrum was 547 of 225."""
    rig = ringing()
    y = simulate(rig, RATE, 20.0, seed=3)
    y[:, 0] += 2.0 * np.random.default_rng(1).standard_normal(len(y))
    point = fit_all_effects(rig, y, RATE).point
    cells = spectral_models.cells_of(point, 0)
    level, u, _ = spectral_models.fit_base_model(point, 0, cells)
    df = cells.n.size - 4
    assert abs(-2 * level - df) < 4 * np.sqrt(2 * df)
    f = cells.w / (2 * np.pi)
    near = (f > 440.0) & (f < 560.0)
    ratio = (cells.power / spectral_models.base_model(cells, u))[near]
    assert abs(np.average(ratio, weights=cells.n[near]) - 1.0) < 4 / np.sqrt(cells.n[near].sum())
    found = [s.effect for s in spectral_shape.find_spectral_shapes(rig, point)]
    assert found == ["sensor_noise"]


def test_a_bearing_whose_cap_resonates_by_its_shaft_alone_is_not_refused() -> None:
    """By itself it would resonate at 123 Hz, below the band; held by the shaft it does so at 1100."""
    rig = replace(ringing(), shaft_stiffness=1e7, mass={"disc": 0.7, "bearing1": 0.2, "bearing2": 0.2})
    soft = {p: {**rig.linear[p], "kL": Setting(1.2e5 if p == "bearing1.x" else 9e6)} for p in rig.places}
    rig = replace(rig, linear=soft)
    found = fit_all_effects(rig, simulate(rig, RATE, 6.0, seed=2, noise=0.002), RATE).parameters["bearing1.x.kL"]
    assert abs((found.value or 0.0) - 1.2e5) < 4.0 * (found.sd or 0.0)


@pytest.mark.slow
def test_a_mode_of_the_rotor_beside_the_discs_resonance_is_no_missing_force() -> None:
    """A heavy disc on a shaft of a third of the bearings: it resonates at 220 Hz where the caps stand still, with them
    at 189, a large motion where the filters hold the shaft's reaction to some per cent: 0.9 % seemed to be missing."""
    rig = replace(ringing(), shaft_stiffness=1.42e6, shaft_damping=0.55, band=(167.0, 6200.0))
    rig = replace(rig, mass={"disc": 1.49, "bearing1": 0.137, "bearing2": 0.135})
    linear = {"bearing1.x": (4.3e6, 21.7), "bearing2.x": (3.6e6, 11.6)}
    rig = replace(
        rig, linear={p: {"kL": Setting(k), "c": Setting(c), "S": Setting(1e-4)} for p, (k, c) in linear.items()}
    )
    found = compare(rig, simulate(rig, RATE, 30.0, seed=4, noise=0.005), RATE)
    assert found.adequate, [(w.channel, w.against, w.region) for w in found.where]
    for place, (kL, _) in linear.items():
        p = found.parameters[f"{place}.kL"]
        assert abs((p.value or 0.0) - kL) < 3.5 * (p.sd or 0.0)


@pytest.mark.slow
def test_the_mode_of_a_heavy_disc_moves_no_stiffness() -> None:
    """Sharp, 1 Hz at 305 Hz: both kL were 0.4 to 0.6 % off, 4 to 7 standard deviations, and a bearing of a complete
    model seemed to follow the other."""
    rig = replace(ringing(), shaft_stiffness=3.9e6, shaft_damping=0.95, band=(175.0, 6300.0))
    rig = replace(rig, mass={"disc": 1.388, "bearing1": 0.217, "bearing2": 0.212})
    linear = {"bearing1.x": (8.92e6, 64.0, 5.3e-5), "bearing2.x": (6.26e6, 27.4, 1.1e-4)}
    rig = replace(
        rig, linear={p: {n: Setting(v) for n, v in zip(("kL", "c", "S"), z, strict=True)} for p, z in linear.items()}
    )
    found = compare(rig, simulate(rig, RATE, 60.0, seed=1, noise=0.005), RATE)
    assert found.adequate, [(w.channel, w.against, w.region) for w in found.where]
    for place, (kL, *_) in linear.items():
        p = found.parameters[f"{place}.kL"]
        assert abs((p.value or 0.0) - kL) < 3.0 * (p.sd or 0.0)
