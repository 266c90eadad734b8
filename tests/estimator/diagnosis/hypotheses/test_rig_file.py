"""Mistakes in the rig file, shown by the cross spectra of two bearings on one shaft."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden_effects import ROOT

from daq.rig.rig import load_rig
from estimator.diagnosis.hypotheses.rig_changes import (
    InvertedChannel,
    ScaledMass,
    ScaledSpring,
    SwappedChannels,
    coupling_hypotheses,
    is_common_slip,
)
from estimator.diagnosis.hypotheses.rig_file import likeliest_mistake
from estimator.diagnosis.verdict.mistake import explaining_mistake
from estimator.model.rig import EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

RATE_HZ = 12800.0


def coupled() -> Model:
    """Two caps in one direction on a shaft as stiff as the bearings."""
    rig = load_rig(ROOT / "configs/strong_shaft.toml").model
    channels = tuple(c for c in rig.channels if c.direction == "x")
    linear = {c.place: {"kL": Setting(1e7), "c": Setting(40.0), "S": Setting(9e-5)} for c in channels}
    mass = {"disc": 0.515, "bearing1": 0.2, "bearing2": 0.22}
    return replace(rig, channels=channels, mass=mass, linear=linear, effects=(), band=(150.0, 4500.0))


@pytest.mark.parametrize("hypothesis", [ScaledMass("bearing1"), ScaledSpring()])
def test_a_factor_changes_one_number_and_back(hypothesis: ScaledMass | ScaledSpring) -> None:
    model = coupled()
    changed = hypothesis.apply(hypothesis.apply(model, (2.0, 0.1)), (0.5, 0.1))
    assert changed.mass == pytest.approx(dict(model.mass))
    assert changed.shaft_stiffness == pytest.approx(model.shaft_stiffness)
    (parameter,) = hypothesis.parameters(model, (2.0, 0.1)).values()
    assert parameter.value in (2 * model.mass["bearing1"], 2 * model.shaft_stiffness)
    assert (2.0, 1.0) in hypothesis.propose(model)


@pytest.mark.parametrize(
    ("values", "common"),
    [
        ((), True),
        ((2.1, 0.1), True),
        ((0.5, 0.1), True),
        ((11.0, 0.1), True),
        ((0.67, 0.1), False),
        ((5.0, 0.1), False),
    ],
)
def test_a_common_slip_is_a_factor_of_two_or_ten_a_swap_or_an_inversion(
    values: tuple[float, ...], common: bool
) -> None:
    assert is_common_slip(values) is common


@pytest.mark.parametrize(
    ("factor", "mass", "spring"),
    [
        (1.05, False, False),
        (1.4, True, True),
        (0.4, True, True),
        (0.16, False, True),
        (8.0, True, True),
        (20.0, False, False),
    ],
)
def test_a_mass_is_wrong_by_a_slip_and_a_shaft_by_any_factor(factor: float, mass: bool, spring: bool) -> None:
    assert ScaledMass("bearing1").is_slip((factor, 0.02)) is mass
    assert ScaledSpring().is_slip((factor, 0.02)) is spring


def test_channels_change_places_and_signs() -> None:
    model = coupled()
    swapped = SwappedChannels(0, 1).apply(model, ())
    assert [c.place for c in swapped.channels] == ["bearing2.x", "bearing1.x"]
    assert [c.name for c in swapped.channels] == [c.name for c in model.channels]
    assert InvertedChannel(0).apply(model, ()).effects[-1].at == ("bearing1.x",)


def test_one_bearing_alone_has_no_witness() -> None:
    model = coupled()
    assert coupling_hypotheses(model)
    assert not coupling_hypotheses(replace(model, shaft="none"))
    assert not coupling_hypotheses(replace(model, channels=model.channels[:1]))


def test_a_mass_of_twice_its_value_is_named_and_a_true_rig_file_is_left_alone() -> None:
    true = replace(coupled(), band=(600.0, 2400.0))
    y = simulate(true, RATE_HZ, 3.0, seed=3, noise=0.02)
    trial = likeliest_mistake(true, y, RATE_HZ)
    assert trial.mistake is None
    assert trial.tried == trial.asked == len(coupling_hypotheses(true))
    typed = replace(true, mass={**true.mass, "bearing1": 0.4})
    found = likeliest_mistake(typed, y, RATE_HZ).mistake
    assert found is not None
    assert found.hypothesis == ScaledMass("bearing1")
    assert found.hypothesis.parameters(typed, found.values)["rig.mass.bearing1"].value == pytest.approx(0.2, rel=0.1)
    assert found.gain_nats > 100.0


@pytest.mark.slow
def test_an_inverted_channel_is_named_beside_structural_modes() -> None:
    true = replace(coupled(), band=(600.0, 2400.0))
    y = simulate(with_support_modes(true), RATE_HZ, 3.0, seed=3, noise=0.02)
    y[:, 0] *= -1.0
    found = likeliest_mistake(true, y, RATE_HZ).mistake
    assert found is not None
    assert found.hypothesis == InvertedChannel(0)
    assert "b1x" in found.hypothesis.text(true, found.values)


def test_a_trial_that_is_cut_says_how_many_mistakes_were_tried() -> None:
    true = replace(coupled(), band=(600.0, 2400.0))
    y = simulate(true, RATE_HZ, 3.0, seed=3, noise=0.02)
    found, (said,) = explaining_mistake(true, y, RATE_HZ, None, max_work=3e5)
    assert found is None
    assert said.code == "mistakes_untried"
    assert f"0 of {len(coupling_hypotheses(true))} were tried" in said.text


def test_channels_that_are_swapped_across_the_bearings_are_two_answers() -> None:
    model = coupled()
    across = tuple(replace(c, name=c.name.replace("x", "y"), direction="y") for c in model.channels)
    both = replace(model, channels=(*model.channels, *across), linear={}, band=(600.0, 2400.0))
    swaps = [h for h in coupling_hypotheses(both) if isinstance(h, SwappedChannels)]
    assert {(h.first, h.second) for h in swaps} == {(0, 2), (0, 3), (1, 2), (1, 3)}


def test_masses_that_the_shaft_has_to_give_leave_no_witness() -> None:
    model = coupled()
    assert not coupling_hypotheses(replace(model, mass={"disc": 0.515, "bearing1": 0.2}))


def with_support_modes(model: Model) -> Model:
    """The rig with a mode of the support under each bearing."""
    modes = {"bearing1.x": (0.6, 900.0, 0.02), "bearing2.x": (0.9, 1500.0, 0.02)}
    names = ("mass", "frequency", "damping")
    settings = {
        place: {name: Setting(value) for name, value in zip(names, mode, strict=True)} for place, mode in modes.items()
    }
    return replace(model, effects=(EffectUse("pedestal", settings),))
