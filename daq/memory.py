"""A bound on the memory that reading a foreign file may take: a few bytes can claim, or unpack to, any size."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SHARE = 0.5  # of the memory that is free
LEAST_BYTES, FACTOR = 1 << 30, 100  # enough for any sound file: a gigabyte, and a hundred times its size
UNKNOWN_BYTES = 4 << 30  # free memory where the system does not say


@contextmanager
def bounded_memory(file_bytes: int) -> Iterator[int]:
    """Within it, allocating more than a file of this size deserves raises MemoryError (on Linux). Yields the bound.

    It is 1 GB and a hundred times the file's size, but never more than half of the free memory.

    The bound is the whole process's: for commands that do one thing, not for a live session.
    """
    bound = min(int(SHARE * _free_bytes()), LEAST_BYTES + FACTOR * file_bytes)
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


def _free_bytes() -> int:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return UNKNOWN_BYTES
