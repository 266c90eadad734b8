"""What the command line turns into one line on standard error and an exit status (contract.md)."""

from __future__ import annotations


class RotorscopeError(Exception):
    """One line: what, where, what to do."""

    exit_status = 1


class CheckFailed(RotorscopeError):
    """The check the user asked for failed."""


class ConfigError(RotorscopeError):
    """The rig file or the command's arguments are wrong; several problems come as several lines."""

    exit_status = 2


class LogError(RotorscopeError):
    """A log or data file is missing, unreadable, cut, or does not fit the rig."""

    exit_status = 4
