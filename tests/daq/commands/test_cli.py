"""The command line as users and programs meet it: real processes where signals or pipes matter."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from promises import PATIENCE_S, until, within

from daq.commands.cli.app import application, main
from daq.log.reader import read_log
from daq.rig.rig import Rig
from daq.rig.schema import rig_schema

ROOT = Path(__file__).parents[3]
PAPER = ROOT / "configs" / "tiwari_vyas_1997.toml"
SCHEMAS = ROOT / "tests" / "data" / "schemas"
COMMANDS = [
    "demo", "init", "run", "simulate", "replay", "severity", "fit", "compare", "diagnose", "improve", "theory",
    "reproduce", "add", "batch", "confusion", "remove", "effects", "check", "schema", "import", "export", "recover",
    "info", "ports", "trend", "rotor",
]  # fmt: skip


def rotorscope(*arguments: str, **more: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "daq", *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        **more,
    )


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's rig with the quicker rolling estimator."""
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    path.write_text(PAPER.read_text().replace('method = "spectral"  ', 'method = "score-matching"'))
    return path


@pytest.fixture(scope="module")
def log(rig: Path) -> Path:
    path = rig.with_name("log.mcap")
    assert main(["simulate", str(rig), "--out", str(path), "--seconds", "3", "--quiet"]) == 0
    return path


def valid(path: Path, schema: str) -> dict[str, Any]:
    value: dict[str, Any] = json.loads(path.read_text())
    for folder in (SCHEMAS, ROOT / "docs" / "schemas"):
        jsonschema.validate(value, json.loads((folder / f"{schema}.json").read_text()))
    return value


# ---- what is there


def test_help_has_every_command_and_the_readme_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    readme = (ROOT / "README.md").read_text()
    assert sorted(COMMANDS) == sorted(_names())
    for command in COMMANDS:
        assert re.search(rf"^│ {command} ", text, re.MULTILINE), command
        assert f"| `rotorscope {command}" in readme, command


