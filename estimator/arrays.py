"""Array types that every room shares."""

from __future__ import annotations

import ctypes
import mmap
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

ELEMENTS_PER_PRODUCT = 1 << 13  # of a matrix product that one thread makes
LONG_RECORD_BYTES = 1 << 27  # 150 s of four channels at 25.6 kHz: of shorter ones new memory costs more than it saves

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Series = NDArray[np.floating[Any]]  # a time series in double or single precision


def real_samples(y: Any) -> Array:
    """An array in double precision, or in single precision if it comes so: a long record is not copied."""
    z: Array = np.asarray(y)
    return z if z.dtype in (np.float32, np.float64) else z.astype(np.float64)


def return_freed_memory(y: Array) -> None:
    """Return memory that earlier steps have freed to the system (glibc only), where a record is long.

    What is left of a heap between arrays of different sizes is otherwise half as much again as what is in use. Of a
    record that lies in a mapped file, what was read is let go too: it is read anew where it is used.
    """
    if y.nbytes > LONG_RECORD_BYTES:
        with suppress(AttributeError, OSError):
            ctypes.CDLL(None).malloc_trim(0)
    under: Any = y
    while isinstance(under, np.ndarray):
        under = under.base
    if isinstance(under, mmap.mmap):
        under.madvise(mmap.MADV_DONTNEED)


def true_runs(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(runs, 2) first row, and row after the last row, of each run of true rows of a mask (n,)."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2)


def products(J: Array) -> Array:
    """(k, k) inner products of the rows of J (k, n), part by part: threads would cost more time than the sums."""
    parts = np.array_split(J, max(J.size // ELEMENTS_PER_PRODUCT, 1), axis=1)
    return np.asarray(sum(part @ part.T for part in parts), np.float64)
