"""compare, diagnose, improve as commands: what is refused before the work and how; what is shown after."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from html_page import Page

from daq.commands.analyse import fitted, with_lines
from daq.commands.cli.app import main
from daq.commands.diagnosis import BELOW_DETECTION, diagnosis_text, ending, with_verdict
from daq.exchange.measurement import Measurement
from daq.rig.edit import with_effect, with_values
from daq.rig.rig import Rig, load_rig
from estimator.diagnosis.verdict import NO_LAW_CODES
from estimator.results import Parameter
from estimator.simulation.simulator import simulate

PAPER = Path(__file__).parents[3] / "configs" / "tiwari_vyas_1997.toml"


@pytest.mark.parametrize("command", ["fit", "compare", "diagnose"])
def test_a_law_that_is_not_finite_is_said_with_its_line_before_anything_is_read(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "rig.toml"
    law = (
        '\n[[model.custom]]\nname = "own"\nexpression = "k*log(x)"\nparameters = { k = { value = 1.0, unit = "N" } }\n'
    )
    rig.write_text(PAPER.read_text() + law)
    line = rig.read_text().splitlines().index('expression = "k*log(x)"') + 1
    assert main([command, str(tmp_path / "none.mcap"), "--rig", str(rig)]) == 2
    err = capsys.readouterr().err
    assert f"rig.toml:{line}: model.custom[0].expression" in err
    assert "not finite" in err


def test_a_record_that_cannot_answer_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = tmp_path / "short.npz"
    rng = np.random.default_rng(0)
    np.savez(short, rate_hz=25600.0, **{n: rng.standard_normal(4000) for n in ("b1x", "b1y", "b2x", "b2y")})
    assert main(["compare", str(short), "--rig", str(PAPER)]) == 4
    assert f"{short}: the band 150-8000 Hz of b1x holds no clear resonance" in capsys.readouterr().err


def test_a_fit_says_that_a_channel_of_a_file_is_at_its_full_scale(tmp_path: Path) -> None:
    rig = load_rig(PAPER)
    y = simulate(rig.model, 25600.0, 5.0, seed=1, noise=0.02)
    top = float(np.quantile(np.abs(y[:, 2]), 0.9995))
    y[:, 2] = np.clip(y[:, 2], -top, top)
    messages = fitted(rig, Measurement(y, 25600.0, {}), "spectral").messages
    assert any(m.text.startswith(f"b2x is clipped at +-{top:.3g}") for m in messages)


def test_where_to_show_it_is_checked_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["compare", str(tmp_path / "none.mcap"), "--rig", str(PAPER)]
    assert main([*command, "--rerun", "picture.png"]) == 2
    assert main([*command, "--html", str(tmp_path / "no" / "r.html")]) == 2
    assert "create it first" in capsys.readouterr().err


def test_what_ends_at_the_shaft_does_not_ask_for_a_law() -> None:
    text = "the shaft is stiffer (or its disc lighter) than the rig file says, by 14 +- 0.8 %"
    for code in NO_LAW_CODES:
        unknown = {"verdict": "unknown", "ranking": [], "messages": ["1st", text], "message_codes": ["", code]}
        assert ending(unknown) == f"something is left: {text}"
        assert "is not a law of a bearing: see the notes" in diagnosis_text(unknown)[-1]
    unknown = {"verdict": "unknown", "ranking": [], "messages": ["the first"]}
    assert "type a law of your own" in ending(unknown)
    assert "type a law of your own" in diagnosis_text(unknown)[-1]


def test_an_end_that_names_an_effect_says_what_became_of_it() -> None:
    named = {"verdict": "cubic", "messages": []}
    assert ending(named) == "the last diagnosis names cubic, which was not added"
    assert "not examined" in ending(named, ["cubic"])


def test_the_model_with_the_verdict_has_what_was_found() -> None:
    rig = load_rig(PAPER)
    k = {"value": 1.4e6, "sd": 1e5, "unit": "N/m", "identifiable": True}
    found = {f"bearing1.{d}.clearance.{n}": k | {"value": v} for d in "xy" for n, v in (("k", 1.4e6), ("gap", 2e-7))}
    row = {"effect": "clearance", "at": ["bearing1"], "parameters": found}
    better = with_verdict(rig, {"verdict": "clearance", "ranking": [row]})
    assert better is not None
    use = better.model.effects[-1]
    assert (use.name, use.at) == ("clearance", ("bearing1.x", "bearing1.y"))
    assert use.parameters["bearing1.y"]["gap"].value == 2e-7
    assert with_verdict(rig, {"verdict": "complete", "ranking": [row]}) is None


def test_every_line_of_a_verdict_and_of_a_fit_goes_into_the_file() -> None:
    rig = load_rig(PAPER)
    p = {"value": 1.0, "sd": 0.1, "unit": "N", "identifiable": True}
    names = ("a", "b", "frequency")
    found = {f"{at}.{n}": p for at in ("bearing1.x.line", "bearing1.x.line_2", "bearing2.y.line_2") for n in names}
    row = {"effect": "line", "at": ["bearing1", "bearing2"], "parameters": found}
    better = with_verdict(rig, {"verdict": "line", "ranking": [row]})
    assert better is not None
    lines = {use.name: use.at for use in better.model.effects[1:]}
    assert lines == {"line": ("bearing1.x",), "line_2": ("bearing1.x", "bearing2.y")}
    one = Rig.parse(with_effect(rig, "line", ["bearing1.x"]))
    parameters = {name: Parameter(1.0, 0.1, "N") for name in found}
    text = with_values(with_lines(one, parameters), parameters)
    assert "# linear stiffness and damping are always there" in text
    uses = Rig.parse(text).model.effects[1:]
    assert {use.name: use.at for use in uses} == lines
    assert uses[1].parameters["bearing2.y"]["frequency"].value == 1.0


@pytest.fixture(scope="module")
def lacking_cubic(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A log of the paper's rig, and a rig file that lacks its cubic stiffness."""
    folder = tmp_path_factory.mktemp("lacking_cubic")
    log, linear = folder / "log.mcap", folder / "linear.toml"
    assert main(["remove", "cubic", "--rig", str(PAPER), "--out", str(linear)]) == 0
    assert main(["simulate", str(PAPER), "--out", str(log), "--seconds", "10", "--quiet"]) == 0
    return log, linear