def _names() -> list[str]:
    names = [c.name or c.callback.__name__ for c in application().registered_commands if c.callback is not None]
    return [name.rstrip("_") for name in names]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_and_the_three_options(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert all(option in text for option in ("--json", "--quiet", "--verbose"))
    assert "<bool>" not in text  # a switch, --help too, takes no value


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from daq.commands.cli.app import main; main(['--help']); "
        "heavy = {'numpy', 'scipy', 'numba', 'pydantic', 'can', 'mcap', 'rerun', 'matplotlib'} & set(sys.modules); "
        "sys.exit(', '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stderr


def test_a_live_session_begins_without_the_slowest_library() -> None:
    """scipy.signal took half of the start; a device that is stopped after some seconds had no log."""
    code = "import daq.commands.live.run, sys; print('scipy.signal' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_the_stored_schema_is_the_current_one() -> None:
    stored = json.loads((ROOT / "docs" / "rig.schema.json").read_text())
    assert stored == rig_schema(), "write it anew: rotorscope schema > docs/rig.schema.json"


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.toml")), ids=lambda p: p.name)
def test_shipped_rigs_fit_the_schema(path: Path) -> None:
    import tomllib

    jsonschema.validate(tomllib.loads(path.read_text()), rig_schema())


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("rotorscope 0.")


# ---- what is wrong is said in one line, with the right status


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["rnu"], 2, "No such command 'rnu'. Did you mean 'run'?"),
        (["run"], 2, "Missing argument 'RIG'"),
        (["check", "none.toml"], 2, "no such rig file"),
        (["run", "RIG", "--link", "virtul:"], 3, "did you mean 'virtual'?"),
        (["run", "RIG", "--link", "serial:/dev/none"], 3, "check the name with `rotorscope ports`"),
        (["run", "RIG", "--link", "capture:none.log"], 3, "none.log"),
        (["run", "RIG", "--link", "virtual:", "--out", "/none/a.mcap"], 4, "/none/a.mcap"),
        (["simulate", "RIG"], 2, "give either --out LOG.mcap"),
        (["simulate", "RIG", "--out", "a.mcap", "--speed", "fast"], 2, '--speed fast: give "max"'),
        (["simulate", "RIG", "--out", "a.mcap", "--fault", "dorp:1"], 2, "KIND is one of drop"),
        (["simulate", "RIG", "--serve", "virtual:"], 3, "cannot be served"),
        (["replay", "none.mcap"], 4, "none.mcap"),
        (["info", "RIG"], 4, "is a rig file"),
        (["fit", "LOG", "--rig", "none.toml"], 2, "no such rig file"),
        (["fit", "none.mcap", "--rig", "RIG"], 4, "none.mcap"),
        (["effects", "clearence"], 2, 'did you mean "clearance"?'),
        (["add", "clearence", "--rig", "RIG", "--out", "b.toml"], 2, 'did you mean "clearance"?'),
        (["theory", "ONE"], 2, "add [rig.bearing]"),
        (["export", "LOG", "--to", "a.xyz"], 2, "known are .npz"),
    ],
)
def test_mistakes(
    arguments: list[str], status: int, said: str, rig: Path, log: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    names = {"RIG": str(rig), "LOG": str(log), "ONE": str(ROOT / "configs" / "one_bearing.toml")}
    assert main([names.get(a, a) for a in arguments]) == status
    captured = capsys.readouterr()
    assert captured.err.startswith("rotorscope: ")
    assert captured.err.count("\n") == 1, captured.err
    assert said in captured.err
    assert "Traceback" not in captured.err
    assert captured.out == ""


def test_verbose_has_the_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "none.toml", "--verbose"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_every_problem_of_a_rig_file_is_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text(PAPER.read_text().replace('"chain"', '"chian"').replace("disc =", "disk ="))
    assert main(["check", str(bad)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert all(line.startswith(f"rotorscope: {bad}:") for line in lines)


def test_a_number_where_a_table_is_asked_for_is_no_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text(f"{PAPER.read_text()}\n[machine]\niso20816 = 3\n")
    assert main(["check", str(bad)]) == 2
    assert "machine.iso20816: 3 is not a table\n" in capsys.readouterr().err


def test_a_word_that_an_option_does_not_know_is_said_with_those_it_knows(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", "a.mcap", "--rig", str(PAPER), "--method", "moments"]) == 2
    assert "Invalid value for '--method': 'moments' is not one of 'spectral'" in capsys.readouterr().err


# ---- from a simulated rig to everything that can be done with its log


def test_nothing_that_a_log_names_is_run_or_copied(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A rig file may name a Python file of its user's; a log may come from anybody."""
    effect = "from estimator.effects.stiffness.quintic import QUINTIC as Mine\nopen(__file__ + '.ran', 'w').close()\n"
    (tmp_path / "laws.py").write_text(effect)
    (tmp_path / "secret").write_text("BO_ nobody's business")
    law = f'[[model.custom]]\nname = "mine"\nmodule = "{tmp_path}/laws.py:Mine"\nparameters = {{ k5 = 1e30 }}\n'
    text = rig.read_text().replace("[link]", f'{law}[link]\ndbc = "{tmp_path}/secret"\n', 1)
    (tmp_path / "rig.toml").write_text(text)
    log, again, ran = tmp_path / "a.mcap", tmp_path / "b.mcap", tmp_path / "laws.py.ran"
    assert main(["simulate", str(tmp_path / "rig.toml"), "--seconds", "2", "--out", str(log), "--quiet"]) == 0
    assert {"laws.py", "secret", "rig.toml"} <= set(read_log(log).attachments)
    assert ran.exists()
    ran.unlink()
    sys.modules.pop(next(name for name in sys.modules if name.startswith("rotorscope_custom_laws")))
    assert main(["replay", str(log), "--out", str(again)]) == 2
    assert "laws.py:Mine is a Python file" in capsys.readouterr().err
    assert not ran.exists()
    assert main(["replay", str(log), "--rig", str(tmp_path / "rig.toml"), "--check", "--quiet"]) == 0  # the user's own
    assert ran.exists()
    (tmp_path / "rig.toml").write_text(text + "# another\n")
    assert main(["replay", str(log), "--rig", str(tmp_path / "rig.toml"), "--check"]) == 2
    assert "give that very file" in capsys.readouterr().err
    rig_of_a_log = Rig.parse(text.replace(law, ""))
    assert set(rig_of_a_log.attachments()) == {"rig.toml"}


def test_a_simulated_log_replays_bit_for_bit(rig: Path, log: Path, tmp_path: Path) -> None:
    out = tmp_path / "replay.json"
    assert main(["replay", str(log), "--check", "--json", str(out), "--quiet"]) == 0
    value = valid(out, "run")
    assert value["identical"] is True
    assert value["samples"] == 76800
    assert value["lost_samples"] == 0
    assert read_log(log).rig_text == rig.read_text()


def test_info_and_recover(log: Path, tmp_path: Path) -> None:
    assert main(["info", str(log), "--json", str(tmp_path / "i.json"), "--quiet"]) == 0
    assert valid(tmp_path / "i.json", "info")["complete"] is True
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-100_000])
    assert main(["recover", str(cut), "--out", str(tmp_path / "m.mcap"), "--json", str(tmp_path / "r.json")]) == 0
    assert 0 < valid(tmp_path / "r.json", "recover")["samples_recovered"] < 76800
    assert read_log(tmp_path / "m.mcap").complete


def test_fit_by_score_matching_writes_a_rig(rig: Path, log: Path, tmp_path: Path) -> None:
    out, better = tmp_path / "fit.json", tmp_path / "better.toml"
    arguments = ["fit", str(log), "--rig", str(rig), "--method", "score-matching", "--out", str(better)]
    assert main([*arguments, "--json", str(out), "--quiet"]) == 0
    kL = valid(out, "fit")["parameters"]["bearing1.x.kL"]["value"]
    found = valid(out, "fit")
    assert (found["log"], found["rig"], found["band"], found["rate_hz"]) == (
        str(log),
        str(rig),
        [150.0, 8000.0],
        25600.0,
    )
    assert found["started"].endswith("+00:00")
    assert found["version"]
    assert kL == pytest.approx(10e6, rel=0.03)
    assert f"kL = {kL / 1e6:.9g}e6" in better.read_text()


def test_faults_are_in_the_summary_and_strict_fails(rig: Path, tmp_path: Path) -> None:
    log, out = tmp_path / "f.mcap", tmp_path / "f.json"
    simulate = ["simulate", str(rig), "--out", str(log), "--seconds", "2", "--fault", "drop:0.01", "--quiet"]
    assert main([*simulate, "--json", str(out)]) == 0
    value = valid(out, "run")
    assert value["lost_samples"] == sum(g["count"] for g in value["gaps"]) > 0
    assert value["samples"] + value["lost_samples"] == 51200
    assert main(["run", str(rig), "--link", f"replay:{log}?speed=max", "--strict", "--quiet"]) == 1


def test_the_truth_is_written_then_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import numpy as np

    text = re.sub(r"(?m)^(kL|c|S|kNL) = .*\n", "", PAPER.read_text()).replace("spectral", "score-matching", 1)
    rig, truth = tmp_path / "rig.toml", tmp_path / "truth.toml"
    rig.write_text(text)
    arguments = ["simulate", str(rig), "--seconds", "1", "--truth", str(truth)]
    assert main([*arguments, "--out", str(tmp_path / "a.mcap"), "--quiet"]) == 0
    assert truth.exists()
    assert main(["add", "coulomb", "--rig", str(truth), "--out", str(tmp_path / "t2.toml"), "--quiet"]) == 0
    assert main([*arguments, "--out", str(tmp_path / "b.mcap"), "--quiet"]) == 0
    arguments[-1] = str(tmp_path / "t2.toml")
    assert main([*arguments, "--out", str(tmp_path / "c.mcap"), "--quiet"]) == 0
    a, b, c = (read_log(tmp_path / f"{n}.mcap").samples() for n in "abc")
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 1.0
    assert "coulomb" not in read_log(tmp_path / "c.mcap").rig_text


def test_json_on_standard_output_is_alone_there(rig: Path, log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["info", str(log)], ["effects"], ["effects", "cubic"], ["ports"], ["check", str(rig)]):
        assert main([*arguments, "--json", "-"]) == 0
        json.loads(capsys.readouterr().out)


def test_theory_beside_the_rigs_values(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["theory", str(rig), "--json", "-"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["K_n"] == pytest.approx(2.813e5 * 1e3**1.5, rel=1e-3)
    assert [row["place"] for row in value["fitted"]] == ["bearing1.x", "bearing1.y", "bearing2.x", "bearing2.y"]


# ---- processes


@pytest.fixture
def device(rig: Path) -> Iterator[str]:
    """A device in a process of its own; its link."""
    command = [sys.executable, "-m", "daq", "simulate", str(rig), "--serve", "serial:pty"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("serving serial:/dev/")
        yield line.split()[1]
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


def test_a_device_in_another_process(rig: Path, device: str, tmp_path: Path) -> None:
    out = tmp_path / "run.json"
    arguments = ["run", str(rig), "--link", device, "--seconds", "2", "--out", str(tmp_path / "a.mcap")]
    done = rotorscope(*arguments, "--json", str(out), "--strict")
    assert done.returncode == 0, done.stderr
    assert valid(out, "run")["samples"] == 51200
    assert "bearing1.x.kL" in done.stdout
    assert done.stderr == ""
    assert read_log(tmp_path / "a.mcap").complete


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 0), (signal.SIGHUP, 0)])
def test_a_signal_ends_a_run_with_a_complete_log(
    rig: Path, tmp_path: Path, number: signal.Signals, status: int, record_property: Callable[[str, object], None]
) -> None:
    log = tmp_path / "a.mcap"
    command = [sys.executable, "-m", "daq", "run", str(rig), "--link", "virtual:", "--out", str(log)]
    restore_default = lambda: signal.signal(number, signal.SIG_DFL)  # noqa: E731 - also where these tests run under nohup
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=restore_default
    ) as process:
        until(lambda: log.exists() and log.stat().st_size > 200_000)
        started = time.monotonic()
        process.send_signal(number)
        _, error = process.communicate(timeout=PATIENCE_S)
        took = time.monotonic() - started
    assert process.returncode == status, error
    row = (
        f"stop of `rotorscope run` | {number.name}, live link, log, estimator | complete log, program ended within 2 s"
    )
    record_property("reliability", f"{row} | {took:.2f} s, status {status}")
    within(took, 2.0)
    assert read_log(log).complete
    assert "Traceback" not in error


def test_a_reader_that_has_seen_enough() -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "daq", "effects"]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S, check=False)
    os.close(write)
    assert done.returncode == 0
    assert done.stderr == ""
