from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from daq.commands.study.reproduce import reproduce
from daq.commands.study.reproduce_cases import DISC_KG, PAPER_METHODS, paper_model
from estimator.simulation.start import stationarity


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], list[float]]:
    out = tmp_path_factory.mktemp("paper") / "deeper"
    shares: list[float] = []
    return out, reproduce(out, shares.append, seconds=8.0, replicates=30), shares


def rows(numbers: dict[str, Any], table: str, **wanted: str) -> list[dict[str, Any]]:
    return [r for r in numbers["tables"][table] if all(r[k] == v for k, v in wanted.items())]


@pytest.mark.slow
def test_figures_4_to_19_are_there_and_are_pictures(made: tuple[Path, dict[str, Any], list[float]]) -> None:
    out, _, _ = made
    for n in range(4, 20):
        data = (out / f"figure_{n:02d}.png").read_bytes()
        assert data.startswith(b"\x89PNG")
        width, height = struct.unpack(">II", data[16:24])
        assert width > 800
        assert height > 300
        assert len(data) > 10_000


@pytest.mark.slow
def test_page_shows_every_figure_and_table(made: tuple[Path, dict[str, Any], list[float]]) -> None:
    out, _, _ = made
    page = (out / "index.html").read_text(encoding="utf-8")
    assert page.count("<img ") == 16
    for n in (1, 2, 3):
        assert f"Table {n}." in page
    assert "not identifiable" in page


@pytest.mark.slow
def test_numbers_on_disk_are_those_returned(made: tuple[Path, dict[str, Any], list[float]]) -> None:
    out, numbers, _ = made
    assert json.loads((out / "numbers.json").read_text()) == json.loads(json.dumps(numbers))


@pytest.mark.slow
def test_parameters_in_come_out(made: tuple[Path, dict[str, Any], list[float]]) -> None:
    """Both directions: eq. (36), response form, with the masses given and a twentieth of the command's record."""
    _, numbers, _ = made
    for table in ("1", "2"):
        for r in rows(numbers, table, case="rig", masses="given", method=PAPER_METHODS[1]):
            if r["parameter"].endswith("kL"):
                assert r["value"] == pytest.approx(r["true"], rel=0.12)
                assert abs(r["value"] - r["true"]) < 4.0 * r["sd"]
                assert r["interval"][0] < r["value"] < r["interval"][1]


@pytest.mark.slow
def test_mass_ratio_is_a_verdict_not_a_number_with_the_rigs_shaft(
    made: tuple[Path, dict[str, Any], list[float]],
) -> None:
    _, numbers, _ = made
    for table in ("1", "2"):
        found = [r for r in rows(numbers, table, case="rig", masses="unknown") if r["parameter"].endswith("mu")]
        assert len(found) == 8
        assert all(r["value"] is None for r in found)
    strong = [
        r for r in rows(numbers, "1", case="strong", method=PAPER_METHODS[2]) if r["parameter"] == "bearing1.x.mu"
    ]
    assert strong[0]["value"] == pytest.approx(DISC_KG / 0.245, rel=0.25)


@pytest.mark.slow
def test_progress_rises_to_one(made: tuple[Path, dict[str, Any], list[float]]) -> None:
    shares = made[2]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_the_simulated_rig_obeys_the_exact_condition() -> None:
    for shaft in (155e3, 1e7):
        model, temperature = paper_model(shaft)
        condition = stationarity(model)
        assert condition.exact
        assert condition.temperature == pytest.approx(temperature)
