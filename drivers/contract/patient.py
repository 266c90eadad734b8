"""A link that need not be there at the start: one of several devices may be switched on after the others."""

from __future__ import annotations

import threading
import time

from .errors import LinkError
from .reading import Driver, LinkStats, Notice, Reading

RETRY_S = 2.0


class Patient:
    """A driver around another, whose `open` never fails: it says why, and tries again while it is read."""

    def __init__(self, driver: Driver) -> None:
        self.kind = driver.kind
        self.stats: LinkStats = driver.stats
        self._driver = driver
        self._open = False
        self._closed = threading.Event()
        self._why = ""  # the link is not open; each reason is reported once
        self._unsaid: list[Notice] = []
        self._next_try_s = 0.0

    def open(self) -> None:
        self._closed.clear()
        self._try()

    def close(self) -> None:
        self._closed.set()
        self._driver.close()

    def read(self, timeout_s: float) -> list[Reading]:
        if not self._open:
            self._closed.wait(min(timeout_s, max(0.0, self._next_try_s - time.monotonic())))
            if time.monotonic() >= self._next_try_s and not self._closed.is_set():
                self._try()
        if self._unsaid or not self._open:
            said, self._unsaid = self._unsaid, []
            return list(said)
        return self._driver.read(timeout_s)

    @property
    def missing(self) -> str:
        """Reason why the link has not opened yet; "" once it has, or where it was not tried."""
        return "" if self._open else self._why

    @property
    def exhausted(self) -> bool:
        return self._open and self._driver.exhausted

    def _try(self) -> None:
        try:
            self._driver.open()
        except LinkError as error:
            if str(error) != self._why:
                self._why = str(error)
                self._say("error", "link_missing", f"{self._why}; it is tried again")
            self._next_try_s = time.monotonic() + RETRY_S
        else:
            self._open = True
            if self._why:
                self._say("info", "link_back", "the link is open now")
            if self._closed.is_set():  # while it opened
                self._driver.close()

    def _say(self, level: str, code: str, text: str) -> None:
        self._unsaid.append(Notice(time.monotonic_ns(), level, code, text))
