"""Ctrl-C before there is anything to close; standard streams that are closed; names that cannot be."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from promises import PATIENCE_S

from daq.base.console.stop import Stop, interrupt
from daq.commands.cli.app import main
from daq.log.reader import read_log

RIG = Path(__file__).parents[3] / "configs" / "tiwari_vyas_1997.toml"
BEGIN = """
import os, signal, sys, threading, time
from daq.commands.entry import main
after_s = float(sys.argv.pop())
def interrupt():
    while signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        time.sleep(0.001)
    time.sleep(after_s)
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=interrupt, daemon=True).start()
sys.exit(main())
"""


def test_an_interrupt_while_what_clears_away_is_imported_itself() -> None:
    half = "import sys, types; sys.modules['daq.base.console.unfinished'] = types.ModuleType('half')"
    code = f"{half}; from daq.commands.entry import _leave; _leave()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr) == (130, b"rotorscope: interrupted\n")


def test_a_fit_that_overflows_prints_no_warning_of_numpy() -> None:
    """Of two records in forty an answer came with lines such as "overflow encountered in matmul"."""
    late = "warnings.warn_explicit('overflow encountered in add', RuntimeWarning, 'x.py', 1, 'estimator.likelihood.x')"
    code = (
        "import sys, warnings; from daq.commands import entry; sys.argv = ['rotorscope', '--version']\n"
        f"entry._end = lambda status: {late}\nentry.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=PATIENCE_S, check=False)
    assert done.stderr == b""


@pytest.mark.parametrize("after_s", [0.005, 0.02, 0.05, 0.1, 0.2, 0.3])
def test_an_interrupt_while_python_imports_ends_quietly(
    after_s: float, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """Timed from the program's own start: what Python itself does before that is not ours."""
    words = ["run", str(RIG), "--link", "virtual:", "--out", str(tmp_path / "a.mcap"), str(after_s)]
    command = [sys.executable, "-c", BEGIN, *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's background job ignores it
    ) as process:  # fmt: skip
        try:
            _, said = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert len(said.splitlines()) <= 1
    row = f"stop while Python imports | SIGINT {after_s:g} s after the program's start | one line, status 130"
    record_property("reliability", f"{row} | status {process.returncode}, {len(said.splitlines())} lines")


@pytest.mark.parametrize("after_s", [0.01, 0.1, 0.3])
def test_sigterm_while_python_imports_ends_a_run_as_it_ends_one_later(after_s: float, tmp_path: Path) -> None:
    begin = BEGIN.replace(
        "signal.getsignal(signal.SIGINT) is signal.default_int_handler",
        "signal.getsignal(signal.SIGTERM) is signal.SIG_DFL",
    ).replace("getpid(), signal.SIGINT", "getpid(), signal.SIGTERM")
    words = ["run", str(RIG), "--link", "virtual:", "--out", str(tmp_path / "a.mcap"), str(after_s)]
    done = subprocess.run([sys.executable, "-c", begin, *words], capture_output=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


UNRAISABLE = """
import signal, sys, time, weakref
from daq.commands.entry import main
from daq.commands.cli import app
from daq.base.console.stop import Stop
class Lock: pass
def command(*_):
    def callback(_):
        signal.raise_signal(signal.SIGINT)
    lock = Lock()
    reference = weakref.ref(lock, callback)
    del lock
    if sys.argv[-1] == "acquiring":
        with Stop():
            raise AssertionError("begun")
    time.sleep(600)
app.application = command
main()
"""


@pytest.mark.parametrize("then", ["acquiring", "computing"])
def test_an_interrupt_in_a_callback_of_pythons_is_a_line(then: str) -> None:
    command = [sys.executable, "-c", UNRAISABLE, then]
    done = subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr) == (130, b"rotorscope: interrupted\n")


def _failing() -> None:
    raise ValueError("SchemaError: KeyboardInterrupt")  # as pydantic makes of it


def _acquiring() -> None:
    with Stop():
        raise AssertionError("begun")


@pytest.mark.parametrize("then", [_failing, _acquiring])
def test_an_interrupt_that_is_swallowed_while_a_command_imports_ends_it(
    then: Callable[[], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By importlib's callbacks and by pydantic, 1 of 200: an acquisition went on for as long as it was asked to."""

    def command(*_: object) -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        then()

    monkeypatch.setattr("daq.base.console.stop._asked", False)
    monkeypatch.setattr("daq.commands.cli.app.application", command)
    before = signal.signal(signal.SIGINT, interrupt)
    try:
        assert main(["effects"]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "rotorscope: interrupted\n"


STUCK = """
import time
from concurrent.futures import ThreadPoolExecutor
from daq.commands.entry import main
ThreadPoolExecutor(1).submit(time.sleep, 600)
main()
"""


def test_the_end_does_not_wait_for_a_thread_that_still_computes() -> None:
    """The rolling estimator's, after the stop: Python waits for what a pool has started."""
    command = [sys.executable, "-c", STUCK, "effects", "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["effects"]


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_standard_streams_neither_stop_a_command_nor_end_up_in_its_log(
    closed: str, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """As some init scripts start a service: the next file that is opened would be descriptor 0, 1 or 2."""
    write_columns(tmp_path / "a.npz")
    command = f"exec {sys.executable} -m daq import a.npz --rig {RIG} --out a.mcap {closed}"
    done = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    log = read_log(tmp_path / "a.mcap")
    assert log.complete
    assert log.n_samples == 2000
    row = f"standard streams closed | `import`, {closed} | as ever, and nothing of theirs in the log"
    record_property("reliability", f"{row} | status 0, complete")


def write_columns(path: Path) -> Path:
    y = np.random.default_rng(0).standard_normal((2000, 4))
    columns = dict(zip(("b1x", "b1y", "b2x", "b2y"), y.T, strict=True))
    np.savez(path, allow_pickle=False, rate_hz=25_600.0, **columns)
    return path


def test_a_name_that_is_too_long_is_reported_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = str(write_columns(tmp_path / "a.npz"))
    assert main(["import", good, "--rig", str(RIG), "--out", 300 * "a" + ".mcap"]) == 4
    assert main(["import", 300 * "a" + ".npz", "--rig", str(RIG), "--out", "a.mcap"]) == 4
    said = capsys.readouterr().err
    assert said.count("\n") == 2
    assert said.count("File name too long; choose another name or place") == 2
    assert "unexpected" not in said
