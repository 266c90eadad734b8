"""The service: rig file, links, acquisition, log, reports and the command line.

The public names, for a notebook:

`load_rig` reads a rig file, `acquire` records samples from a link, `read_log` opens a log (`.samples(rig)` is the
array that the estimator takes), and `replay` runs a log through the pipeline again. Everything is in SI units. The
names are bound at first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .base.contract.errors import ConfigError, LogError
    from .base.contract.part import Part
    from .log.reader import Recording, read_log
    from .rig.rig import Rig, load_rig
    from .session.acquire import RunSummary
    from .session.service import acquire, replay

__all__ = [
    "ConfigError",
    "LogError",
    "Part",
    "Recording",
    "Rig",
    "RunSummary",
    "acquire",
    "load_rig",
    "read_log",
    "replay",
]

_ROOM_OF = {  # public name -> the module that defines it
    "ConfigError": "base.contract.errors",
    "LogError": "base.contract.errors",
    "Part": "base.contract.part",
    "Recording": "log.reader",
    "Rig": "rig.rig",
    "RunSummary": "session.acquire",
    "acquire": "session.service",
    "load_rig": "rig.rig",
    "read_log": "log.reader",
    "replay": "session.service",
}


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_ROOM_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
