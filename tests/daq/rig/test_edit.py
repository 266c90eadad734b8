"""Editing a rig file: what stands in it stays as it is, whatever is added, removed or fitted."""

import difflib
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.base.contract.errors import ConfigError
from daq.rig.edit import with_effect, with_values, without_effect
from daq.rig.rig import Rig, load_rig
from estimator.effects import CATALOGUE
from estimator.results import Parameter

PAPER = Path(__file__).parents[3] / "configs" / "tiwari_vyas_1997.toml"
COMMENT = re.compile(r"#.*")


def changed(before: str, after: str) -> list[str]:
    diff = difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm="")
    return [line for line in diff if line[:1] in "+-" and line[:3] not in ("+++", "---")]


def test_add_changes_the_list_and_nothing_else() -> None:
    rig = load_rig(PAPER)
    lines = changed(rig.text, with_effect(rig, "coulomb"))
    assert [line[:1] for line in lines] == ["-", "+"]
    assert lines[1].startswith('+effects = ["cubic", "coulomb"]')
    assert lines[1].endswith("# linear stiffness and damping are always there")


def test_add_at_a_node_writes_where_it_acts() -> None:
    rig = load_rig(PAPER)
    text = with_effect(rig, "clearance", ["bearing2"])
    assert Rig.parse(text).model.effects[1].at == ("bearing2.x", "bearing2.y")
    assert "+[model.clearance]" in changed(rig.text, text)
    assert '+at = ["bearing2"]' in changed(rig.text, text)
    more = with_effect(Rig.parse(text), "clearance", ["bearing1.x"])
    assert Rig.parse(more).model.effects[1].at == ("bearing1.x", "bearing2.x", "bearing2.y")


def test_values_given_with_an_effect_stand_at_their_places() -> None:
    text = with_effect(load_rig(PAPER), "coulomb", ["bearing1.x"], {"bearing1.x": {"fc": 0.08}})
    (use,) = [u for u in Rig.parse(text).model.effects if u.name == "coulomb"]
    assert use.parameters["bearing1.x"]["fc"].value == 0.08


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_every_effect_of_the_catalogue_comes_and_goes_without_a_trace(name: str) -> None:
    rig = load_rig(PAPER)
    base = rig if name != "cubic" else Rig.parse(without_effect(rig, "cubic"))
    there = Rig.parse(with_effect(base, name))
    assert there.model.effects[-1].name == name
    assert there.model.effects[-1].at
    assert without_effect(there, name) == base.text


def test_remove_takes_the_tables_of_the_effect_and_leaves_the_comments_of_others() -> None:
    rig = load_rig(PAPER)
    text = rig.text.replace("[[channel]]", "# The four sensors, numbered from the motor.\n[[channel]]", 1)
    text = text.replace("[model.cubic]", "[model.cubic.bearing1.x]\nkNL = 1e18\n[model.cubic]")
    after = without_effect(Rig.parse(text), "cubic")
    assert "# The four sensors, numbered from the motor.\n[[channel]]" in after
    assert "kNL" not in after
    assert Rig.parse(after).model.effects == ()


def test_remove_at_one_node_keeps_the_other() -> None:
    text = load_rig(PAPER).text.replace("[model.cubic]", "[model.cubic.bearing1.x]\nkNL = 1e18\n[model.cubic]")
    after = without_effect(Rig.parse(text), "cubic", ["bearing1"])
    (use,) = Rig.parse(after).model.effects
    assert use.at == ("bearing2.x", "bearing2.y")
    assert "\n[model.cubic.bearing1.x]" not in after


def test_a_candidate_is_no_part_of_the_model_until_it_is_added() -> None:
    law = '\n[[model.custom]]\nname = "mine"\nexpression = "k*x"\nparameters = { k = 1.0 }\ncandidate = true\n'
    rig = Rig.parse(load_rig(PAPER).text + law)
    assert [u.name for u in rig.model.candidates] == ["mine"]
    assert "mine" not in [u.name for u in rig.model.effects]
    added = Rig.parse(with_effect(rig, "mine", ["bearing1"]))
    assert not added.model.candidates
    (use,) = [u for u in added.model.effects if u.name == "mine"]
    assert use.at == ("bearing1.x", "bearing1.y")
    with pytest.raises(ConfigError, match="a law of this file already"):
        with_effect(added, "mine")


