"""Small .mf4 files: asammdf's own reading of each, without what opening a file costs.

Up to what the process that reads them would answer; what may come of an answer is another target's (`answer-members`).
"""

from __future__ import annotations

import io
import mmap
from collections.abc import Callable, Sequence
from typing import Any

from asammdf.blocks.mdf_v4 import MDF4

from daq.import_child import Found, of_mf4


def files(pieces: Sequence[bytes]) -> Callable[[int], Found]:
    """Each read whole by asammdf's reader of version 4, as its constructor does once it has opened the file."""
    return lambda k: of_mf4(_opened(pieces[k]), ("b1x",))


_EMPTY = dict(MDF4(None, __internal__=True, original_name=None).__dict__)  # type: ignore[call-arg]
MDF4.__del__ = lambda self: None  # type: ignore[attr-defined]  # nothing of ours is open


def _opened(data: bytes) -> MDF4:
    mdf = MDF4.__new__(MDF4)
    own: dict[str, Any] = {name: type(value)() for name, value in _EMPTY.items() if type(value) in (list, dict, set)}
    own["bus_logging_map"] = {bus: {} for bus in _EMPTY["bus_logging_map"]}
    own["channels_db"] = type(_EMPTY["channels_db"])()
    mdf.__dict__.update(_EMPTY | own)
    mdf.determine_max_vlsd_sample_size = mdf._determine_max_vlsd_sample_size
    mdf.extract_attachment = mdf._extract_attachment
    mdf._tempfile = io.BytesIO(b"\0")
    mdf._file = file = mmap.mmap(-1, max(len(data), 1))
    file[: len(data)] = data
    mdf._from_filelike = False
    mdf._read(file, mapped=True)
    return mdf
