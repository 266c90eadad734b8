"""Small .mf4 files: asammdf's own reading of each, without what opening a file costs.

Up to what the process that reads them would answer; what may come of an answer is another target's (`answer-members`).
"""

from __future__ import annotations

import io
import mmap
from collections.abc import Callable, Sequence
from functools import lru_cache

from asammdf.blocks import utils
from asammdf.blocks.mdf_v4 import MDF4

from daq.exchange.child import Found, of_mf4


def files(pieces: Sequence[bytes]) -> Callable[[int], Found]:
    """Each read whole by asammdf's reader of version 4, as its constructor does once it has opened the file."""
    return lambda k: of_mf4(_opened(pieces[k]), ("b1x",))


_EMPTY = dict(MDF4(None, __internal__=True, original_name=None).__dict__)  # type: ignore[call-arg]
_OWN = [(name, type(value)) for name, value in _EMPTY.items() if type(value) in (list, dict, set)]
_OWN.append(("channels_db", type(_EMPTY["channels_db"])))
_BUSES = tuple(_EMPTY["bus_logging_map"])
_file = mmap.mmap(-1, 1)  # of all of them, one after the other
MDF4.__del__ = lambda self: None  # type: ignore[attr-defined]  # nothing of ours is open
utils.detect = lru_cache(20_000)(utils.detect)  # what a text is written in, asked again of the texts of the good files


def _opened(data: bytes) -> MDF4:
    mdf = MDF4.__new__(MDF4)
    fields = mdf.__dict__
    fields.update(_EMPTY)
    for name, kind in _OWN:
        fields[name] = kind()
    fields["bus_logging_map"] = {bus: {} for bus in _BUSES}
    mdf.determine_max_vlsd_sample_size = mdf._determine_max_vlsd_sample_size
    mdf.extract_attachment = mdf._extract_attachment
    mdf._tempfile = io.BytesIO(b"\0")
    mdf._file = file = _file_of(data)
    mdf._from_filelike = False
    mdf._read(file, mapped=True)
    return mdf


def _file_of(data: bytes) -> mmap.mmap:
    global _file
    size = max(len(data), 1)
    try:
        _file.resize(size)
    except (ValueError, BufferError):  # closed, or something still points into it
        _file = mmap.mmap(-1, size)
    _file.seek(0)
    _file[:] = data or b"\0"
    return _file
