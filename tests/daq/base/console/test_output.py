"""What is said, where results are written, and what lies there already."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from promises import PATIENCE_S
from sessions import make_session, make_stream, write_log

from daq.base.console.output import Output
from daq.commands.cli.app import main
from daq.commands.live.parts import Operator
from drivers.contract.reading import Notice

RIG = Path(__file__).parents[4] / "configs" / "tiwari_vyas_1997.toml"
Property = Callable[[str, object], None]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "a.mcap"
    write_log(path)
    return path


def rotorscope(*arguments: str | bytes, **more: str) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "daq", *arguments]
    return subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=False, env=os.environ | more)


@pytest.mark.parametrize(
    "arguments",
    [
        ["info", "LOG", "--json", "LOG"],
        ["info", "LOG", "--json", "DATA"],
        ["info", "LOG", "--json", "RIG"],
        ["check", "RIG", "--json", "OTHER"],
        ["fit", "LOG", "--rig", "RIG", "--out", "LOG"],
        ["improve", "LOG", "--rig", "RIG", "--out", "OTHER"],
        ["compare", "LOG", "--rig", "RIG", "--html", "LOG"],
        ["diagnose", "LOG", "--rig", "RIG", "--html", "RIG"],
        ["add", "clearance", "--rig", "RIG", "--out", "LOG"],
        ["remove", "cubic", "--rig", "RIG", "--out", "DATA"],
    ],
    ids=" ".join,
)
def test_a_result_is_never_written_over_a_measurement(
    log: Path, arguments: list[str], capsys: pytest.CaptureFixture[str], record_property: Property
) -> None:
    """Nor over a rig file if it is none. OTHER is a log of another name."""
    files = {"LOG": log, "DATA": log.with_name("a.npz"), "RIG": log.with_name("a.toml"), "OTHER": log.with_name("a")}
    files["OTHER"].write_bytes(log.read_bytes())
    files["DATA"].write_bytes(b"of somebody")
    files["RIG"].write_bytes(RIG.read_bytes())
    before = {path: path.read_bytes() for path in files.values()}
    assert main([str(files.get(word, word)) for word in arguments]) == 2
    assert f"{files[arguments[-1]]}: a result is not written over" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in log.parent.iterdir()} == before
    row = f"result over a measurement or rig file | `{' '.join(arguments)}` | refused before the work, all as it was"
    record_property("reliability", f"{row} | status 2, bit for bit")


def test_a_run_whose_result_is_to_take_the_name_of_its_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "a.mcap")
    assert main(["simulate", str(RIG), "--out", out, "--seconds", "0.5", "--json", out]) == 2
    assert "a result is not written over" in capsys.readouterr().err
    assert main(["info", out, "--quiet"]) == 0


def test_what_files_and_their_names_say_does_not_command_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], record_property: Property
) -> None:
    """Colours, titles, a cleared screen: from a log, a name, a rig file."""
    evil = "a\x1b[31mred\x1b]0;title\x07\x9b2J\x7f"
    path = tmp_path / f"{evil}.mcap"
    write_log(path, make_stream(4), replace(make_session(), device=evil, metadata={"link": evil, evil: "x"}))
    rig = tmp_path / "a.toml"
    rig.write_text('[[channel]]\nname = "b\\u001b[31m"\n')
    for arguments in (["info", str(path)], ["recover", str(path), "--out", str(tmp_path / f"{evil}2.mcap")]):
        assert main(arguments) == 0
    for arguments in (["info", str(tmp_path / evil)], ["check", str(rig)]):
        assert main(arguments) != 0
    said = "".join(capsys.readouterr())
    assert "a\N{REPLACEMENT CHARACTER}[31mred" in said
    assert not {c for c in said if not c.isprintable()} - {"\n"}
    row = "hostile text | control sequences in a log, a file's name, a rig file | none reaches the terminal"
    record_property("reliability", f"{row} | held")


def test_names_that_are_no_text_and_a_terminal_of_few_letters(log: Path, record_property: Property) -> None:
    name = os.fsencode(log.with_name("Prüfstand ")) + b"\xff.mcap"
    log.rename(os.fsdecode(name))
    assert main(["recover", os.fsdecode(name), "--out", str(log), "--quiet"]) == 0
    facts = log.with_name("e.json")
    done = rotorscope(
        "export", os.fsencode(log), "--to", name + b".npz", "--json", os.fsencode(facts), PYTHONIOENCODING="ascii"
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(facts.read_bytes())["file"] == os.fsdecode(name + b".npz")
    assert b"Pr\\xfcfstand \\udcff.mcap.npz" in done.stdout
    row = "names that are no text | log, export and `--json` of such names, a terminal of ASCII only | done and said"
    record_property("reliability", f"{row} | status 0")


def test_a_log_into_standard_output(record_property: Property) -> None:
    done = rotorscope("run", str(RIG), "--link", "virtual:", "--seconds", "1", "--out", "/dev/stdout")
    assert (done.returncode, done.stdout) == (4, b"")
    assert b"the log /dev/stdout: it is no file, and a log cannot go into a pipe; choose another" in done.stderr
    row = "log into a pipe | `run --out /dev/stdout`, read by another program | refused at once, in its name"
    record_property("reliability", f"{row} | status 4")


WORKS = """
import os
import time
from daq.base.console.output import Output

