"""Something done now and then while the main thread works, without a thread."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def ticking(every_s: float, call: Callable[[], object]) -> Iterator[None]:
    """`call` about every `every_s` seconds within, between two steps of Python of the main thread, which it interrupts;
    never within itself, and not again once it raised OSError. Nothing on Windows, which has no such timer.
    """
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    on = True

    def tick(*_: object) -> None:
        nonlocal on
        try:
            if on:
                call()
        except RuntimeError:  # it interrupted somebody who writes to the same stream
            pass
        except OSError:
            on = False
        if on:
            signal.setitimer(signal.ITIMER_REAL, every_s)

    before = signal.signal(signal.SIGALRM, tick)
    try:
        signal.setitimer(signal.ITIMER_REAL, every_s)
        yield
    finally:
        on = False  # before the timer is: one that has rung already must not wind it again
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
