"""The report page: complete, self-contained, and safe with any names."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import pytest
from html_page import Page
from hypothesis import given
from hypothesis import strategies as st
from made_up_results import compared, diagnosed, made_up

from daq.base.contract.errors import LogError
from daq.report.numbers import interval, number, odds, parameter, percent, prefix, unit_text
from daq.report.page import render, write_report
from daq.report.words import about_diagnosis, summary


@functools.cache
def story() -> str:
    return render(**made_up())


def test_the_whole_story_is_on_the_page() -> None:
    page = Page(story())
    assert page.tags.count("svg") == 8
    for text in (
        "from 12\N{NO-BREAK SPACE}% to 0.6\N{NO-BREAK SPACE}%", "can be seen from",
        "200 kN/m", "linear + cubic + clearance", "clearance", "stop", "run.mcap", "not identifiable",
        "|x| > 40 nm", "residual force, mN", "frequency, Hz", "displacement, nm", "10.300 ± 0.078 MN/m",
        "near full scale", "What was missing", "What is left", "What to check on the machine", "improvement stops here",
    ):  # fmt: skip
        assert text in page.text, text


@pytest.mark.slow
def test_beside_a_measured_force_the_page_does_not_say_that_only_the_response_was_measured() -> None:
    parts = made_up()
    assert "Only the response" in render(**parts)
    parts["comparison"]["simulation_rmse"] = {"b1x": 0.1}
    assert "Only the response" not in render(**parts)


def test_nothing_comes_from_the_network() -> None:
    page = Page(story())
    assert not {"script", "link", "iframe", "img", "object"} & set(page.tags)
    for name, value in page.attributes:
        if name in ("src", "href", "xlink:href", "data", "style"):
            assert not re.search(r"https?:|//|@import", value), (name, value)


def test_ids_are_unique_across_pictures() -> None:
    ids = [value for name, value in Page(story()).attributes if name == "id"]
    clip = [i for i in ids if i.startswith("p") and len(i) > 8]
    assert len(set(clip)) == len(clip)


@pytest.mark.parametrize("verdict", ["clearance", "complete", "unknown"])
def test_every_verdict_and_every_part_alone(verdict: str) -> None:
    page = Page(render("t", diagnoses=[diagnosed(verdict)]))
    assert verdict in page.text
    assert ("shape of what is missing" in page.text) == (verdict == "unknown")


def test_what_is_said_of_a_diagnosis_is_what_it_found() -> None:
    row = {"effect": "sensor_clipping", "at": ["bearing1"], "p_value": 1e-30, "missing_force_before_percent": 1.7}
    for after, falls in ((0.0, True), (1.7, False)):
        found = {"verdict": "sensor_clipping", "ranking": [row | {"missing_force_after_percent": after}]}
        assert ("falls from" in about_diagnosis(found)[0]) == falls
    unknown = {
        "verdict": "unknown",
        "ranking": [],
        "messages": ["the shaft is softer than the rig file says"],
        "message_codes": ["caps_coupled_otherwise"],
    }
    assert "softer" in about_diagnosis(unknown)[0]
    assert "typed" not in about_diagnosis(unknown)[0]


def test_only_the_contract_keys() -> None:
    bare = {k: v for k, v in compared(12.0, 1.0).items() if k not in ("curves", "spectra", "densities", "orbits")}
    bare.pop("parameters")
    bare.pop("messages")
    assert "does not contain" in Page(render("t", comparison=bare)).text
    Page(
        render(
            "t",
            comparison=bare | {"where": []},
            ladder=made_up()["ladder"],
            diagnoses=[{"schema": 1, "verdict": "complete", "ranking": []}],
        )
    )


@pytest.mark.slow
def test_a_model_that_is_adequate_does_not_fail_by_the_heading() -> None:
    assert "Where the model fails" in render("t", comparison=compared(12.0, 1.0))
    adequate = render("t", comparison=compared(0.6, 1.0))
    assert "Where the model fails" not in adequate
    assert "What the model leaves over" in adequate


def test_an_effect_at_lines_that_the_fit_leaves_out_is_not_said_to_bring_nothing_down() -> None:
    steps = [{"effects": [*more], "missing_force_percent": {"value": 0.0}} for more in ([], ["imbalance"])]
    assert summary(None, [], steps) == ["Adding imbalance explains tones, which the fit leaves out."]
    steps[0]["missing_force_percent"] = {"value": 6.0}
    assert "from 6.0 % to 0 %" in summary(None, [], steps)[0]


def test_names_are_text_not_markup() -> None:
    evil = "<script>alert(1)</script>$x_{$&\"'"
    parts = {key: value for key, value in made_up().items() if key in ("title", "comparison", "rig_text", "facts")}
    parts["comparison"]["where"][0] |= {"channel": evil, "region": evil}
    for kind in ("curves", "laws"):
        parts["comparison"][kind] = [c | {"channel": evil} for c in parts["comparison"][kind] if c["channel"] == "b1x"]
    parts["comparison"]["spectra"] = {evil: parts["comparison"]["spectra"]["b1x"]}
    del parts["comparison"]["densities"], parts["comparison"]["orbits"]
    parts["rig_text"] = parts["title"] = evil
    page = Page(render(**parts))
    assert "script" not in page.tags
    assert evil in page.text


@given(st.floats(allow_nan=True, allow_infinity=True), st.floats(allow_nan=True, allow_infinity=True))
def test_numbers_never_fail(value: float, sd: float) -> None:
    assert number(value)
    assert interval(value, sd)
    assert percent(value)
    assert prefix(value, "m")[1].endswith("m")


def test_numbers_read_well() -> None:
    assert interval(1.3e18, 0.06e18) == "(1.30 ± 0.12) × 10¹⁸"
    assert interval(60.0, 1.0) == "60.0 ± 2.0"
    assert number(2.813e5) == "2.81 × 10⁵"
    assert (number(31365.0, 2), number(25600.0), number(-62.5, 2)) == ("31000", "25600", "-62")
    assert unit_text("N/m^3") == "N/m³"
    assert unit_text("N^2/Hz") == "N²/Hz"
    assert unit_text("N/m^1.5") == "N/m¹·⁵"
    assert prefix(3e-8, "m") == (1e9, "nm")
    assert parameter({"value": 1.985e-7, "sd": 4.8e-9, "unit": "m"}) == "198.5 ± 9.4 nm"
    assert parameter({"value": 6.0, "sd": 0.3, "unit": "1"}) == "6.00 ± 0.59"
    assert (odds(1e-158), odds(0.011), percent(0.0)) == ("< 10⁻²⁰", "0.011", "0 %")
    assert parameter({"value": None, "reason": "too little motion"}) == "not identifiable: too little motion"


def test_a_folder_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="choose another --html"):
        write_report(tmp_path / "no" / "r.html", "t")
