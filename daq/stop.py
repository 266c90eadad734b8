"""Ctrl-C and SIGTERM as an event: a run ends with a complete log instead of dying."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Stop:
    """`event` is set by the first signal; a second Ctrl-C interrupts at once. A context manager, main thread only."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self.interrupted = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stop:
        for number in SIGNALS:
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
