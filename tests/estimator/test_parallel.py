"""Questions answered by two processes: the same answers, whatever becomes of the second, and nothing left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from typing import Any

import pytest

from estimator.parallel import map_processes, map_single_core, map_threads, one_core

BEGIN = """
import json, os, signal, sys, time
os.environ["OPENBLAS_NUM_THREADS"] = "1"
from functools import partial
import numpy as np
from estimator.parallel import map_processes
signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background ignores it
me = os.getpid()
def slow(k, do=lambda: None):
    time.sleep(0.02)
    if os.getpid() != me:
        do()
    return k, os.getpid()
"""


def run(text: str) -> Any:
    """What a program of one thread prints, as JSON."""
    done = subprocess.run([sys.executable, "-c", BEGIN + text], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_two_processes_answer_in_order_and_leave_nothing() -> None:
    found = run(
        """
law = lambda x: x  # cannot be pickled
before = len(os.listdir("/proc/self/fd"))
out = map_processes([partial(slow, (k, law, np.full(3, k))) for k in range(40)], [law])
said = [(int(array[0]), one is law, pid) for (k, one, array), pid in out]
try:
    children = os.waitpid(-1, os.WNOHANG)
except ChildProcessError:
    children = None
print(json.dumps([said, len(os.listdir("/proc/self/fd")) - before, children]))
"""
    )
    said, handles, children = found
    assert [k for k, _, _ in said] == list(range(40))
    assert all(same for _, same, _ in said)
    assert len({pid for _, _, pid in said}) == 2
    assert handles == 0
    assert children is None


@pytest.mark.parametrize(
    "do", ["os.kill(os.getpid(), signal.SIGKILL)", "os._exit(0)", "sys.exit(3)", "1 / 0", "open('/none')"]
)
def test_what_the_second_process_cannot_answer_the_first_does(do: str) -> None:
    found = run(f"print(json.dumps(map_processes([partial(slow, k, lambda: {do}) for k in range(10)])))")
    assert [k for k, _ in found] == list(range(10))


def test_an_answer_that_cannot_be_pickled_is_given_here() -> None:
    assert (
        run("print(json.dumps([f() for f in map_processes([lambda: (lambda: os.getpid() == me)] * 9)]))") == [True] * 9
    )


def test_an_error_is_raised_as_it_is() -> None:
    found = run(
        """
from estimator.errors import DataError
def bad(k):
    time.sleep(0.02)
    if k > 3:
        raise DataError(f"no {k}")
    return k
try:
    map_processes([partial(bad, k) for k in range(8)])
except DataError as error:
    print(json.dumps(str(error)))
"""
    )
    assert found.startswith("no ")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_a_stop_ends_both_processes(number: signal.Signals) -> None:
    text = (
        BEGIN + "map_processes([lambda: os.write(1, b'%d\\n' % os.getpid()) and time.sleep(0.2) or bytes(10**6)] * 100)"
    )
    with subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        pids = {int(child.stdout.readline()) for _ in range(4)}
        assert len(pids) == 2
        child.send_signal(number)
        began = time.monotonic()
        child.communicate(timeout=5.0)  # ends when the second process has closed its output too
        assert time.monotonic() - began < 2.0
        assert child.returncode != 0


def test_beside_other_threads_there_is_one_process() -> None:
    wait = threading.Event()
    other = threading.Thread(target=wait.wait)
    other.start()
    seen: list[int] = []
    try:
        assert set(map_processes([os.getpid] * 5, done=seen.append)) == {os.getpid()}
    finally:
        wait.set()
        other.join()
    assert seen == [1, 2, 3, 4, 5]


def test_progress_is_reported() -> None:
    seen = run(
        "seen = []; map_processes([partial(slow, k) for k in range(20)], done=seen.append); print(json.dumps(seen))"
    )
    assert seen == sorted(seen)
    assert seen[-1] >= 18
    assert map_processes([], done=seen.append) == []
    assert map_processes([partial(int, "7")]) == [7]


def test_on_one_core_everything_is_done_here_and_now() -> None:
    seen: list[int] = []
    with one_core():
        assert set(map_threads(lambda _: threading.get_ident(), range(3), seen.append)) == {threading.get_ident()}
        assert map_processes([os.getpid, threading.active_count]) == [os.getpid(), threading.active_count()]
    assert seen == [1, 2, 3]
    assert set(map_threads(lambda _: threading.get_ident(), range(3))) != {threading.get_ident()}


def test_several_questions_with_one_core_each_start_no_threads() -> None:
    def threads_of_a_map() -> int:
        return len({*map_threads(lambda _: threading.get_ident(), range(3))} - {threading.get_ident()})

    assert map_single_core([threads_of_a_map] * 3) == [0, 0, 0]
    assert map_single_core([threads_of_a_map]) != [0]
