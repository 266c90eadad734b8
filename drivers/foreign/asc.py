"""Vector .asc: by python-can, which leaves out in silence what it does not know; what may be a damaged frame is told.

Other events (status, statistics, other buses, comments) are known by their first words and left out as they should be.
python-can reads the head at the start of each loop, and a line too much; here a loop may begin anew behind a damaged
line, and the line behind the head is read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain
from typing import Any, TextIO

import can

_FRAME_LINE = re.compile(r"\d+\.\d+\s+(?:\d+\s+(?:\w+\s+(?:Tx|Rx)|ErrorFrame)|(?-i:CANFD)\s)", re.ASCII | re.IGNORECASE)
_OTHER_LINE = re.compile(
    r"$|//|;|date\s|base\s|(?:no\s+)?internal\s+events\s+logged|begin\s+trigger|end\s+trigger|previous\s+log"
    r"|\d+\.\d+\s+(?:CAN\s+\d+\s+Status|\d+\s+(?:Statistic|J1939TP|OverloadFrame)|(?!CAN)[A-Z][A-Z0-9_]+[\s:])",
    re.ASCII | re.IGNORECASE,
)


class AscReader(can.ASCReader):  # type: ignore[misc]
    """An iteration that has raised may begin anew, and goes on behind the damage. lines : of the file, bounded."""

    goes_on = True

    def __init__(self, file: TextIO, lines: Iterator[str]) -> None:
        self._begun = False
        self._handle, self._lines = file, lines
        super().__init__(file)

    def stop(self) -> None:
        self._handle.close()

    def _extract_header(self) -> None:
        if self._begun:
            return
        self._begun = True
        head: list[str] = []
        self.file = _noted(self._lines, head)
        super()._extract_header()
        self.file = _Lines(chain(head[-1:], self._lines), max(len(head) - 1, 0))

    def _process_data_string(self, data_str: str, data_length: int, msg_kwargs: dict[str, Any]) -> None:
        super()._process_data_string(data_str, data_length, msg_kwargs)
        if len(msg_kwargs["data"]) < data_length:
            raise ValueError(f"a frame of {data_length} bytes has {len(msg_kwargs['data'])}")


class _Lines:
    """Those that python-can reads, or knowingly leaves out. It raises ValueError for another, and goes on behind it."""

    def __init__(self, lines: Iterator[str], number: int) -> None:
        self._lines, self._number = lines, number

    def __iter__(self) -> _Lines:
        return self

    def __next__(self) -> str:
        line = next(self._lines)
        self._number += 1
        text = line.strip()
        if not _FRAME_LINE.match(text) and not _OTHER_LINE.match(text):
            raise ValueError(f"line {self._number} is neither a frame nor an event of another kind")
        return line


def _noted(lines: Iterator[str], seen: list[str]) -> Iterator[str]:
    for line in lines:
        seen.append(line)
        yield line
