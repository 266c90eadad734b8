"""The confusion matrix by a command: it goes on where it stopped, and says what it cannot do."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from daq import confusion as subject
from daq.cli import main
from daq.confusion import Case, cases
from daq.rig import load_rig
from estimator.evidence import Entry

PAPER = Path(__file__).parents[2] / "configs" / "tiwari_vyas_1997.toml"


def test_every_case_once_and_what_has_one_place_not_at_both() -> None:
    asked = cases(["cubic", "gyroscopic", "sensor_skew"], ["weak", "strong"], ["bearing1", "both"], 2, 3)
    keys = [c.key for c in asked]
    assert len(set(keys)) == len(keys)
    assert sum(c.effect == "complete" for c in asked) == 3
    assert {c.at for c in asked if c.effect == "cubic"} == {"bearing1", "both"}
    assert {c.at for c in asked if c.effect == "sensor_skew"} == {"bearing1"}


def test_a_second_call_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []

    def run(model: object, case: Case, seconds: float) -> dict[str, object]:
        ran.append(case.key)
        named = {"key": case.key, "effect": case.effect, "strength": case.strength, "at": case.at, "seconds": seconds}
        return named | {"verdict": case.effect}

    monkeypatch.setattr(subject, "run", run)  # the statistics are slow; the bookkeeping is the subject
    command = ["confusion", str(PAPER), "--out", str(tmp_path / "m"), "--strengths", "strong", "--quiet"]
    assert main([*command, "--effects", "stop", "--complete", "1", "--seconds", "5"]) == 0
    assert main([*command, "--effects", "stop,rub", "--complete", "1", "--seconds", "5"]) == 0
    assert ran == ["complete/-/-/0", "stop/strong/bearing1/0", "rub/strong/bearing1/0"]
    assert len(json.loads((tmp_path / "m" / "confusion.json").read_text())["runs"]) == 3
    assert "| rub |  | 1/1 |" in (tmp_path / "m" / "confusion.md").read_text()
    assert main([*command, "--effects", "stop", "--seconds", "6"]) == 2, "another length needs another folder"


@pytest.mark.parametrize(
    ("option", "said"),
    [("--effects", "clearence"), ("--strengths", "enormous"), ("--at", "bearing3")],
)
def test_a_wrong_name_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, said: str) -> None:
    assert main(["confusion", str(PAPER), "--out", str(tmp_path), option, said]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("seconds", "stands_in"), [(5.0, True), pytest.param(10.0, False, marks=pytest.mark.slow)], ids=["quick", "whole"]
)
def test_what_is_named_is_added_and_closes_the_gap(
    seconds: float, stands_in: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if stands_in:  # the diagnosis has tests of its own: here it is right
        top = Entry("coulomb", ("bearing1",), 9.0, 9.0, 1e-9, 3.0, 0.0, {}, 9.0)
        right = SimpleNamespace(verdict="coulomb", ranking=(top,))
        monkeypatch.setattr(subject, "diagnose_point", lambda *_: right)
    found = subject.run(load_rig(PAPER).model, Case("coulomb", "strong", "bearing1", 0), seconds)
    assert found["verdict"] == "coulomb"
    assert found["before_percent"] > 2.0
    assert found["added"]["missing_percent"] < 0.2 * found["before_percent"]
    assert found["added"]["gap"] > 300.0
    assert abs(found["added"]["to_go"]) < 0.05 * found["added"]["gap"]
    assert subject.ended([found]) == ("1/1", "1/1")
