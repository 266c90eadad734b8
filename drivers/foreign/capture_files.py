"""Recorded CAN traffic as batches of frames: candump .log, Vector .asc and .blf, and .mf4."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

from drivers.contract.errors import LinkOpenError, LinkUnavailable

from .asc import asc_batches
from .candump import candump_batches
from .capture_batches import Batches, batches_of

CAPTURE_SUFFIXES = (".log", ".blf", ".asc", ".mf4")  # of recorded CAN traffic
HEAD_BYTES = 8
# First bytes of kinds of files: their ending, and what to say where it is another
KINDS_OF_HEAD = {
    b"LOGG": (".blf", "a Vector BLF file by its first bytes: name it .blf"),
    b"MDF     ": (".mf4", "an MDF file by its first bytes: name it .mf4"),
    b"\x1f\x8b": (".gz", "compressed with gzip: unpack it first"),
    b"PK\x03\x04": (".zip", "a ZIP archive: unpack it first"),
    b"(": (".log", "a candump log by its first line: name it .log"),
}
BLF_FIRST_BUS = 1  # python-can counts the channels of a BLF file from 0, the file from 1


def open_capture(path: str, names: Mapping[str, int] | None = None) -> Batches:
    """Batches of a file, in the order of the file. names : message -> identifier, for files that name messages.

    Raises LinkOpenError | LinkUnavailable; LinkOpenError also with the first batch of a file that is of another kind.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in CAPTURE_SUFFIXES:
        what = suffix or "a file without ending"
        remedy = " (a PCAN trace: convert it to .asc with PEAK's converter)" if suffix == ".trc" else ""
        raise LinkOpenError(f"capture:{path}: cannot read {what}{remedy}: use {', '.join(CAPTURE_SUFFIXES)}")
    try:
        if file.exists() and not file.is_file():  # a pipe would hold us until somebody writes
            raise LinkOpenError(f"capture:{path}: is not a file that can be read to its end: save the traffic first")
        with file.open("rb") as handle:
            head = handle.read(HEAD_BYTES)
    except OSError as error:
        raise LinkOpenError(f"capture:{path}: {error.strerror}: check the path") from error
    for begin, (ending, what) in KINDS_OF_HEAD.items():
        if head.startswith(begin) and suffix != ending:
            raise LinkOpenError(f"capture:{path}: {what}")
    if suffix == ".log":
        return candump_batches(file)
    if suffix == ".asc":
        return asc_batches(file, names)
    if suffix == ".mf4":
        from .mf4_capture import Mf4Batches

        return Mf4Batches(file)
    return _blf(file, path)


def _blf(file: Path, path: str) -> Batches:
    """python-can's reader on a handle that this function closes: its own stays open for a file of another kind."""
    log = logging.getLogger("can")  # what it says about each frame would fill the terminal: damage is counted
    if not log.handlers:
        log.addHandler(logging.NullHandler())
    handle = file.open("rb")
    try:
        from .blf import BlfReader

        reader = BlfReader(handle)
    except ImportError as error:
        handle.close()
        raise LinkUnavailable(f"capture:{path}: {error}: install the missing library") from error
    except Exception as error:
        handle.close()
        text = " ".join(str(error).split())
        raise LinkOpenError(f"capture:{path}: not a .blf file ({text}): check the file") from error
    return batches_of(reader, file, BLF_FIRST_BUS)
