"""Loads the modules of a computation while the log is read and filtered, because the interpreter waits then."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from threading import Thread


def loaded(modules: Sequence[str]) -> None:
    """Begin to import modules, and what numba needs to run what it has compiled: 0.7 s of interpreter for compare.

    An import of the same module waits meanwhile. An import that fails here fails again there, where it is reported. A
    command that ends at once waits too, because a thread that ends in the middle of a library may crash the process.
    """
    Thread(target=_load, args=(tuple(modules),)).start()


def _load(modules: Sequence[str]) -> None:
    with suppress(Exception):
        for name in modules:
            import_module(name)
        import_module("estimator.effects.engine.compiled").ready()
