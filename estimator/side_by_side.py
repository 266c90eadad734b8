"""Work on two cores at once where the arrays are large: numpy, scipy.fft and numba let go of the interpreter."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

CORES = 2
T = TypeVar("T")
R = TypeVar("R")
Q = TypeVar("Q")


def each(function: Callable[[T], R], items: Iterable[T], done: Callable[[int], None] | None = None) -> list[R]:
    """function of every item, in order, two at a time; `done` hears in this thread how many there are so far.

    The first exception is raised.
    """
    out: list[R] = []
    with ThreadPoolExecutor(CORES) as pool:
        for result in pool.map(function, items):
            out.append(result)
            if done is not None:
                done(len(out))
    return out


def both(first: Callable[[], R], second: Callable[[], Q]) -> tuple[R, Q]:
    """Two results at once. An exception of either is raised."""
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(second)
        return first(), running.result()
