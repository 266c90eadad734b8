"""A fit and a diagnosis of a flexible rotor given by matrices, on the simulated example."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.rig.rig import load_rig
from estimator import diagnose
from estimator.errors import DataError, ModelError
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.moments.planes import planes_of
from estimator.likelihood.fitting.fitted_values import fitted_parameters
from estimator.model.rig import EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

RATE_HZ = 12800.0
EXAMPLE_MODEL = load_rig(Path(__file__).parents[4] / "configs" / "two_discs.toml").model


@pytest.fixture(scope="module")
def linear() -> tuple[Model, np.ndarray]:
    model = replace(EXAMPLE_MODEL, effects=())
    return model, simulate(model, RATE_HZ, 5.0, seed=1, noise=0.005)


def test_each_bearing_has_its_value_though_all_move_in_many_modes(linear: tuple[Model, np.ndarray]) -> None:
    model, y = linear
    found = fitted_parameters(fit_all_effects(model, y, RATE_HZ).point)
    for place, settings in model.linear.items():
        for key in ("kL", "c"):
            value, sd = found[f"{place}.{key}"].value, found[f"{place}.{key}"].sd
            assert value is not None
            assert sd is not None
            assert sd < (0.01 if key == "kL" else 0.2) * value
            assert value == pytest.approx(settings[key].value, abs=4.0 * sd)


def test_a_band_without_a_mode_that_strains_the_bearings_is_refused(linear: tuple[Model, np.ndarray]) -> None:
    model, y = linear
    with pytest.raises(DataError, match="no resonance of drive"):
        fit_all_effects(replace(model, band=(1800.0, 2700.0)), y, RATE_HZ)


def test_a_rotor_is_not_judged_by_one_of_its_bearings(linear: tuple[Model, np.ndarray]) -> None:
    model, y = linear
    with pytest.raises(DataError, match=r"free is not measured, but its motion .*: measure all bearings"):
        fit_all_effects(replace(model, channels=model.channels[:2]), y[:, :2], RATE_HZ)


def test_the_methods_of_the_paper_say_that_they_do_not_know_such_a_rotor(linear: tuple[Model, np.ndarray]) -> None:
    with pytest.raises(ModelError, match='method = "spectral"'):
        planes_of(linear[0])


@pytest.mark.slow
@pytest.mark.parametrize("disc", ["fan", "pulley"])
def test_an_imbalance_is_found_at_its_disc(disc: str) -> None:
    model = replace(EXAMPLE_MODEL, band=(30.0, 3000.0))
    hidden = EffectUse("imbalance", {disc: {"a": Setting(3.0), "b": Setting(1.0)}})
    y = simulate(replace(model, effects=(*model.effects, hidden)), RATE_HZ, 20.0, seed=2, noise=0.005)
    found = diagnose(model, y, RATE_HZ)
    assert found.verdict == "imbalance"
    assert found.ranking[0].at == (disc,)
    assert found.ranking[0].parameters[f"{disc}.imbalance.a"].value == pytest.approx(3.0, abs=0.05)
    assert "rotor_untried" in {message.code for message in found.messages}
