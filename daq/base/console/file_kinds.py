"""Kinds of files that a result is never written over."""

from __future__ import annotations

LOG_MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of an MCAP file
IMPORTED_SUFFIXES = (".npz", ".csv", ".mat", ".mf4", ".uff", ".unv", ".wav")  # data files that `import` reads