with Output().progress("working") as progress:
    progress(0.1, "a long stage")
    end = time.monotonic() + 1.4
    while time.monotonic() < end:
        sum(range(1000))
    os.write(2, b"END")
"""


def test_the_time_of_a_bar_goes_on_where_no_stage_is_reported() -> None:
    """On a terminal; and without a thread, as the estimator works in two processes only where there is one."""
    terminal, its = pty.openpty()
    work = subprocess.Popen([sys.executable, "-c", WORKS], stderr=its)
    os.close(its)
    said = b""
    with suppress(OSError), os.fdopen(terminal, "rb", buffering=0) as reader:
        while part := reader.read(1 << 16):
            said += part
    assert work.wait(PATIENCE_S) == 0
    assert b"working: a long stage" in said
    assert b"0:00:01" in said.partition(b"END")[0]


def test_a_reported_fault_has_its_end_reported(capsys: pytest.CaptureFixture[str]) -> None:
    """Also without --verbose, which is for the rest."""
    operator = Operator(Output(), "fan")
    for level, code in (("error", "link_lost"), ("info", "link_back"), ("info", "shutdown_failed")):
        operator(Notice(0, level, code, code))
    assert capsys.readouterr().err == "rotorscope: fan: error: link_lost\nrotorscope: fan: note: link_back\n"


LINKED = {"json": ["info", "LOG", "--json"], "toml": ["add", "clearance", "--rig", "RIG", "--out"],
          "wav": ["export", "LOG", "--to"], "mcap": ["recover", "LOG", "--out"]}  # fmt: skip


@pytest.mark.parametrize("suffix", LINKED)
def test_a_symbolic_link_stays_and_leads_to_the_result(
    log: Path, suffix: str, capsys: pytest.CaptureFixture[str], record_property: Property
) -> None:
    """To nothing yet, to a file, and in a circle, which is refused."""
    folder = log.parent
    (folder / "disk").mkdir()
    command = [{"LOG": str(log), "RIG": str(RIG)}.get(word, word) for word in LINKED[suffix]]
    target, link = folder / "disk" / f"r.{suffix}", folder / f"r.{suffix}"
    link.symlink_to(f"disk/r.{suffix}")
    for _ in range(2):
        assert main([*command, str(link)]) == 0
        assert link.is_symlink()
        assert target.stat().st_size > 100
    assert not [p for p in (folder / "disk").iterdir() if p.name.startswith(".")]
    circle = folder / f"c.{suffix}"
    circle.symlink_to(circle.name)
    capsys.readouterr()
    assert main([*command, str(circle)]) in (2, 4)
    (facts,) = capsys.readouterr().err.splitlines()
    assert "Too many levels of symbolic links" in facts
    assert circle.is_symlink()
    row = f"symbolic link as a place | `{' '.join(LINKED[suffix])}` a link to nothing, to a file, in a circle"
    record_property("reliability", f"{row} | written where it leads, the link stays; the circle refused | held")


def test_standard_output_by_its_name_is_not_replaced(log: Path, tmp_path: Path) -> None:
    """As /dev/stdout is made; root could replace that one for the whole machine."""
    link, out = tmp_path / "stdout", tmp_path / "out.json"
    link.symlink_to("/proc/self/fd/1")
    with out.open("wb") as file:
        command = [sys.executable, "-m", "daq", "info", str(log), "--json", str(link), "--quiet"]
        assert subprocess.run(command, stdout=file, timeout=PATIENCE_S, check=False).returncode == 0
    assert link.is_symlink()
    assert json.loads(out.read_text())["complete"] is True
