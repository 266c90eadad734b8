"""Ctrl-C and SIGTERM as an event: a run ends with a complete log instead of dying."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

HANG_UP = getattr(signal, "SIGHUP", None)
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Stop:
    """`event` is set by the first signal; a second Ctrl-C interrupts at once. A context manager, main thread only."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self.interrupted = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stop:
        for number in SIGNALS:
            if number != HANG_UP or signal.getsignal(number) is not signal.SIG_IGN:  # as nohup asks
                self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        again = self.event.is_set()
        self.event.set()
        if number == signal.SIGINT:
            self.interrupted = True
            if again:
                raise KeyboardInterrupt


@contextmanager
def all_or_nothing() -> Iterator[None]:
    """For commands that write a file: SIGTERM and SIGHUP are as Ctrl-C, so that no half of it stays; a second kills."""
    mine = []
    if threading.current_thread() is threading.main_thread():
        mine = [n for n in SIGNALS if n != signal.SIGINT and signal.getsignal(n) is signal.SIG_DFL]

    def interrupt(number: int, _frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise KeyboardInterrupt

    for number in mine:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, signal.SIG_DFL)
