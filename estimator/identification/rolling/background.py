"""Structural modes and the spectrum of the force, sought while samples arrive where the residual force is not white.

A support and a part on the cap look alike, and kL depends on which it is. Where a record is vague, chance decides:
then parts of the record differ. The parts are searched one at a time while samples arrive.

A search may take a share of the time of a core. Its cost is counted in samples and derivatives, never by a clock: so a
replay searches what the live session searched. A search that costs more is given up, and the next one is due when twice
as much may be spent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError, NotFiniteError
from estimator.identification.batch.grid_start import fit_record
from estimator.identification.structure.background_search import background_of_spectra, one_cause_is_enough
from estimator.identification.structure.cross_spectra import SearchTooLongError, Work
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.prepare import motion_record
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.signals.channel_response import corrected_record

from .anchor import anchor_at
from .follower import Follower
from .report import is_coloured
from .start import FirstFit, first_record
from .thresholds import LIMITS


@dataclass(slots=True)
class FoundBackground:
    """A background that a search found. stiffness : N/m by place. first : the fit with it; None of a part."""

    stiffness: Mapping[str, float]
    first: FirstFit | None = None


Search = Callable[[], FoundBackground | None]
Run = Callable[[Search], Search]


def in_line(search: Search) -> Search:
    """Run a search at once; the function that is returned gives its result."""
    found = search()
    return lambda: found


class BackgroundSearch:
    """Schedule and results of searches for a background. rows : that a search needs; 0 where these would be too many.

    run : how a search is run. Its result is asked for at a fixed row later, however long it takes.
    """

    def __init__(self, rate_hz: float, channels: int, block: int, run: Run) -> None:
        least = LIMITS.background_parts * LIMITS.start_blocks * block
        rows = min(max(int(LIMITS.record_s * rate_hz), least), LIMITS.max_rows) // block * block
        self.rows = rows if rows >= least else 0
        self._rate_hz, self._channels, self._block, self._run = rate_hz, channels, block, run
        self._next = self._part = rows // LIMITS.background_parts
        self._parts: list[Mapping[str, float]] = []  # stiffness by place, of the parts that show a background
        self._search: Search | None = None  # that is running
        self._work = Work()  # of the search that is running
        self._work_s, self._spent_s = LIMITS.first_work_s, 0.0  # of a core, for the next search, and so far

    @property
    def _whole(self) -> bool:
        """Whether all rows are searched next, as their parts agree."""
        return len(self._parts) == LIMITS.background_parts

    @property
    def _samples_s(self) -> float:
        """Time of a core for the samples of the next search, s."""
        rows, per_s = (self.rows, LIMITS.fitted_samples_per_s) if self._whole else (self._part, LIMITS.samples_per_s)
        return rows * self._channels / per_s

    def _allowed_s(self, seen: int) -> float:
        """Time of a core for the work of the next search beside its samples, s. seen : rows so far."""
        return min(LIMITS.max_core_share * seen / self._rate_hz - self._spent_s - self._samples_s, LIMITS.max_work_s)

    def is_due(self, seen: int, coloured: Callable[[], bool]) -> bool:
        """Whether a step is due. seen : rows so far. coloured : whether the residual force is not white."""
        if self.rows == 0 or seen < self._next:
            return False
        return self._search is not None or (self._allowed_s(seen) >= self._work_s and coloured())

    def step(self, seen: int, first: FirstFit, lines: Model, blocks: Sequence[Array]) -> FirstFit | None:
        """Begin a search, or end one; the fit with a new background once that is certain, else None.

        seen : rows so far. first : the fit so far. lines : as of `first_fit`. blocks : the last rows (n, channels)
        each, SI.
        """
        if self._search is not None:
            return self._end(seen, self._search())
        allowed_s = self._allowed_s(seen)
        self._work = Work(limit=allowed_s * LIMITS.derivatives_per_s)
        y = np.concatenate(blocks)[-(self.rows if self._whole else self._part) :]
        asked = first, self._whole, lines, y, self._rate_hz, self._block, self._work
        self._search = self._run(partial(_searched, *asked))
        self._next = seen + max(
            self._part // 2, int(LIMITS.slow_machine * (allowed_s + self._samples_s) * self._rate_hz)
        )
        return None

    def _end(self, seen: int, found: FoundBackground | None) -> FirstFit | None:
        """End a search; the fit with a new background once that is certain, else None."""
        self._search, work_s = None, min(self._work.done, self._work.limit) / LIMITS.derivatives_per_s
        self._spent_s += self._samples_s + work_s
        self._work_s = 1.5 * work_s
        if self._work.done > self._work.limit:
            self._work_s = 2.0 * work_s
            return None
        whole, self._parts = self._whole, [] if found is None else [*self._parts, found.stiffness]
        if found is not None and not whole and _agree(self._parts):
            self._next = seen + (0 if self._whole else self._part // 2)
            return None
        first = found.first if found is not None and _agree(self._parts) else None
        self._parts, self._next = [], LIMITS.pause_rel * seen
        return first


def _agree(parts: Sequence[Mapping[str, float]]) -> bool:
    """Whether parts of a record show the same stiffness at every place."""
    kL = np.array([[own[place] for place in parts[0]] for own in parts])
    return bool(np.all(np.ptp(kL, axis=0) < LIMITS.max_parts_apart_rel * kL[0]))


def _searched(
    first: FirstFit, whole: bool, lines: Model, y: Array, rate_hz: float, block: int, work: Work
) -> FoundBackground | None:  # fmt: skip
    """The structural modes and the spectrum of the force that some rows show; None without any, or beyond the work.

    first : the fit so far. whole : fit them too; None where the fit explains the spectra no better than one effect of
    the catalogue, or finds what is known. Other arguments as of `first_fit`.
    """
    try:
        model, _, data = first_record(first.model, lines, y, rate_hz, block)
        point = fit_model(data, list(first.point.placed), first.point, rounds=1)
        background, gain_nats = background_of_spectra(model, point, work, thorough=False)
        if background is None:
            return None
        stiffness = dict(zip(data.places, np.einsum("iik->ik", point.mean_tangent)[:, 0].tolist(), strict=True))
        stiffness |= {place: own.stiffness for place, own in background.at.items()}
        if not whole:
            return FoundBackground(stiffness)
        if background.agrees_with(model.background):
            return None
        if model.background is None and one_cause_is_enough(model, point, background, gain_nats):
            return None
        own = replace(model, background=background)
        point = fit_record(own, motion_record(own, corrected_record(own, y, rate_hz), rate_hz, block))
        return FoundBackground(stiffness, replace(first, model=own, point=point)) if _is_explained(point) else None
    except (DataError, NotFiniteError, SearchTooLongError, np.linalg.LinAlgError):
        return None


def _is_explained(point: WorkingPoint) -> bool:
    """Whether the spectra of the residual forces of a fit are those of its model."""
    data = replace(point.data, level=None)
    follower = Follower(anchor_at(data, point.kL, point.c, point.nu, point.S, point.placed), np.inf)
    follower.take(data, False)
    follower.solve()
    return not is_coloured(follower)
