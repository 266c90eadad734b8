"""The whole model on a record: what is no law of the states is found too, whatever the rig file starts from."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden_effects import RATE, one_bearing, record

from estimator import spectral
from estimator.compare import compare
from estimator.effects import CATALOGUE
from estimator.effects.strength import size, strengths
from estimator.model import EffectUse, Model, Setting

# effect, strength, where, and how near its numbers come: standard deviations, or a part of the value for those
# whose law is not quite that of a sampled record
CASES = [
    ("line", ("bearing1.x", "bearing1.y"), ("a", "b", "frequency")),
    ("misalignment", ("bearing1.x", "bearing1.y"), ("a", "b")),
    ("local_defect", ("bearing1.x", "bearing1.y"), ("strike", "order", "width")),
    ("coloured_excitation", ("bearing1.x", "bearing1.y"), ("gain", "corner")),
    ("sensor_resonance", ("bearing1.x",), ("frequency", "quality")),
    ("sensor_noise", ("bearing1.x",), ("rms",)),
    ("pedestal", ("bearing1.x", "bearing1.y"), ("mass", "frequency", "damping")),
]


@pytest.fixture(scope="module")
def rig() -> Model:
    return one_bearing()


@pytest.mark.parametrize(("name", "where", "numbers"), CASES, ids=[c[0] for c in CASES])
def test_an_effect_added_without_numbers_is_fitted(
    rig: Model, name: str, where: tuple[str, ...], numbers: tuple[str, ...]
) -> None:
    y = record(rig, name, 0.06)
    truth = strengths(CATALOGUE[name], size(rig, "bearing1.x", RATE), 0.06, rig, len(y) / RATE)
    added = replace(rig, effects=(*rig.effects, EffectUse(name, {place: {} for place in where})))
    fit = spectral.fit(added, y, RATE)
    for key in numbers:
        p = fit.parameters[f"{where[0]}.{name}.{key}"]
        assert p.identifiable, (key, p.reason)
        assert abs((p.value or 0.0) - truth[key]) < 4 * (p.sd or 0.0) + 1e-3 * abs(truth[key]), (key, p, truth[key])


def test_the_true_model_with_a_strong_line_is_adequate(rig: Model) -> None:
    """The laws see the whole motion: a line taken out of it first would leave 3 kNL x x_line^2 behind."""
    y = record(rig, "line", 0.06)
    added = replace(rig, effects=(*rig.effects, EffectUse("line", {"bearing1.x": {}, "bearing1.y": {}})))
    assert compare(added, y, RATE).adequate
    assert not compare(rig, y, RATE).adequate


def test_what_a_record_does_not_have_is_said(rig: Model) -> None:
    y = record(rig, "sensor_gain", 0.0)
    uses = (
        EffectUse("line", {"bearing1.x": {}}),
        EffectUse("sensor_gain", {"bearing1.x": {"error": Setting()}}),
        EffectUse("coloured_excitation", {"bearing1.y": {"corner": Setting(500.0, fixed=True)}}),
    )
    fit = spectral.fit(replace(rig, effects=(*rig.effects, *uses)), y, RATE)
    assert fit.parameters["bearing1.x.line.frequency"].reason == "not told from zero by this record"
    assert "fixed = true" in fit.parameters["bearing1.x.sensor_gain.error"].reason
    assert fit.parameters["bearing1.y.coloured_excitation.gain"].value is None
    assert fit.parameters["bearing1.y.coloured_excitation.corner"].value == 500.0
    assert fit.parameters["bearing1.x.kL"].identifiable
