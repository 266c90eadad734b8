"""Ctrl-C and SIGTERM as an event: a run ends with a complete log instead of dying."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from types import FrameType
from typing import Any

HANG_UP = getattr(signal, "SIGHUP", None)
STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Stop:
    """`event` is set by the first signal; a second Ctrl-C interrupts at once. A context manager, main thread only.

    A thread sets the event. A signal handler would wait for ever for the event's lock if the main thread held it in
    `wait`. The queue that the handler uses instead is reentrant.
    """

    def __init__(self) -> None:
        self.event = threading.Event()
        self.interrupted = False
        self._came = False
        self._requests: SimpleQueue[bool] = SimpleQueue()
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stop:
        go_on()
        self._setter = threading.Thread(target=self._set, name="stop", daemon=True)
        self._setter.start()
        for number in STOP_SIGNALS:
            if number != HANG_UP or signal.getsignal(number) is not signal.SIG_IGN:  # as nohup asks
                self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._requests.put(False)
        self._setter.join()

    def _set(self) -> None:
        while self._requests.get():
            self.event.set()

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        again, self._came = self._came, True
        self._requests.put(True)
        if number == signal.SIGINT:
            self.interrupted = True
            if again:
                raise KeyboardInterrupt


_asked = False  # a stop was requested, even if the KeyboardInterrupt was lost


def interrupt(_number: int, _frame: FrameType | None) -> None:
    """Handle SIGINT as Python does until a command sets a handler, and remember it. A KeyboardInterrupt may be lost:
    Python swallows it in a callback (importlib's), pydantic swallows or replaces it while it builds a class.
    """
    global _asked
    _asked = True
    raise KeyboardInterrupt


def asked() -> bool:
    """Whether this program was interrupted, even if the KeyboardInterrupt was swallowed."""
    return _asked


@contextmanager
def all_or_nothing() -> Iterator[None]:
    """For commands that write a file: SIGTERM and SIGHUP are as Ctrl-C, so that no half of it stays; a second kills."""
    global _asked
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        usual = (signal.SIG_DFL, signal.default_int_handler, interrupt)
        before = {n: handler for n in STOP_SIGNALS if (handler := signal.getsignal(n)) in usual}

    def once(number: int, frame: FrameType | None) -> None:
        signal.signal(number, before[number])
        interrupt(number, frame)

    try:
        go_on()
        for number in before:
            signal.signal(number, once)
        yield
    except Exception as error:
        if _asked:
            raise KeyboardInterrupt from error
        raise
    finally:
        _asked = False
        for number, handler in before.items():
            signal.signal(number, handler)


def go_on() -> None:
    """Check for a stop before a file or an acquisition is started. Raises the KeyboardInterrupt that was swallowed."""
    if _asked and threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt


@contextmanager
def unbroken() -> Iterator[None]:
    """Delay signals to the end of the body, so that each new file is registered for removal before a signal acts."""
    before: dict[int, Any] = {}
    came: list[int] = []
    main = threading.current_thread() is threading.main_thread()  # signals interrupt no other thread
    try:
        for number in STOP_SIGNALS if main else ():
            before[number] = signal.getsignal(number)
            if before[number] not in (signal.SIG_IGN, None):
                signal.signal(number, lambda number, _frame: came.append(number))
        yield
    finally:
        for number, handler in before.items():
            if handler not in (signal.SIG_IGN, None):
                signal.signal(number, handler)
        for number in dict.fromkeys(came):
            signal.raise_signal(number)
