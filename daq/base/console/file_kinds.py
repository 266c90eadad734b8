"""Kinds of files, by their ending: what a result is never written over, and what is given in place of a log."""

from __future__ import annotations

from pathlib import Path

LOG_MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of an MCAP file
# Data files that `import` reads
IMPORTED_SUFFIXES = (
    ".npz", ".csv", ".tsv", ".lvm", ".mat", ".mf4", ".mdf", ".uff", ".unv", ".uf", ".wav", ".tdms", ".h5", ".hdf5",
    ".parquet",
)  # fmt: skip
NO_RECORDS = {
    ".toml": "is a rig file by its ending, and no log: rotorscope check {} says what is open in it",
    ".dbc": "is a DBC by its ending, and no log: rotorscope init --from {} makes a rig file of it",
}


def other_kind(path: Path) -> str:
    """What a file that is given in place of a log is by its ending, and the command that takes it; "" if not known."""
    if path.suffix.lower() in IMPORTED_SUFFIXES:
        return f"is no log (.mcap); make one of it: rotorscope import {path} --rig RIG --out LOG.mcap"
    return NO_RECORDS.get(path.suffix.lower(), "").format(path)