@pytest.mark.slow  # 8 to 15 s of processor time each: together they hit the time limit on a busy machine
@pytest.mark.parametrize("command", ["compare", "diagnose", "improve"])
def test_a_page_and_a_recording_of_every_command(
    command: str, lacking_cubic: tuple[Path, Path], tmp_path: Path
) -> None:
    log, linear = lacking_cubic
    page, view, better = tmp_path / "p.html", tmp_path / "v.rrd", tmp_path / "better.toml"
    more = ["--out", str(better)] if command == "improve" else []
    shown = ["--html", str(page), "--rerun", str(view), "--quiet"]
    assert main([command, str(log), "--rig", str(linear), *more, *shown]) == 0
    text = Page(page.read_text("utf-8")).text
    assert view.stat().st_size > 10_000
    assert ("The ladder" in text) == (command != "compare")
    assert not more or load_rig(better).model.effects[0].name == "cubic"


def test_a_record_in_pieces_says_so(tmp_path: Path) -> None:
    from daq.base.contract.errors import LogError
    from daq.commands.analyse import about
    from daq.exchange.measurement import Measurement
    from estimator.errors import DataError

    y = np.zeros((1000, 2))
    with pytest.raises(LogError, match=r"a\.mcap: too short$"), about(Path("a.mcap"), Measurement(y, 1e3, {})):
        raise DataError("too short")
    y[::20, 1] = np.nan
    broken = pytest.raises(LogError, match=r"too short \(5 % of it is missing or at full scale")
    with broken, about(Path("a.mcap"), Measurement(y, 1e3, {})):
        raise DataError("too short")


def test_of_a_complete_model_it_is_said_what_the_record_could_not_have_shown() -> None:
    row = {
        "effect": "coulomb", "at": ["bearing1"], "heldout_gain": 0.0, "p_value": 1.0, "parameters": {},
        "missing_force_before_percent": 0.0, "missing_force_after_percent": 0.0,
    }  # fmt: skip
    limit = {"detectable_from": {"value": 0.008, "unit": "N"}}
    diagnosis = {"verdict": "complete", "ranking": [row | limit], "messages": ()}
    assert BELOW_DETECTION in diagnosis_text(diagnosis)
    assert BELOW_DETECTION not in diagnosis_text(diagnosis | {"ranking": [row]})
    assert BELOW_DETECTION not in diagnosis_text(diagnosis | {"verdict": "coulomb"})
    apart = "coulomb or stribeck: the record hardly separates these (3 nats)"
    assert apart in diagnosis_text(diagnosis | {"verdict": "coulomb", "separates": apart})
