"""Numbers beside masses that the rig file leaves out and the shaft gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from daq.rig.rig import load_rig
from estimator.identification.batch import spectral
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.model.rig import EffectUse, Model, Setting
from estimator.results import is_of_place
from estimator.simulation.simulator import simulate

ROOT = Path(__file__).parents[4]
RATE = 25600.0


def rotors() -> tuple[Model, Model]:
    """As a rig file has it that leaves the masses of the caps out, and as it is."""
    rig = replace(load_rig(ROOT / "configs/strong_shaft.toml").model, shaft_stiffness=1e6)
    truth = {p: {"kL": Setting(1e7), "c": Setting(57.0), "S": Setting(9e-5)} for p in rig.places}
    cubic = EffectUse("cubic", {p: {"kNL": Setting(3.5e18)} for p in rig.places})
    mass = {"disc": 0.515, "bearing1": 0.2, "bearing2": 0.22}
    return rig, replace(rig, mass=mass, linear=truth, effects=(cubic,))


def test_standard_deviations_hold_those_of_the_masses() -> None:
    """Beside given masses those of kL and S were 30 times too small; a fit that has the masses free is the check."""
    rig, known = rotors()
    y = simulate(known, RATE, 6.0, seed=4, noise=0.02)
    found, free = fit_all_effects(rig, y, RATE).parameters, spectral.fit_spectral(rig, y, RATE).parameters
    for name, p in found.items():
        assert 0.6 < (p.sd or 0.0) / (free[name].sd or 0.0) < 1.7, name


def test_a_number_belongs_to_its_place_or_to_all_of_its_node() -> None:
    names = ("bearing1.x.kL", "bearing1.y.kL", "bearing1.rub.gap", "bearing2.x.kL", "disc.crack.loss")
    assert [is_of_place(name, "bearing1.x") for name in names] == [True, False, True, False, False]
