"""Notices for the operator, at most once a second for each kind: a bad wire must not flood the log."""

from __future__ import annotations

from .reading import Notice

INTERVAL_NS = 1_000_000_000


class Notices:
    """Collects notices between two reads. The first of a kind is reported at once, later ones are counted."""

    def __init__(self) -> None:
        self._ready: list[Notice] = []
        self._last_ns: dict[str, int] = {}
        self._held: dict[str, int] = {}

    def add(self, t_host_ns: int, level: str, code: str, text: str) -> None:
        last = self._last_ns.get(code)
        if last is not None and t_host_ns - last < INTERVAL_NS:
            self._held[code] = self._held.get(code, 0) + 1
            return
        held = self._held.pop(code, 0)
        self._last_ns[code] = t_host_ns
        self._ready.append(Notice(t_host_ns, level, code, f"{text} ({held} more since the last)" if held else text))

    def take(self) -> list[Notice]:
        """The notices since the last call, in order."""
        ready, self._ready = self._ready, []
        return ready
