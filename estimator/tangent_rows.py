"""Tangents of forces times a matrix, bin by bin: a force at one place is one row of places, and the rest is zero."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .arrays import Complexes


def times(tangents: Complexes, factor: Complexes) -> Complexes:
    """(terms, places, places, bins) of tangents and a factor (bins, places, places), each of some of the places."""
    term, row, made = rows_times(tangents, factor)
    out = np.zeros((*tangents.shape[:2], *made.shape[1:]), complex)
    out[term, row] = made
    return out


def rows_times(tangents: Complexes, factor: Complexes) -> tuple[NDArray[np.int64], NDArray[np.int64], Complexes]:
    """The same as the rows that are not zero: of which term and place, (rows,), and these, (rows, places, bins)."""
    term, row = np.nonzero(tangents.any(axis=(2, 3)))
    by_bin = np.ascontiguousarray(np.moveaxis(factor, 0, -1))
    out = np.zeros((term.size, *by_bin.shape[1:]), complex)
    for k, i, made in zip(term, row, out, strict=True):
        for one, own in zip(tangents[k, i], by_bin, strict=True):
            made += one * own
    return term, row, out
