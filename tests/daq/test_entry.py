"""Ctrl-C before there is anything to close."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from promises import PATIENCE_S

RIG = Path(__file__).parents[2] / "configs" / "tiwari_vyas_1997.toml"
BEGIN = """
import os, signal, sys, threading, time
from daq.entry import main
after_s = float(sys.argv.pop())
def interrupt():
    while signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        time.sleep(0.001)
    time.sleep(after_s)
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=interrupt, daemon=True).start()
sys.exit(main())
"""


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
