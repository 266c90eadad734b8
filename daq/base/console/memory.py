"""Memory: a bound on what reading a foreign file may take, as a few bytes can claim, or unpack to, any size; and what
becomes of arrays that are let go."""

from __future__ import annotations

import ctypes
import mmap
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_FREE_SHARE = 0.5  # of the memory that is free
LEAST_BYTES, FILE_SIZE_FACTOR = 1 << 30, 100  # enough for any sound file: a gigabyte, and a hundred times its size
FILE_FROM_BYTES = 1 << 27  # 150 s of four channels at 25.6 kHz: of shorter records a file costs more than it saves
UNKNOWN_BYTES = 4 << 30  # free memory where the system does not say
# of mallopt in glibc, and what is asked: one heap for all threads, which keeps what it has, of arrays up to 32 MiB:
# larger ones are whole channels of a long record, and would leave holes
ARENA_MAX, TRIM_THRESHOLD, MMAP_THRESHOLD = (-8, 1), (-1, 1 << 30), (-3, 32 << 20)


@contextmanager
def bounded_memory(file_bytes: int) -> Iterator[int]:
    """Within it, allocating more than a file of this size deserves raises MemoryError (on Linux). Yields the bound.

    It is 1 GB and a hundred times the file's size, but never more than half of the free memory.

    The bound is the whole process's: for commands that do one thing, not for a live session.
    """
    bound = min(int(MAX_FREE_SHARE * _free_bytes()), LEAST_BYTES + FILE_SIZE_FACTOR * file_bytes)
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (ImportError, OSError):
        yield bound
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    wanted = pages * resource.getpagesize() + bound
    for limit in (soft, hard):
        wanted = wanted if limit == resource.RLIM_INFINITY else min(wanted, limit)
    resource.setrlimit(resource.RLIMIT_AS, (wanted, hard))
    try:
        yield bound
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def roomy(shape: tuple[int, ...], dtype: type[np.floating[Any]]) -> NDArray[Any]:
    """A new array whose values are not set. A large one lies in a file without a name, so that a process that has read
    it need not keep it (estimator.arrays.return_freed_memory); in memory where the disk has no room.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if size > FILE_FROM_BYTES:
        with suppress(AttributeError, OSError), tempfile.TemporaryFile() as file:
            os.posix_fallocate(file.fileno(), 0, size)
            return np.ndarray(shape, dtype, mmap.mmap(file.fileno(), size))
    return np.empty(shape, dtype)


def keep_freed() -> None:
    """Let new arrays reuse freed memory (on Linux). Memory that is new costs more than what is computed in it:
    compare takes 0.9 of the time, and no more memory, as its threads share one heap; so do those of a session."""
    with suppress(AttributeError, OSError):
        libc = ctypes.CDLL(None)
        for option, value in (ARENA_MAX, TRIM_THRESHOLD, MMAP_THRESHOLD):
            libc.mallopt(option, value)


def _free_bytes() -> int:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return UNKNOWN_BYTES
