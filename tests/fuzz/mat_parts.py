"""Variables of a .mat: scipy's own reading of each, without what opening a file costs.

Up to what the process that reads them would answer; what may come of an answer is another target's (`answer-members`).
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any

from mat_variables import COLUMN, FORMATS, PLACES, TIME
from scipy.io.matlab import MatReadError
from scipy.io.matlab._mio4 import MatFile4Reader

from daq.exchange.child import Found, of_mat


def variables(pieces: Sequence[bytes]) -> Callable[[int], Found]:
    """scipy's readers of a file of all of them, sent to where one begins; as loadmat(squeeze_me=True) goes on there."""
    stream = io.BytesIO(b"".join(piece[1:] for piece in pieces))
    starts = [0]
    for piece in pieces:
        starts.append(starts[-1] + max(len(piece) - 1, 0))
    readers = [kind(stream, byte_order=order, squeeze_me=True) for kind, order in FORMATS]
    for reader in readers:
        reader.initialize_read()

    def read(k: int) -> Found:
        code = pieces[k][0] if pieces[k] else 0
        place = PLACES[code % 8 % len(PLACES)]

        stream.seek(starts[k])
        name, value = _variable(readers[code // 8 % len(readers)])
        return of_mat({"b1x": COLUMN, "time": TIME, place or name: value}, ("b1x",))

    return read


def _variable(reader: Any) -> tuple[str, Any]:
    header, _ = reader.read_var_header()
    name = "None" if header.name is None else header.name.decode("latin1")
    try:
        return name, reader.read_var_array(header, name != "" or isinstance(reader, MatFile4Reader))
    except MatReadError as error:
        return name, f"Read error: {error}"
