"""Modules that are loaded while a log is read."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from daq.base.console import ahead

LOADS = """
import sys, threading
from daq.base.console.ahead import loaded
loaded(["scipy.ndimage"])
for thread in threading.enumerate():
    if thread is not threading.main_thread():
        thread.join()
from estimator.effects.engine import compiled
print("scipy.ndimage" in sys.modules, bool(compiled.rise.stats.cache_hits) or bool(compiled.rise.stats.cache_misses))
"""


def test_modules_and_what_numba_needs_are_there_when_it_ends() -> None:
    said = subprocess.run([sys.executable, "-c", LOADS], capture_output=True, text=True, timeout=120, check=True)
    assert (said.stdout.split(), said.stderr) == (["True", "True"], "")


def test_what_cannot_be_loaded_is_left_to_whoever_imports_it(capfd: pytest.CaptureFixture[str]) -> None:
    before = set(threading.enumerate())
    ahead.loaded(["no_such_module"])
    for thread in set(threading.enumerate()) - before:
        thread.join()
    assert capfd.readouterr() == ("", "")
