"""The shaft angle of a stream: from a tacho channel as it arrives, or from the speed that the rig file gives."""

from __future__ import annotations

import numpy as np

from .arrays import Array
from .errors import DataError
from .model import Model
from .shaft_angle import shaft_angle


class ShaftAngle:
    """`push` the rows as they come, `drop` those no longer needed, ask for the `angle` along rows that are held."""

    def __init__(self, model: Model, rate_hz: float) -> None:
        self._column = model.tacho
        self._rate_hz = rate_hz
        self._given = 2.0 * np.pi * (model.speed_rpm or 0.0) / 60.0 / rate_hz  # rad a row
        self._first = 0
        self._pulses: list[Array] = []
        self._known = (0, 0.0)  # a row and its angle: the next window goes on from there

    @property
    def measured(self) -> bool:
        """Whether there is a tacho channel."""
        return self._column is not None

    def push(self, block: Array) -> None:
        """The next rows (n, channels of the model), NaN where missing."""
        if self._column is not None:
            self._pulses.append(block[:, self._column].copy())

    def drop(self, before: int) -> None:
        """Rows under `before` are not asked for any more."""
        while self._pulses and self._first + len(self._pulses[0]) <= before:
            self._first += len(self._pulses.pop(0))

    def angle(self, start: int, stop: int) -> Array | None:
        """(stop - start,) rad along rows that were pushed and not dropped; None while the tacho tells no speed."""
        if self._column is None:
            return np.asarray(self._given * np.arange(start, stop), dtype=np.float64)
        pulses = np.concatenate(self._pulses) if self._pulses else np.empty(0)
        try:
            angle = shaft_angle(pulses, self._rate_hz)
        except DataError:
            return None
        row, known = self._known
        if self._first <= row < self._first + angle.size:  # turns are counted through from window to window
            angle += 2.0 * np.pi * np.rint((known - angle[row - self._first]) / (2.0 * np.pi))
        out = angle[start - self._first : stop - self._first]
        self._known = (stop - 1, float(out[-1]))
        return out
