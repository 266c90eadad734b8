"""The confusion matrix by a command: it goes on where it stopped, and says what it cannot do."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from daq.base.console.output import Output
from daq.base.contract.errors import ConfigError
from daq.commands.cli.app import main
from daq.commands.study import confusion as subject
from daq.commands.study import hidden_pairs
from daq.commands.study.hidden import Case, cases, with_hidden
from daq.commands.study.hidden_pairs import NOBODY_TELLS, Pair, pairs
from daq.rig.rig import load_rig
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.verdict.bearing import BearingJudgement
from estimator.diagnosis.verdict.improvement import Improvement, Rung
from estimator.effects import CATALOGUE
from estimator.model.rig import Model

PAPER = Path(__file__).parents[4] / "configs" / "tiwari_vyas_1997.toml"


def test_every_case_once_and_what_has_one_place_not_at_both() -> None:
    asked = cases(["cubic", "gyroscopic", "sensor_skew"], ["weak", "strong"], ["bearing1", "both"], 2, 3)
    keys = [c.key for c in asked]
    assert len(set(keys)) == len(keys)
    assert sum(c.effect == "complete" for c in asked) == 3
    assert {c.at for c in asked if c.effect == "cubic"} == {"bearing1", "both"}
    assert {c.at for c in asked if c.effect == "sensor_skew"} == {"bearing1"}


def test_a_second_call_goes_on(tmp_path: Path) -> None:
    ran: list[str] = []

    def run(model: object, case: Case, seconds: float) -> dict[str, object]:
        ran.append(case.key)
        named = {"key": case.key, "effect": case.effect, "strength": case.strength, "at": case.at, "seconds": seconds}
        return named | {"verdict": case.effect}

    def matrix(effects: list[str], seconds: float) -> None:  # the statistics are slow; the bookkeeping is the subject
        places = ["strong"], ["bearing1"]
        subject.confusion(Output(quiet=True), PAPER, tmp_path / "m", effects, *places, 1, 1, 0, seconds, run_case=run)

    matrix(["stop"], 5.0)
    matrix(["stop", "rub"], 5.0)
    assert ran == ["complete/-/-/0", "stop/strong/bearing1/0", "rub/strong/bearing1/0"]
    assert len(json.loads((tmp_path / "m" / "confusion.json").read_text())["runs"]) == 3
    assert "| rub |  | 1/1 |" in (tmp_path / "m" / "confusion.md").read_text()
    with pytest.raises(ConfigError, match="choose another --out"):  # another length needs another folder
        matrix(["stop"], 6.0)


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
def test_what_is_named_is_added_and_closes_the_gap(seconds: float, stands_in: bool) -> None:
    judge: dict[str, Any] = {}
    if stands_in:  # the diagnosis has tests of its own: here it is right
        top = Entry(
            "coulomb",
            ("bearing1",),
            9.0,
            9.0,
            p_value=1e-9,
            before_percent=3.0,
            after_percent=0.0,
            parameters={},
            score=9.0,
        )
        right = SimpleNamespace(verdict="coulomb", ranking=(top,))
        judge["diagnose"] = lambda *_: right
    found = subject.run(load_rig(PAPER).model, Case("coulomb", "strong", "bearing1", 0), seconds, **judge)
    assert found["verdict"] == "coulomb"
    assert found["before_percent"] > 2.0
    assert found["added"]["missing_percent"] < 0.2 * found["before_percent"]
    assert found["added"]["gap"] > 300.0
    assert abs(found["added"]["to_go"]) < 0.05 * found["added"]["gap"]
    assert subject.ended([found]) == ("1/1", "1/1")


def test_a_pair_is_two_effects_whatever_else_is_asked() -> None:
    model = load_rig(PAPER).model
    many = pairs(model, CATALOGUE, 300)
    assert pairs(model, CATALOGUE, 7) == many[:7]
    assert all(len(p.at) == 2 and set(p.at) != NOBODY_TELLS for p in many)
    assert {name for p in many for name in p.at} == set(CATALOGUE)
    assert {where for p in many for name, where in p.at.items() if name == "clearance"} == {"bearing1", "both"}
    assert {where for p in many for name, where in p.at.items() if name == "sensor_skew"} == {"bearing1"}
    assert set(pairs(model, ["imbalance", "bow"], 1)[0].at) == NOBODY_TELLS, "unless nothing else is asked for"
    assert not pairs(replace(model, shaft="none"), ["cubic", "crack"], 1), "there is no shaft to crack"


def test_a_pair_that_no_record_separates_is_so_by_the_catalogue() -> None:
    one, other = NOBODY_TELLS
    assert one in CATALOGUE[other].confused_with
    assert other in CATALOGUE[one].confused_with


def test_pairs_are_counted_and_a_second_call_goes_on(tmp_path: Path) -> None:
    ran: list[int] = []
    right = {"verdict": "complete", "before_percent": 6.0, "after_percent": 0.0, "numbers": {"k": [0.01, 0.5]}}

    def run(model: object, pair: Pair, seconds: float) -> dict[str, object]:
        ran.append(pair.seed)
        steps = [[*pair.at], [*pair.at][:1], ["line", *pair.at]][pair.seed]
        hidden = {name: ["bearing1.x"] for name in pair.at}
        added = hidden | {[*pair.at][0]: ["bearing1.x", "bearing2.x"][: 1 + pair.seed // 2]}
        named = {"key": pair.key, "pair": pair.at, "seed": pair.seed, "seconds": seconds, "steps": steps}
        return named | {"hidden_at": hidden, "added_at": added} | right

    for number in (1, 3):
        subject.confusion(
            Output(quiet=True), PAPER, tmp_path, ["stop", "rub", "cubic"], ["strong"], ["bearing1"], 0, 0, number, 20.0,
            run_pair=run,
        )  # fmt: skip
    assert ran == [0, 1, 2]
    text = (tmp_path / "confusion.md").read_text()
    assert "Both within two steps: 1/3; one of them: 2, none: 0. Something else was added in 1, " in text
    assert "one of the two at other places in 1." in text
    assert '"complete" at the end: 3. Missing force falls by 80 % or more: 3/3.' in text
    assert "named right" not in text, "no matrix where no single effect was hidden"


def test_one_effect_makes_no_pair(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["confusion", str(PAPER), "--out", str(tmp_path), "--effects", "rub", "--pairs", "2"]) == 2
    assert "rub alone makes no pair" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("seconds", "stands_in"), [(2.0, True), pytest.param(20.0, False, marks=pytest.mark.slow)], ids=["quick", "whole"]
)
def test_what_improve_adds_of_a_pair_is_reported(seconds: float, stands_in: bool) -> None:
    pair = Pair({"clearance": "both", "quadratic_damping": "bearing1"}, 0)
    model = load_rig(PAPER).model
    judge: dict[str, Any] = {}
    if stands_in:  # improve has tests of its own: here it adds the truth
        judge["improve"] = lambda known, *_: _ladder_to_truth(known, pair, model, seconds)
    found = hidden_pairs.run_pair(model, pair, seconds, **judge)
    assert set(found["steps"]) == set(pair.at)
    assert len(found["steps"]) == 2
    assert found["verdict"] == "complete"
    assert found["added_at"] == found["hidden_at"]
    assert len(found["added_at"]["clearance"]) == 4
    assert found["before_percent"] > 1.2  # least squares on x, v and x^3 leave 1.5 of the 5 that is hidden
    assert found["after_percent"] < 0.2


def _ladder_to_truth(known: Model, pair: Pair, model: Model, seconds: float) -> Improvement:
    assert not set(pair.at) & {u.name for u in known.effects}
    truth, _ = with_hidden(model, pair.at, 0.06, seconds)
    rungs = tuple(Rung((), 0.0, (p, p, p)) for p in (6.0, 3.0, 0.0))
    said = tuple(BearingJudgement(v, ()) for v in (*pair.at, "complete"))
    return Improvement(rungs=rungs, model=truth, parameters={}, last=said[-1], diagnoses=said)
