"""The anti-alias roll-off of the recorder in a rolling fit, as a spectral shape of the excitation."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from estimator.arrays import Array
from estimator.identification.batch.linear_start import LinearStart
from estimator.likelihood.motion.stream_record import Record
from estimator.likelihood.path.gram_likelihood import Local
from estimator.model.recorder import POWERS, gain, suspected


class RollingRollOff:
    """colour : (nodes, places) shape of S that the model gives, times the roll-off once one is seen; None: flat."""

    def __init__(self, record: Record, start: LinearStart, colour: Array | None) -> None:
        self.colour = self._own = colour
        grid, top_hz, self._forced = record.grid, record.model.band[1], bool(record.force)
        self._top, self._nodes, self._per_cell = top_hz, start.nodes.f_hz, grid.per_cell
        self._highest = float(np.sqrt(start.kL / start.m).max() / (2 * np.pi))
        self._hz = grid.mean_by_cell(grid.f_hz)
        self._basis = grid.mean_by_cell((grid.f_hz[:, None] / top_hz) ** POWERS)
        self._found: tuple[float, ...] = ()

    def follow(self, local: Local, blocks: float) -> bool:
        """Renew it from what is left of the fall at a point; whether there is one. blocks : how many it is of."""
        ratio, count = local.power / local.spread, blocks * self._per_cell.astype(np.float64)
        if self._forced or not (self._found or suspected(ratio, self._hz, count, self._highest)):
            return False
        fall = -np.log(ratio).mean(axis=1)
        if self._found:
            fall += self._basis @ np.array(self._found)
        free = self._basis - np.average(self._basis, axis=0, weights=count)
        root = np.sqrt(count)
        found, _ = nnls(root[:, None] * free, root * (fall - np.average(fall, weights=count)))
        self._found = tuple(found.tolist())
        common = np.repeat(gain(self._found, self._nodes, self._top)[:, None], ratio.shape[1], axis=1)
        self.colour = common if self._own is None else common * self._own
        return True
