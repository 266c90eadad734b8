"""A thread for what may take long and must not hold acquisition: closing files, removing old ones, writing tables."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

MAX_CHORES = 1000  # that wait; the disk has stalled by then


class Chores:
    """Does chores in order. A chore that fails is reported to `failed` and does not end the thread."""

    def __init__(self, name: str, failed: Callable[[Exception], None], most: int = MAX_CHORES) -> None:
        self._failed = failed
        self._most = most
        self._changed = threading.Condition()
        self._waiting: deque[Callable[[], object]] = deque()
        self._working = self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, chore: Callable[[], object]) -> bool:
        """Do this soon; False if too much waits already, and it will not be done."""
        with self._changed:
            if self._closed or len(self._waiting) >= self._most:
                return False
            self._waiting.append(chore)
            self._changed.notify_all()
            return True

    def idle(self) -> bool:
        """Whether nothing waits."""
        return not self._waiting and not self._working

    def wait(self, timeout_s: float | None = None) -> bool:
        """Until all is done, at most so long; whether it is."""
        with self._changed:
            return self._changed.wait_for(self.idle, timeout_s)

    def close(self, timeout_s: float | None) -> bool:
        """Wait, then end the thread. Returns whether all chores were done; the others stay undone."""
        done = self.wait(timeout_s)
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
        self._thread.join(0.1 if not done else None)
        return done

    def _run(self) -> None:
        while True:
            with self._changed:
                self._working = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                chore = self._waiting.popleft()
                self._working = True
            try:
                chore()
            except Exception as error:  # a defect there must not end the thread
                self._failed(error)
