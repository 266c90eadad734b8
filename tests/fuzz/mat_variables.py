"""Variables of .mat files, each with a byte before it that says where it stands in a good file and what reads it."""

from __future__ import annotations

import io

import numpy as np
from scipy.io import savemat
from scipy.io.matlab._mio4 import MatFile4Reader
from scipy.io.matlab._mio5 import MatFile5Reader
from scipy.sparse import csc_matrix

PLACES = ("b1x", "time", "rate_hz", "fs", "")  # "": under the name it has
FORMATS = ((MatFile5Reader, "<"), (MatFile5Reader, ">"), (MatFile4Reader, "<"), (MatFile4Reader, ">"))
COLUMN, TIME = np.arange(6.0), np.arange(6) / 25_600


def small_variables() -> list[bytes]:
    """Of each class, packed and not, small and not; and in the way of version 4."""
    rows, texts, cells = np.arange(12.0).reshape(6, 2), np.array(["a", "bc"]), np.array([COLUMN[:2], "x"], object)
    record = np.array([(1.0, "u")], [("a", object), ("b", object)])
    plain = [COLUMN, COLUMN[:, None], COLUMN.astype("f4"), COLUMN.astype("i2"), COLUMN[:2].astype("i1"), COLUMN > 3]
    odd = [COLUMN + 1j, rows, COLUMN[:0], np.zeros((2, 1, 2)), texts, cells, record, csc_matrix(rows), "text"]
    both = [("b1x", v) for v in plain + odd] + [("time", TIME), ("rate_hz", 25_600.0), ("fs", np.float32(8e3))]
    out = [_piece(place, value, 5) for place, value in [*both, ("", COLUMN)]]
    out += [_piece("b1x", value, 5, packed=True) for value in (COLUMN, cells, record, rows)]
    return out + [_piece(place, value, 4) for place, value in [*both[:3], *both[6:8], *both[-4:]]]


def _piece(place: str, value: object, level: int, packed: bool = False) -> bytes:
    buffer = io.BytesIO()
    savemat(buffer, {place or "q": value}, format=str(level), do_compression=packed)
    code = PLACES.index(place) + 8 * FORMATS.index((MatFile4Reader if level == 4 else MatFile5Reader, "<"))
    return bytes((code,)) + buffer.getvalue()[128 if level == 5 else 0 :]
