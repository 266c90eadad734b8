"""A mass run asks libraries the same thing over and over: what one made of a header or a line is not worked out again.

Only of functions of what they are given and nothing else. What they said of it, or raised, they say again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO

from pyuff.datasets import dataset_58

try:
    import numpy.lib._format_impl as npy
except ImportError:  # numpy before 2.3
    import numpy.lib.format as npy  # type: ignore[no-redef]

MOST = 20_000  # answers kept; then all are forgotten
Answer = tuple[Any, tuple[type[Exception], tuple[Any, ...]] | None]


@contextmanager
def remembering() -> Iterator[None]:
    """numpy's reading of an array's header, pyuff's of a line of a data set."""
    header, long, line = npy._read_array_header, npy._filter_header, dataset_58._parse_header_line
    npy._read_array_header, npy._filter_header = _headers(header), _without_long(long)
    dataset_58._parse_header_line = _lines(line)
    try:
        yield
    finally:
        npy._read_array_header, npy._filter_header, dataset_58._parse_header_line = header, long, line


def _answer(known: dict[Any, Answer], key: Any, ask: Callable[[], Any]) -> Any:
    if key not in known:
        if len(known) >= MOST:
            known.clear()
        try:
            known[key] = ask(), None
        except MemoryError:  # of today's memory
            raise
        except Exception as error:  # noqa: BLE001 - raised below
            known[key] = None, (type(error), error.args)  # itself would keep what it was raised over
    value, error = known[key]
    if error is not None:
        raise error[0](*error[1])
    return value


def _headers(read: Callable[..., Any]) -> Callable[..., Any]:
    known: dict[Any, Answer] = {}

    def again(stream: BinaryIO, version: tuple[int, int], max_header_size: int = npy._MAX_HEADER_SIZE) -> Any:
        at = stream.tell()
        size = 2 if version == (1, 0) else 4
        head = stream.read(size)
        head += stream.read(int.from_bytes(head, "little"))
        stop = stream.tell()
        stream.seek(at)

        def ask() -> Any:
            return read(stream, version, max_header_size)

        answer = _answer(known, (version, max_header_size, head), ask)
        stream.seek(stop)
        return answer

    return again


def _without_long(filtered: Callable[[str], str]) -> Callable[[str], str]:
    """A header that is no Python is tried again without the L of Python 2's numbers, from what a tokenizer made of it:
    half of the time of a run, though one line that has no L is refused all the same."""

    def again(header: str) -> str:
        return filtered(header) if set("L\\").intersection(header) or len(header.splitlines()) > 1 else header

    return again


def _lines(parse: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
    known: dict[Any, Answer] = {}

    def again(line: str, least: int, widths: list[int], types: list[int], names: list[str]) -> dict[str, Any]:
        def ask() -> dict[str, Any]:
            return parse(line, least, widths, types, names)

        return _answer(known, (line, least, *names), ask)  # whoever asks copies it

    return again
