"""Errors that the command line turns into one line on standard error and an exit status (contract.md)."""

from __future__ import annotations

import errno
from pathlib import Path

# the disk takes no more, or fails
DISK_FULL_ERRNOS = (errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC))


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


def not_written(path: Path, error: OSError) -> RotorscopeError:
    """Of a disk that takes no more, or of a place that is none."""
    if folder := no_folder(path):
        return ConfigError(f"{path}: cannot be written: {folder}")
    if error.errno in DISK_FULL_ERRNOS:
        return LogError(f"{path}: cannot be written: {error.strerror}; make room, or choose another place")
    return ConfigError(f"{path}: cannot be written: {error.strerror}; choose another place")


def no_folder(path: Path) -> str:
    """The remedy where the folder of a file to be written is not there; "" where it is."""
    return "" if path.absolute().parent.exists() else f"folder {path.parent} does not exist; create it first"


def exit_status(error: Exception) -> int | None:
    """Of an error that says one line; also of the parts below, which know no command line. None: a defect."""
    from drivers.contract import LinkError
    from estimator.errors import DataError, ModelError

    if isinstance(error, RotorscopeError):
        return error.exit_status
    table: dict[type[Exception], int] = {LinkError: 3, DataError: 4, ModelError: 2}
    return next((status for kind, status in table.items() if isinstance(error, kind)), None)
