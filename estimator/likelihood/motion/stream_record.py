"""A record made ready for the spectral likelihood, and the columns of a balance evaluated along it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.model.rig import Model
from estimator.parallel import map_threads
from estimator.signals.band_limit import BandLimitedMotion
from estimator.signals.blocks import (
    BlockLayout,
    block_spectra,
    gram_by_cell,
    valid_blocks,
)

from .denoise import DenoisingFilter
from .force_balance import Balance, force_channels, shaft_notch
from .law_columns import Columns, Stretch
from .law_smoothing import MARGIN_ROWS

MAX_GROUP_BLOCKS = 24  # blocks whose spectra are made at a time
CELLS_WITH_FORCE = 300  # what is left is sensor noise seen through A, which varies within a resonance
MAX_HELD_BINS = 4e7  # complex bins held at a time, about


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Band-limited motion of a model's channels. motion : rows of the motion channels, in the order of the places.

    force : row -> (n,) measured force. phase : (n,) rad, shaft angle; grid : the blocks and bins used.
    """

    model: Model
    rate_hz: float
    motion: BandLimitedMotion
    force: dict[int, Array]
    phase: Array
    grid: BlockLayout
    lines: tuple[tuple[float, float], ...] = ()  # Hz, stretches left out of the grid (line_notches.py)
    calm: DenoisingFilter | None = None  # what laws see of the displacement where sensors are noisy
    _rms: dict[str, Array] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def seconds(self) -> float:
        """Length of what is valid."""
        return float(self.motion.valid.sum() / self.rate_hz)

    def rms(self, name: str) -> Array:
        """(places,) rms of a, v or x."""
        if name not in self._rms:
            valid, z = self.motion.valid, getattr(self.motion, name)
            self._rms[name] = np.sqrt(np.array([np.dot(row * valid, row) for row in z]) / valid.sum())
        return self._rms[name].copy()

    @property
    def driven(self) -> Array:
        """(places,) one-sided PSD of the measured forces, N^2/Hz, over the band; 0 where none is measured."""
        out = np.zeros(len(self.model.places))
        for row, force in self.force.items():
            out[row] = np.mean(force[self.motion.valid] ** 2) / (self.model.band[1] - self.model.band[0])
        return out

    @property
    def scales(self) -> Array:
        """(places, 2) rms of x and v."""
        return np.stack([self.rms("x"), self.rms("v")], axis=1)

    def columns(self, balance: Balance, widths: Array, linear: Array | None = None, fine: int | None = None) -> Columns:
        """What evaluates the columns of a balance along the record: columns.Columns."""
        folding_hz = self.rate_hz - self.model.band[1]
        return Columns(balance=balance, rms=self.scales, widths=widths, linear=linear, fine=fine, folding_hz=folding_hz)

    def stretch(self, start: int, stop: int) -> Stretch:
        """Rows start ... stop - 1 and the margins that their evaluation needs, zeros beyond the record."""
        if self.calm is not None:
            more = self.calm.reach
            wide = replace(self, calm=None).stretch(start - more, stop + more)
            calm = self.calm.of(np.where(wide.valid, wide.x, 0.0), self.rate_hz)
            return replace(wide, calm=calm).part(more, more + stop - start)
        m, n = self.motion, self.motion.rows
        lo, hi = max(start - MARGIN_ROWS, 0), min(stop + MARGIN_ROWS, n)
        pad = (lo - start + MARGIN_ROWS, stop + MARGIN_ROWS - hi)

        def padded(z: Array) -> Array:
            return np.pad(z, [(0, 0)] * (z.ndim - 1) + [pad]) if any(pad) else z

        t = (m.start + np.arange(start - MARGIN_ROWS, stop + MARGIN_ROWS)) / self.rate_hz
        valid = np.pad(m.valid[lo:hi], pad)
        force = {i: padded(f[lo:hi]) for i, f in self.force.items()}
        phase = np.pad(self.phase[lo:hi], pad, mode="edge") if any(pad) else self.phase[lo:hi]
        a, v, x, u = (padded(z[:, lo:hi]) for z in (m.a, m.v, m.x, m.u))
        measured = None if m.slow is None else padded(m.slow[:, lo:hi])
        return Stretch(
            a=a, v=v, x=x, u=u, valid=valid, force=force, t=t, phase=phase, rate_hz=self.rate_hz, slow=measured
        )


def notches(model: Model) -> tuple[tuple[float, float], ...]:
    """Stretches of frequency, in Hz, that no fit of this model uses."""
    shaft = shaft_notch(model)
    return () if shaft is None else (shaft,)


def as_record(model: Model, rate_hz: float, parts: list[BandLimitedMotion], grid: BlockLayout) -> Record:
    """Consecutive pieces of a stream, motion channels first, as a record that begins at the first piece's row."""
    P = len(model.places)
    a, v, x, u = (np.concatenate([getattr(p, name) for p in parts], axis=1) for name in "avxu")
    valid = np.concatenate([p.valid for p in parts])
    slow = [p.slow[:P] for p in parts if p.slow is not None]
    below = np.concatenate(slow, axis=1) if slow else None
    motion = BandLimitedMotion(start=parts[0].start, a=a[:P], v=v[:P], x=x[:P], u=u[:P], valid=valid, slow=below)
    turns_per_s = (model.speed_rpm or 0.0) / 60.0
    rows = np.arange(motion.start, motion.start + motion.rows)
    phase = np.asarray(2 * np.pi * turns_per_s / rate_hz * rows, dtype=np.float64)
    force = {row: a[P + i] for i, row in enumerate(force_channels(model))}
    return Record(model=model, rate_hz=rate_hz, motion=motion, force=force, phase=phase, grid=grid)


def stretches(blocks: NDArray[np.intp], most: int) -> Iterator[NDArray[np.intp]]:
    """Valid blocks in groups of neighbours, at most `most` each."""
    for run in np.split(blocks, np.flatnonzero(np.diff(blocks) > 1) + 1):
        for i in range(0, run.size, most):
            yield run[i : i + most]


def gather(record: Record, balance: Balance, widths: Array, linear: Array | None = None) -> tuple[Array, float, Array]:
    """Gram matrices (cells, k, k) summed over the blocks of a record, number of blocks, and mean tangents (k, 4)."""
    grid, k = record.grid, len(balance.columns)
    columns = record.columns(balance, widths, linear)
    most = max(1, min(MAX_GROUP_BLOCKS, int(MAX_HELD_BINS / (k * grid.size))))

    def part(group: NDArray[np.intp]) -> tuple[Array, int, Array, int]:
        """Gram matrix, number of blocks, sums of tangents and the rows they are over."""
        first, last = int(group[0]) * grid.hop, int(group[-1]) * grid.hop + grid.size
        z, sums = columns.along(record.stretch(first, last), grid.hop)
        G = gram_by_cell(block_spectra(z, group - group[0], grid), grid)
        return G, group.size, sums.sum(axis=0), last - first

    grams, counts, sums, rows = zip(
        *map_threads(part, stretches(valid_blocks(record.motion.valid, grid), most)), strict=True
    )
    return np.sum(grams, axis=0), float(sum(counts)), np.sum(sums, axis=0) / sum(rows)
