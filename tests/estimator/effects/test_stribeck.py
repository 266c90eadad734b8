"""Stribeck friction is simulated, added and fitted as any effect: nothing but its file and its line makes it so."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden_effects import RATE, ROOT, one_bearing

from daq.commands.cli.app import main
from daq.rig.edit import with_effect as with_effect_in_file
from daq.rig.rig import Rig, load_rig
from estimator import CATALOGUE, diagnose, fit, simulate
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.model.rig import EffectUse

RECORD_S = 6.0
SHORT_S = 3.0  # where nothing is measured
EFFECT = CATALOGUE["stribeck"]


def test_its_parameters_come_back_from_a_fit() -> None:
    rig = one_bearing()
    truth = strengths(EFFECT, size(rig, "bearing1.x", RATE), 0.06)
    y = simulate(with_effect(rig, EFFECT, truth, "bearing1.x"), RATE, RECORD_S, seed=6)
    text = with_effect_in_file(load_rig(ROOT / "configs/tiwari_vyas_1997.toml"), "stribeck", ["bearing1.x"])
    (use,) = (u for u in Rig.parse(text).model.effects if u.name == "stribeck")
    found = fit(replace(rig, effects=(*rig.effects, use)), y, RATE).parameters
    for name in ("fc", "df"):
        parameter = found[f"bearing1.x.stribeck.{name}"]
        assert parameter.value is not None, name
        assert parameter.sd is not None, name
        assert abs(parameter.value - truth[name]) < 4 * parameter.sd, name


def test_its_page_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["effects", "stribeck"]) == 0
    printed = capsys.readouterr().out
    assert EFFECT.equation in printed
    assert "given" in printed


@pytest.mark.slow
def test_a_diagnosis_names_it_beside_dry_friction() -> None:
    """Where coulomb is in the model, what Stribeck friction adds to it is on trial."""
    rig = one_bearing()
    truth = {"fc": 0.05, "df": 0.15, "vs": 5e-4}
    y = simulate(with_effect(rig, EFFECT, truth, "bearing1.x"), RATE, RECORD_S, seed=5)
    dry = replace(rig, effects=(*rig.effects, EffectUse("coulomb", {"bearing1.x": {}})))
    found = diagnose(dry, y, RATE)
    assert found.verdict == "stribeck"
    short = y[: round(SHORT_S * RATE)]
    assert "stribeck" not in {entry.effect for entry in diagnose(rig, short, RATE).ranking}, "coulomb is not there"
