"""A force that begins to be missing during a session: said when it comes, named from the samples after that."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from promises import PATIENCE_S

from daq.base.console.output import Output
from daq.base.contract.sink import Session
from daq.commands.demo import truth_text
from daq.commands.files.importers import import_files
from daq.log.reader import read_log
from daq.report.live_table import missing_text
from daq.rig.rig import Rig, load_rig
from daq.session.naming import Naming, Question, answer, said
from daq.session.replay import replay_into
from drivers.contract.reading import Block, Gap, Info, Notice, Signal
from estimator.results import Estimate, Parameter, certain_missing_effects

RATE = 1000.0
RIG = Rig.parse(Path(__file__).parents[3].joinpath("daq", "commands", "demo_rig.toml").read_text("utf-8"))
NAMES = tuple(c.name for c in RIG.model.channels)
INFO = Info(tuple(Signal(n, "m/s^2", 0.5, 0.0) for n in reversed(NAMES)), RATE)


def named(effect: str = "clearance") -> dict[str, Any]:
    row = {"effect": effect, "at": ["bearing1"], "p_value": 1e-30, "parameters": {f"bearing1.x.{effect}.k": {}}}
    row |= {"missing_force_before_percent": 1.4, "missing_force_after_percent": 0.0}
    return {"verdict": effect, "ranking": [row, row | {"effect": "quintic"}]}


class NamingRun:
    """A naming sink fed with estimates twice a second, and what it asked and said."""

    def __init__(self, found: dict[str, Any] | None = None) -> None:
        self.asked: list[Question] = []
        self.found = found or named()
        self.sink = Naming(RIG, live=False, ask=self.ask)
        self.sink.start(Session(model=RIG.model, info=INFO, device="", attachments={}, metadata={}))
        self.index = 0

    def ask(self, question: Question) -> dict[str, Any]:
        self.asked.append(question)
        return self.found

    def feed(self, seconds: float, extra: dict[str, float], samples: float = 9000.0, kL: float = 1e7) -> list[str]:
        for _ in range(round(2 * seconds)):
            count = (np.arange(self.index, self.index + 500) % 30_000).astype(np.int16)
            rows = np.repeat(count[:, None], 4, axis=1)
            self.sink.readings([Block(self.index, rows, 0)])
            self.index += 500
            known = {"bearing1.x.kL": Parameter(kL, 1e4, "N/m"), "bearing1.x.m": Parameter(0.2, 0.0, "kg")}
            self.sink.estimate(Estimate(self.index, known, samples, extra=extra))
        return [n.code for n in self.sink.health().notices]


SOUND = {"missing_force_percent": 0.0}
OPEN = {"missing_force_percent": 0.8, "missing_force_percent_quintic": 0.7, "missing_force_percent_clearance": 1.0}


def test_it_is_said_at_once_and_named_from_what_comes_after() -> None:
    watched = NamingRun()
    assert watched.feed(60, SOUND) == []
    assert watched.feed(1, OPEN) == ["missing_force"]
    assert watched.feed(20, OPEN) == ["effect_named"]
    (question,) = watched.asked
    assert question.y.shape == (7000, 4)
    assert question.y[0, 0] == 0.5 * (60_500 % 30_000)
    assert watched.feed(100, OPEN) == []


def test_something_else_is_said_anew_and_what_is_known_goes_into_the_model() -> None:
    watched = NamingRun()
    watched.feed(30, OPEN)
    watched.found = named("coulomb")
    assert watched.feed(60, {k: 3 * v for k, v in OPEN.items()}) == ["missing_force", "effect_named"]
    assert [q.known for q in watched.asked] == [(), (("clearance", ("bearing1.x",)),)]


def test_a_jump_of_the_parameters_is_said_and_a_gap_is_none() -> None:
    watched = NamingRun({"verdict": "complete", "ranking": []})
    watched.feed(20, SOUND, 20_000.0)
    assert watched.feed(20, SOUND, 5_000.0, kL=1.1e7) == ["parameters_changed", "model_complete"]
    watched.feed(20, SOUND, 20_000.0)
    watched.sink.readings([Gap(watched.index, 30_000, "sequence")])
    watched.index += 30_000
    assert watched.feed(20, SOUND, 5_000.0) == []


def test_a_background_that_the_estimate_takes_over_is_no_change_of_the_machine() -> None:
    watched = NamingRun()
    watched.feed(20, SOUND, 20_000.0)
    assert watched.feed(20, SOUND | {"background_found_s": 20.5}, 5_000.0, kL=1.1e7) == []


def test_what_was_named_after_a_jump_is_not_reported_twice() -> None:
    watched = NamingRun()
    watched.feed(20, SOUND, 20_000.0)
    assert watched.feed(10, {}, 5_000.0, kL=1.1e7) == ["parameters_changed", "effect_named"]
    assert watched.feed(30, OPEN) == []


def test_old_samples_that_are_dropped_late_do_not_put_the_question_off() -> None:
    watched = NamingRun()
    watched.feed(20, SOUND, 20_000.0)
    watched.feed(4, SOUND, 9_000.0, kL=1.1e7)  # of which most are from before the jump
    watched.feed(6, SOUND, 5_000.0, kL=1.1e7)
    assert [(q.y[0, 0], len(q.y)) for q in watched.asked] == [(0.5 * 20_500, 7000)]


def test_a_second_change_puts_the_question_off() -> None:
    watched = NamingRun()
    watched.feed(20, SOUND, 20_000.0)
    watched.feed(4, SOUND, 3_000.0, kL=1.1e7)
    watched.feed(10, SOUND, 1_500.0, kL=1.2e7)
    assert [(q.y[0, 0], len(q.y)) for q in watched.asked] == [(0.5 * 24_500, 7000)]


def test_missing_samples_are_missing_in_the_question() -> None:
    watched = NamingRun()
    watched.feed(1, OPEN)
    watched.sink.readings([Gap(watched.index, 1000, "sequence")])
    watched.index += 1000
    watched.feed(20, OPEN)
    assert np.isnan(watched.asked[0].y).all(axis=1).sum() == 1000


def test_the_line_of_the_live_table() -> None:
    assert certain_missing_effects(OPEN) == ["clearance", "quintic"]
    assert (
        missing_text(OPEN) == "missing force 0.80 % of the bearing force   most like clearance 1.00 %, quintic 0.70 %"
    )
    assert missing_text({}) == ""


def test_an_effect_whose_force_is_not_seen_yet_is_not_said_to_fall_from_nothing_to_nothing() -> None:
    question = Question(
        text=RIG.text, base=RIG.base, path=RIG.path, known=(), y=np.zeros((7000, 4)), rate_hz=RATE, since_s=60.0
    )
    row = named()["ranking"][0] | {"missing_force_before_percent": 0.0}
    assert "->" in said(named(), question)[2]
    assert "its force not yet seen" in said({"verdict": "clearance", "ranking": [row]}, question)[2]


def test_a_question_that_cannot_be_answered_is_one_line() -> None:
    short = Question(
        text=RIG.text,
        base=RIG.base,
        path=RIG.path,
        known=(("clearance", ("bearing1.x",)),),
        y=np.zeros((100, 4)),
        rate_hz=25600.0,
        since_s=0.0,
    )
    assert "\n" not in answer(short)["error"]


def test_live_the_catalogue_is_tried_in_a_process_of_its_own() -> None:
    sink = Naming(RIG, live=True)
    sink.start(Session(model=RIG.model, info=INFO, device="", attachments={}, metadata={}))
    for k in range(40):
        sink.readings([Block(500 * k, np.zeros((500, 4), np.int16), 0)])
        sink.estimate(Estimate(500 * k + 500, {}, 1000.0, extra=OPEN))
    until, said = time.monotonic() + PATIENCE_S, []
    while len(said) < 2 and time.monotonic() < until:
        said += list(sink.health().notices)
        time.sleep(0.05)
    sink.close()
    assert [n.code for n in said] == ["missing_force", "effect_unknown"]  # zeros: no record to judge
    assert "cannot be named" in said[1].text


@pytest.mark.slow
def test_a_clearance_that_opens_at_60_s_is_flagged_and_named_within_20_s(tmp_path: Path) -> None:
    from estimator.simulation.simulator import simulate

    path = tmp_path / "rig.toml"
    path.write_text(RIG.text)
    rig = load_rig(path)
    truth = Rig.parse(truth_text(rig)).model
    sound = replace(truth, effects=tuple(u for u in truth.effects if u.name != "clearance"))
    first = simulate(sound, 25600.0, 60.0, seed=1, noise=0.02, full_scale=490.5)
    y = np.concatenate([first, simulate(truth, 25600.0, 30.0, seed=2, noise=0.02, full_scale=490.5)])
    np.savez(tmp_path / "y.npz", rate_hz=25600.0, **{n: y[:, k] for k, n in enumerate(NAMES)})
    import_files(Output(None, quiet=True), [tmp_path / "y.npz"], path, tmp_path / "y.mcap", None, False)
    said: list[Notice] = []
    asked: list[float] = []

    def ask(question: Question) -> dict[str, Any]:
        asked.append(question.since_s + len(question.y) / question.rate_hz)
        return answer(question)

    class Watched(Naming):
        """Keeps what the estimates were certain of, by time."""

        def estimate(self, estimate: Estimate) -> None:
            super().estimate(estimate)
            if found := certain_missing_effects(estimate.extra or {}):
                sure.append((estimate.index / 25600.0, found))

    sure: list[tuple[float, list[str]]] = []
    replay_into(read_log(tmp_path / "y.mcap"), rig, [Watched(rig, live=False, ask=ask)], notify=said.append)
    when, like = sure[0]
    assert 60 < when <= 80
    assert like[0] == "clearance"
    first = next(n for n in said if n.code in ("parameters_changed", "missing_force"))
    assert said.index(first) <= min(k for k, n in enumerate(said) if n.code == "effect_named")
    verdict = next(n for n in said if n.code == "effect_named")
    assert verdict.text.startswith("clearance at bearing1")
    assert 60 < asked[0] <= 80


def test_the_live_table_shows_the_force_and_the_name() -> None:
    from io import StringIO

    from rich.console import Console

    from daq.report.live_table import LiveTable

    table = LiveTable(Console(file=StringIO(), width=120))
    table.estimate(Estimate(0, {"bearing1.x.kL": Parameter(1e7, 1e4, "N/m")}, 10.0, extra=OPEN))
    table.readings([Notice(0, "warning", "effect_named", "clearance at bearing1 is missing")])
    console = Console(file=StringIO(), width=120)
    console.print(table._draw())
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "missing force 0.80 %" in text
    assert "clearance at bearing1 is missing" in text
