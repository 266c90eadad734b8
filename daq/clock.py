"""Time: the one clock of the service."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Where every time in the service comes from; tests bring their own."""

    def now_ns(self) -> int:
        """Host monotonic time."""
        ...

    def wall_offset_ns(self) -> int:
        """Unix time minus host monotonic time."""
        ...


class SystemClock:
    """The operating system's."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def wall_offset_ns(self) -> int:
        return time.time_ns() - time.monotonic_ns()