def test_a_custom_law_is_removed_whole_and_its_neighbour_stays() -> None:
    law = '\n# A {0} of ours.\n[[model.custom]]\nname = "{0}"\nexpression = "k*x"\nparameters = {{ k = 1.0 }}\n'
    text = load_rig(PAPER).text.replace("[model.cubic]", law.format("one") + law.format("two") + "\n[model.cubic]", 1)
    after = without_effect(Rig.parse(text), "one")
    assert [u.name for u in Rig.parse(after).model.effects] == ["cubic", "two"]
    assert "# A two of ours.\n[[model.custom]]" in after


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda rig: with_effect(rig, "cubic"), "is in the model already"),
        (lambda rig: with_effect(rig, "coulom"), 'did you mean "coulomb"'),
        (lambda rig: with_effect(rig, "coulomb", ["bearing3"]), 'cannot act at "bearing3"'),
        (lambda rig: with_effect(rig, "cubic", ["bearing1"]), "acts at bearing1.x, bearing1.y already"),
        (lambda rig: without_effect(rig, "coulomb"), "is not in the model"),
        (lambda rig: without_effect(rig, "cubc"), 'did you mean "cubic"'),
    ],
)
def test_what_cannot_be_done_is_said(call: object, said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        call(load_rig(PAPER))  # type: ignore[operator]


def test_fitted_values_take_the_place_of_the_old_ones() -> None:
    rig = load_rig(PAPER)
    fitted = {
        "bearing1.x.kL": Parameter(10.123456e6, 1e4, "N/m"),
        "bearing1.y.c": Parameter(value=None, sd=None, unit="N s/m", identifiable=False, reason="too short"),
        "bearing2.x.cubic.kNL": Parameter(1.5e18, 1e16, "N/m^3"),
        "bearing1.x.m": Parameter(0.21, 0.01, "kg"),  # known already: stays
    }
    text = with_values(rig, fitted)
    model = Rig.parse(text).model
    assert model.linear["bearing1.x"]["kL"].value == 10.123456e6
    assert model.linear["bearing1.y"]["c"].value == 55.0
    assert model.effects[0].parameters["bearing2.x"]["kNL"].value == 1.5e18
    assert model.effects[0].parameters["bearing1.x"]["kNL"].value == 1.3e18
    assert model.mass["bearing1"] == 0.2
    assert changed(rig.text, text)[:2] == ["-kL = 10.0e6", "+kL = 10.123456e6"]
    assert len(COMMENT.findall(text)) == len(COMMENT.findall(rig.text))


def test_a_fit_of_a_file_without_any_value() -> None:
    text = """schema = 1
[band]
low = 100.0
high = 1000.0
[model]
effects = ["clearance"]
[[channel]]
name = "a"
node = "bearing1"
direction = "x"
unit = "m/s^2"
"""
    fitted = {
        "bearing1.x.kL": Parameter(1e7, 1.0, "N/m"),
        "bearing1.x.c": Parameter(60.0, 1.0, "N s/m"),
        "bearing1.x.clearance.k": Parameter(-2.5e5, 1.0, "N/m"),
        "bearing1.x.clearance.gap": Parameter(1.25e-7, 1e-9, "m"),
        "bearing1.x.m": Parameter(0.2, 0.001, "kg"),
    }
    model = Rig.parse(with_values(Rig.parse(text), fitted)).model
    assert model.linear["bearing1.x"]["kL"].value == 1e7
    assert model.linear["bearing1.x"]["c"].value == 60.0
    assert model.effects[0].parameters["bearing1.x"]["k"].value == -2.5e5
    assert model.effects[0].parameters["bearing1.x"]["gap"].value == 1.25e-7
    assert model.cap_mass("bearing1.x") == 0.2


def test_fixed_and_limits_survive_a_fit() -> None:
    text = load_rig(PAPER).text.replace("kL = 10.0e6", "kL = { value = 10.0e6, fixed = true }")
    text = text.replace("c = 60.0", "c = { value = 60.0, min = 0.0, max = 100.0 }")
    fitted = {"bearing1.x.kL": Parameter(9e6, 1.0, "N/m"), "bearing1.x.c": Parameter(61.0, 1.0, "N s/m")}
    linear = Rig.parse(with_values(Rig.parse(text), fitted)).model.linear["bearing1.x"]
    assert (linear["kL"].value, linear["kL"].fixed) == (10.0e6, True)
    assert (linear["c"].value, linear["c"].high) == (61.0, 100.0)


@settings(max_examples=50, deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False, min_value=1e-300, max_value=1e300))
def test_any_value_is_written_to_nine_digits(value: float) -> None:
    text = with_values(load_rig(PAPER), {"bearing1.x.kL": Parameter(value, 0.0, "N/m")})
    assert Rig.parse(text).model.linear["bearing1.x"]["kL"].value == pytest.approx(value, rel=1e-8)
