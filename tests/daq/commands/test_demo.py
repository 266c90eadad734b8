"""The demo: its truth, its acquisition and replay quickly; the whole of it where there is time (slow)."""

import json
from pathlib import Path

import jsonschema
import pytest

from daq.base.console.output import Output
from daq.commands import demo
from daq.commands.cli.app import main
from daq.log.reader import read_log
from daq.rig.rig import Rig

SCHEMA = Path(__file__).parents[2] / "data" / "schemas" / "demo.json"


def demo_rig() -> Rig:
    return Rig.parse(Path(demo.__file__).with_name("demo_rig.toml").read_text())


def test_the_truth_has_the_hidden_effect_and_the_rig_has_not() -> None:
    rig = demo_rig()
    truth = Rig.parse(demo.truth_text(rig))
    assert [u.name for u in rig.model.effects] == ["cubic"]
    assert [u.name for u in truth.model.effects] == ["cubic", demo.HIDDEN_EFFECT]
    assert truth.model.effects[1].at == ("bearing1.x", "bearing1.y")
    assert all(s.value is None for table in rig.model.linear.values() for s in table.values())
    known = demo.known_values(truth)
    assert known["bearing1.x.clearance.gap"] == demo.HIDDEN_VALUES["gap"]
    assert known["bearing2.y.kL"] == demo.TRUE_LINEAR["bearing2.y"][0]


def test_acquired_over_the_virtual_bus_and_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = demo_rig()
    log = tmp_path / "m.mcap"
    demo.acquire_demo(Output(), rig, Rig.parse(demo.truth_text(rig)), log, tmp_path / "m.rrd", seconds=5.0)
    demo.replay_demo(Output(), log)
    text = capsys.readouterr().out
    assert "no sample lost" in text
    assert "from the truth" in text
    assert "bit for bit" in text
    assert read_log(log).n_samples == 128000
    assert (tmp_path / "m.rrd").stat().st_size > 100_000


@pytest.mark.slow
def test_the_whole_story(tmp_path: Path) -> None:
    out = tmp_path / "demo.json"
    assert main(["demo", "--out", str(tmp_path / "demo"), "--json", str(out), "--quiet"]) == 0
    value = json.loads(out.read_text())
    jsonschema.validate(value, json.loads(SCHEMA.read_text()))
    first, last = value["ladder"][0], value["ladder"][-1]
    assert last["effects"] == ["cubic", demo.HIDDEN_EFFECT]
    assert last["heldout_nll"] < first["heldout_nll"]
    before, after = (step["missing_force_percent"]["value"] for step in (first, last))
    assert after < 0.2 * before
    assert all(Path(file).stat().st_size > 0 for file in value["files"])


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main(["demo", "--out", str(tmp_path / "file" / "demo")]) == 2
    assert "choose another --out" in capsys.readouterr().err
