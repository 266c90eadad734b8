"""Errors of a link; the command line turns each into one line and exit status 3."""

from __future__ import annotations

import shlex


class LinkError(Exception):
    """A link cannot be used. The text says what, where and what to do, in one line."""


class LinkUnavailable(LinkError):
    """A library, permission or platform is missing: installing or granting something would help."""


class LinkOpenError(LinkError):
    """The link exists in principle but cannot be opened: wrong port, busy, refused, wrong address."""


class BusError(LinkOpenError):
    """A file of several buses: one is to be chosen with ?bus=, or the one that was asked for is not there.

    what : what is wrong, and where. file : its path. buses : names that can be chosen.
    """

    def __init__(self, what: str, file: str, buses: tuple[str, ...]) -> None:
        self.what, self.file, self.buses = what, file, buses
        ways = " or ".join(f"--link {shlex.quote(f'capture:{name}')}" for name in self.choices)
        super().__init__(f"{what}; choose one: {ways}" if ways else what)

    @property
    def choices(self) -> list[str]:
        """The file with each bus, as a link or `rotorscope import` takes it."""
        return [f"{self.file}?bus={bus}" for bus in self.buses]
