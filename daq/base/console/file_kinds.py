"""Kinds of files that a result is never written over."""

from __future__ import annotations

LOG_MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of an MCAP file
# Data files that `import` reads
IMPORTED_SUFFIXES = (
    ".npz", ".csv", ".tsv", ".lvm", ".mat", ".mf4", ".mdf", ".uff", ".unv", ".uf", ".wav", ".tdms", ".h5", ".hdf5",
    ".parquet",
)  # fmt: skip
