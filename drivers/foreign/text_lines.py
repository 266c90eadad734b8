"""Lines of a text file of frames, in any encoding of a recorder or a shell."""

from __future__ import annotations

import codecs
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

LONGEST_LINE = 1000  # characters: a file without line ends must not fill the memory


def open_text(file: Path) -> TextIO:
    """The opened file; encoding by its byte order mark, or UTF-16 by zeros between characters, else UTF-8."""
    with file.open("rb") as handle:
        head = handle.read(64)
    encoding = "utf-8"
    if head.startswith(codecs.BOM_UTF8):
        encoding = "utf-8-sig"
    elif head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif len(head) >= 8 and not any(head[1:8:2]) and all(head[0:8:2]):
        encoding = "utf-16-le"
    elif len(head) >= 8 and not any(head[0:8:2]) and all(head[1:8:2]):
        encoding = "utf-16-be"
    return file.open("r", encoding=encoding, errors="replace")


def bounded(lines: TextIO) -> Iterator[str]:
    """Lines of at most LONGEST_LINE characters."""
    while line := lines.readline(LONGEST_LINE):
        yield line
