"""Tables and text at a width: whole words, whole numbers, the least important columns left out and named."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from daq.base.console.fitting import FittingTable
from daq.base.console.output import pipe_width
from daq.base.console.tables import ladder_table, parameters_table
from estimator.results import Parameter

REPOSITORY_FOLDER = Path(__file__).parents[4]
LADDER_ROW: dict[str, object] = {
    "effects": ["cubic", "clearance"],
    "heldout_nll": -4.71425,
    "missing_force_percent": {"value": 0.0, "low": 0.0, "high": 0.38},
}
TABLE_OF_THREE = FittingTable(
    headings=("channel", "value", "remark", "least of all"),
    rows=[("bearing1.x", "1.234e+10", "a sentence of several words", "x"), ("b2", "-5", "", "yyyyyyyyyyyyyyyy")],
    order=(2, 3),
    right=frozenset({1}),
)


def drawn(width: int) -> str:
    out = io.StringIO()
    Console(file=out, width=width).print(TABLE_OF_THREE)
    return out.getvalue()


@pytest.mark.parametrize("width", [24, 36, 50, 80])
def test_no_word_and_no_number_is_broken(width: int) -> None:
    text = drawn(width)
    assert max(map(len, text.splitlines())) <= width
    for word in ("bearing1.x", "1.234e+10", "-5"):
        assert word in text
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    assert ("sentence" in text) == (width >= 36)
    assert ("yyyyyyyyyyyyyyyy" in text) == (width >= 50)
    assert ("least of all" in re.sub(r"\s+", " ", text.partition("left out")[2])) == (width < 50)


@pytest.mark.parametrize(("asked", "width"), [("80", 80), ("", 160), ("0", 160), ("wide", 160), ("-3", 160)])
def test_a_pipe_has_the_width_that_is_asked_for(asked: str, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", asked)
    assert pipe_width() == width


@pytest.mark.parametrize("command", [["effects"], ["theory", "configs/tiwari_vyas_1997.toml"], ["ports"]])
def test_commands_keep_to_80_columns_in_a_pipe(command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    asked = [sys.executable, "-m", "daq", *command]
    done = subprocess.run(asked, cwd=REPOSITORY_FOLDER, capture_output=True, text=True, check=True)
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert "\N{HORIZONTAL ELLIPSIS}" not in done.stdout


@pytest.mark.parametrize("width", [40, 60, 80])
def test_the_numbers_of_a_fit_are_whole_at_every_width(width: int) -> None:
    parameters = {
        "bearing1.x.clearance.gap": Parameter(1.86e-7, 1.8e-8, "m"),
        "bearing1.x.cubic.kNL": Parameter(1.2345e18, 7e14, "N/m^3"),
        "bearing1.x.m": Parameter(0.2, 0.0, "kg", reason="given"),
    }
    out = io.StringIO()
    Console(file=out, width=width).print(parameters_table(parameters), ladder_table([LADDER_ROW]))
    text = out.getvalue()
    assert max(map(len, text.splitlines())) <= width
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    for word in ("bearing1.x.clearance.gap", "1.2345e+18", "1.86e-07", "-4.71425"):
        assert word in text
    assert ("0.00 to 0.38" in text) == ("1.8e-08" in text) == (width >= 60)
