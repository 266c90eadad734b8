"""Optional libraries: a missing one is reported in one line with its install command; all else works without it."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from daq.base.contract.errors import ConfigError

PACKAGE_OF_MODULE = {"rerun": "rerun-sdk>=0.41,<0.42"}  # of the core, that a headless logger may leave out


def required(module: str, extra: str, what: str) -> ModuleType:
    """A module that may be missing.

    extra : of the package that has it, such as "formats". what : that needs it, for the user.
    Raises ConfigError if the library is not installed.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != module.split(".")[0]:
            raise
        raise ConfigError(missing_library(module, extra, what)) from error


def check_installed(modules: tuple[str, ...], extra: str, what: str) -> None:
    """Before the work is done. Raises ConfigError if one of the modules is not installed."""
    for module in modules:
        if not installed(module):
            raise ConfigError(missing_library(module, extra, what))


def installed(*modules: str) -> bool:
    """Whether all of the modules are there; they are not loaded."""
    return all(find_spec(module) is not None for module in modules)


def missing_library(module: str, extra: str, what: str) -> str:
    """That a library is missing, and what to type."""
    name = module.split(".")[0]
    package = PACKAGE_OF_MODULE.get(name, f"rotorscope[{extra}]")
    return f"{what}: needs {name}, which is not installed: pip install '{package}'"
