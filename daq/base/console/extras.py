"""Libraries of the extras: one that is missing is said in one line, with what to type."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from daq.base.contract.errors import ConfigError


def required(module: str, extra: str, what: str) -> ModuleType:
    """A module of an extra.

    extra : of the package, such as "formats". what : that needs it, for the user.
    Raises ConfigError if the library is not installed.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != module.split(".")[0]:
            raise
        raise ConfigError(missing_text(module, extra, what)) from error


def missing_text(module: str, extra: str, what: str) -> str:
    """That a library of an extra is missing, and what to type."""
    return f"{what}: needs {module.split('.')[0]}, which is not installed: pip install 'rotorscope[{extra}]'"
