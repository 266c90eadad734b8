"""Promises in seconds and in shares of a core, asked of a machine that may be busy with something else.

A defect breaks them every time; a neighbour's work that takes the core now and then does not.
"""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 120.0  # where only a hang matters
TRIES = 3  # of a test in which a promise in seconds was not kept (conftest.py)
SPIN_S = 0.2


class Late(AssertionError):
    """A promise in seconds was not kept: the test is tried again, and must keep it then."""


def crowding() -> float:
    """How many times longer than alone on its core a thread takes at this moment."""
    begin, cpu = time.monotonic(), time.thread_time()
    while time.monotonic() < begin + SPIN_S:
        pass
    return max(1.0, (time.monotonic() - begin) / max(time.thread_time() - cpu, 1e-3))


def within(took_s: float, promised_s: float) -> None:
    """Seconds of wall time, promised on a machine whose cores are free; on one that others use, in proportion."""
    if took_s < promised_s:
        return
    times = crowding()
    if took_s >= promised_s * times:
        raise Late(f"{took_s:.3f} s, where {promised_s:g} s are promised; each core is shared by {times:.1f}")


def least_share(
    used: Callable[[], float], wait: Callable[[float], object], below: float, window_s: float = 1.0
) -> float:
    """The share of a core in the quietest of a few windows: a busy loop is in all of them.

    used : CPU seconds so far. wait : lets so many seconds pass. below : what is promised; the first window far below
    it is the last.
    """
    shares = []
    for _ in range(5):
        begin, cpu = time.monotonic(), used()
        wait(window_s)
        shares.append((used() - cpu) / (time.monotonic() - begin))
        if shares[-1] < below / 2:
            break
    return min(shares)


def until(done: Callable[[], object], seconds: float = PATIENCE_S) -> None:
    """Wait for what must come, whenever that is."""
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, f"waited {seconds:g} s in vain"
        time.sleep(0.02)
