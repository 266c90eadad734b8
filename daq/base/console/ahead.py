"""What a computation needs, loaded while the log is read and filtered: the interpreter waits then."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from threading import Thread


def loaded(modules: Sequence[str]) -> None:
    """Begin to import modules, and what numba needs to run what it has compiled: 0.7 s of interpreter for compare.

    Whoever imports one meanwhile waits for it, and whatever fails here fails again there, where it is told. A command
    that ends at once waits too: a thread that is cut off in the middle of a library may take the process down.
    """
    Thread(target=_load, args=(tuple(modules),)).start()


def _load(modules: Sequence[str]) -> None:
    with suppress(Exception):
        for name in modules:
            import_module(name)
        import_module("estimator.effects.engine.compiled").ready()
