"""Lines of numbers as text: one line a sample, numbers between commas, semicolons, blanks or tabs."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import CanFrames

from .packets import MAX_PAYLOAD, Packets

LINE_ID = 1  # of the frames
MAX_NUMBERS = MAX_PAYLOAD // 8
MAX_LINE = 1024  # bytes; a longer one is no line of numbers
BLANK_SEPARATORS = bytes.maketrans(b",;\t\r", b"    ")
NUMBER_BYTES = np.isin(np.arange(256), np.frombuffer(b"0123456789+-.eE \n", np.uint8))


class TextNumbersFramer:
    """A frame for each line with as many numbers as most of the first lines have; the numbers as 64-bit floats."""

    def __init__(self) -> None:
        self._tail = b""
        self._columns = 0  # numbers of a line; 0 before it is known
        self._cut = True  # the line under way may have lost its beginning
        self._damaged = 0

    def reset(self) -> None:
        """Forget the line under way: the port was closed in between."""
        self._tail, self._cut = b"", True

    def feed(self, chunk: bytes) -> Packets:
        """The lines of the stream up to here."""
        whole, newline, rest = (self._tail + chunk).rpartition(b"\n")
        self._tail = rest[-MAX_LINE:]
        self._cut |= len(rest) > MAX_LINE
        if not newline:
            return self._packets(np.zeros((0, 1)), [])
        text = whole.translate(BLANK_SEPARATORS) + b"\n"
        data = np.frombuffer(text, np.uint8)
        stops = np.flatnonzero(data == 10)
        counts = _tokens(data, stops)
        clean = np.diff(np.concatenate([[0], np.cumsum(~NUMBER_BYTES[data])[stops]])) == 0
        empty = counts == 0
        if self._cut:  # it may be the end of a line
            clean[0], empty[0], self._cut = False, True, False
        if not self._columns and clean.any():
            self._columns = Counter(counts[clean & (counts > 0)].tolist() or [0]).most_common(1)[0][0]
        good = clean & (counts == self._columns) & (counts > 0) & (counts <= MAX_NUMBERS)
        values, read = _values(text, good, self._columns)
        good[np.flatnonzero(good)[~read]] = False
        holes, waiting = [], self._damaged
        for k in np.flatnonzero(~empty).tolist():
            if good[k]:
                holes.append(waiting)
                waiting = 0
            else:
                waiting += 1
        self._damaged = waiting if self._columns else 0
        return self._packets(values[read], holes)

    def _packets(self, values: NDArray[np.float64], holes: list[int]) -> Packets:
        n = len(values)
        payload = np.zeros((n, MAX_PAYLOAD), np.uint8)
        if n:
            payload[:, : 8 * values.shape[1]] = np.ascontiguousarray(values, "<f8").view(np.uint8).reshape(n, -1)
        frames = CanFrames(
            np.full(n, LINE_ID, np.uint32), np.full(n, 8 * values.shape[1], np.uint8), payload, np.zeros(n, np.int64)
        )
        return Packets(frames=frames, holes=np.array([*holes, 0], np.int64))


def _tokens(data: NDArray[np.uint8], stops: NDArray[np.intp]) -> NDArray[np.int64]:
    """(lines,) number of words of each line."""
    black = (data != 32) & (data != 10)
    begins = black & ~np.concatenate([[False], black[:-1]])
    return np.diff(np.concatenate([[0], np.cumsum(begins)[stops]]))


def _values(text: bytes, good: NDArray[np.bool_], columns: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(good lines, columns) numbers, and whether each line could be read."""
    lines = text[:-1].split(b"\n") if not good.all() else []
    taken = b" ".join(lines[k] for k in np.flatnonzero(good)) if lines else text
    shape = (int(good.sum()), max(columns, 1))
    try:
        return np.array(taken.split(), np.bytes_).astype(np.float64).reshape(shape), np.ones(shape[0], np.bool_)
    except ValueError:  # "1.2.3", "+-4": line by line
        out, read = np.zeros(shape), np.zeros(shape[0], np.bool_)
        every = text[:-1].split(b"\n")
        for row, k in enumerate(np.flatnonzero(good).tolist()):
            try:
                out[row] = [float(word) for word in every[k].split()]
                read[row] = True
            except ValueError:
                continue
        return out, read
