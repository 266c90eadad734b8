"""Structural modes and the spectrum of the force, sought while samples arrive where the residual force is not white.

A support and a part on the cap look alike, and kL depends on which it is. Where a record does not tell, chance decides:
then the fits of its parts differ. They are made as the parts come, one at a time, as each takes seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError, NotFiniteError
from estimator.identification.batch.grid_start import fit_record
from estimator.identification.structure.background_search import find_background
from estimator.likelihood.motion.prepare import motion_record
from estimator.model.background import Background
from estimator.model.rig import Model
from estimator.signals.channel_response import corrected_record

from .anchor import anchor_at
from .follower import Follower
from .report import is_coloured
from .start import FirstFit, first_fit

RECORD_S = 24.0  # of samples, in which a background is found
BACKGROUND_PARTS = 4  # of them: each shows the background alone
MAX_ROWS = 1 << 20  # of memory for them: 32 MB with four channels
MAX_PARTS_APART_REL = 0.07  # of kL: a mode of the wrong form moves it by 10 to 25 %, chance by 1 to 3 %
PAUSE_REL = 2  # all samples so far times this, until the next search


Run = Callable[[Callable[[], FirstFit | None]], Callable[[], FirstFit | None]]


def in_line(search: Callable[[], FirstFit | None]) -> Callable[[], FirstFit | None]:
    """Run a search at once; the function that is returned gives its result."""
    found = search()
    return lambda: found


class BackgroundSearch:
    """When to look for a background, and what has been found. rows : that it needs; 0 where they would be too many.

    run : how a search is run. Its result is asked for at a fixed row later, however long it takes.
    """

    def __init__(self, rate_hz: float, block: int, least_blocks: int, run: Run) -> None:
        rows = min(max(int(RECORD_S * rate_hz), BACKGROUND_PARTS * least_blocks * block), MAX_ROWS) // block * block
        self.rows = rows if rows >= BACKGROUND_PARTS * least_blocks * block else 0
        self._part, self._next, self._run = rows // BACKGROUND_PARTS, rows // BACKGROUND_PARTS, run
        self._stiffness: list[Array] = []  # (places,) N/m each, of the parts that show a background
        self._search: Callable[[], FirstFit | None] | None = None  # that has begun

    def is_due(self, seen: int, coloured: Callable[[], bool]) -> bool:
        """Whether to go on after so many rows. coloured : whether the residual force is not white."""
        return self.rows > 0 and seen >= self._next and (self._search is not None or coloured())

    def step(
        self, seen: int, known: Background | None, model: Model, lines: Model, blocks: Sequence[Array], rate_hz: float
    ) -> FirstFit | None:  # fmt: skip
        """Begin a search, or end one: a fit with another background than the known one, once it is sure.

        seen : rows so far. model, lines, rate_hz : as of `first_fit`. blocks : the last rows (n, channels) each, SI.
        """
        whole = len(self._stiffness) == BACKGROUND_PARTS
        if self._search is None:
            y, rows = np.concatenate(blocks), self.rows if whole else self._part
            self._search = self._run(partial(_fit_with_background, model, lines, y[-rows:], rate_hz, len(blocks[0])))
            self._next = seen + self._part // 2
            return None
        found, self._search = self._search(), None
        kL: list[Array] = [] if found is None else [*self._stiffness, found.point.kL]
        agree = found is not None and bool(np.all(np.ptp(kL, axis=0) < MAX_PARTS_APART_REL * kL[0]))
        if agree and not whole:
            self._stiffness, self._next = kL, seen + (self._part // 2 if len(kL) < BACKGROUND_PARTS else 0)
            return None
        self._stiffness, self._next = [], PAUSE_REL * seen
        if found is None or not agree or found.point.data.background is None or not _is_explained(found):
            return None
        return None if found.point.data.background.agrees_with(known) else found


def _fit_with_background(model: Model, lines: Model, y: Array, rate_hz: float, block: int) -> FirstFit | None:
    """The fit with the structural modes and the spectrum of the force that a record shows; None where there are none.

    Arguments as of `first_fit`.
    """
    try:
        first = first_fit(model, lines, y, rate_hz, block)
        if (background := find_background(first.model, first.point)) is None:
            return None
        own = replace(first.model, background=background)
        point = fit_record(own, motion_record(own, corrected_record(own, y, rate_hz), rate_hz, block))
    except (DataError, NotFiniteError, np.linalg.LinAlgError):
        return None
    return replace(first, model=own, point=point)


def _is_explained(first: FirstFit) -> bool:
    """Whether the spectra of the residual forces of a fit are those of its model."""
    point, data = first.point, replace(first.point.data, level=None)
    follower = Follower(anchor_at(data, point.kL, point.c, point.nu, point.S, point.placed), np.inf)
    follower.take(data, False)
    follower.solve()
    return not is_coloured(follower)
