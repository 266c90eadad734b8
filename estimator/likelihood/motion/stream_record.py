"""A record made ready for the spectral likelihood, and the columns of a balance evaluated along it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.model.rig import Model
from estimator.parallel import map_threads
from estimator.signals.band_limit import BandLimitedMotion
from estimator.signals.band_limited_record import BandLimitedRecord
from estimator.signals.blocks import (
    FREQUENCY_CELLS,
    BlockLayout,
    block_layout,
    block_spectra,
    gram_by_cell,
    valid_blocks,
)
from estimator.signals.channel_response import anti_alias_response

from .denoise import DenoisingFilter
from .force_balance import Balance, force_channels, motion_channels, shaft_notch, shaft_reaction
from .law_columns import Columns, Stretch
from .law_smoothing import MARGIN_ROWS

BLOCKS_PER_FOLD = 3
CELLS_WITH_FORCE = 300  # what is left is sensor noise seen through A, which varies within a resonance
_HELD_BINS = 4e7  # complex bins held at a time, about


@dataclass(frozen=True, slots=True)
class Record:
    """Band-limited motion of a model's channels. motion : rows of the motion channels, in the order of the places.

    force : row -> (n,) measured force. phase : (n,) rad, shaft angle; grid : the blocks and bins used.
    """

    model: Model
    rate_hz: float
    motion: BandLimitedMotion | BandLimitedRecord
    force: dict[int, Array]
    phase: Array
    grid: BlockLayout
    lines: tuple[tuple[float, float], ...] = ()  # Hz, stretches left out of the grid (line_notches.py)
    slow: Array | None = None  # (places, n) displacement below the band that laws see instead of what sensors measure
    calm: DenoisingFilter | None = None  # what laws see of the displacement where sensors are noisy
    weights: Array | None = None  # (blocks, bins) what each bin of each block counts for (moving_lines.py); None: 1
    _rms: dict[str, Array] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def seconds(self) -> float:
        """Length of what is valid."""
        return float(self.motion.valid.sum() / self.rate_hz)

    def rms(self, name: str) -> Array:
        """(places,) rms of a, v or x."""
        if isinstance(self.motion, BandLimitedRecord):
            return np.asarray(self.motion.rms["avx".index(name)])
        if name not in self._rms:
            valid, z = self.motion.valid, getattr(self.motion, name)
            self._rms[name] = np.sqrt(np.array([np.dot(row * valid, row) for row in z]) / valid.sum())
        return self._rms[name].copy()

    @property
    def counted(self) -> Array:
        """(cells,) what a bin of each cell counts for in the mean, 1 where no line moves."""
        grid = self.grid
        if self.weights is None:
            return np.ones(grid.starts.size)
        mean = self.weights[valid_blocks(self.motion.valid, grid)].mean(axis=0)
        return np.maximum(grid.mean_by_cell(mean), 1e-3)

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
        if isinstance(m, BandLimitedRecord):
            cut = m.motion(lo, [*padded(m.cut(lo, hi))], valid)
            a, v, x, u, measured = cut.a, cut.v, cut.x, cut.u, cut.slow
        else:
            a, v, x, u = (padded(z[:, lo:hi]) for z in (m.a, m.v, m.x, m.u))
            measured = None if m.slow is None else padded(m.slow[:, lo:hi])
        slow = measured if self.slow is None else padded(self.slow[:, lo:hi])
        return Stretch(a=a, v=v, x=x, u=u, valid=valid, force=force, t=t, phase=phase, rate_hz=self.rate_hz, slow=slow)


def notches(model: Model) -> tuple[tuple[float, float], ...]:
    """Stretches of frequency, in Hz, that no fit of this model uses."""
    shaft = shaft_notch(model)
    return () if shaft is None else (shaft,)


def prepare(model: Model, y: Array, rate_hz: float, phase: Array | None = None) -> Record:
    """The record of (n, channels) rows in SI, NaN where a sample is missing.

    phase : (n,) rad, shaft angle where it was measured; otherwise from the model's speed. Raises DataError.
    """
    motions, forces = motion_channels(model), force_channels(model)
    used = [*motions, *forces.values()]
    kinds = [model.channels[c].kind for c in used]
    P, force = len(motions), {}
    motion: BandLimitedMotion | BandLimitedRecord
    filtered = BandLimitedRecord(
        y=y if used == [*range(y.shape[1])] else y[:, used], kinds=kinds, rate_hz=rate_hz, band=model.band,
        extra=shaft_reaction(model), slow=True, undone=anti_alias_response(model, rate_hz),
    )  # fmt: skip
    if filtered.large and not forces:
        motion = filtered
    else:
        both = filtered.whole()
        slow = None if both.slow is None else both.slow[:P]
        motion = BandLimitedMotion(
            start=0, a=both.a[:P], v=both.v[:P], x=both.x[:P], u=both.u[:P], valid=both.valid, slow=slow
        )
        force = {row: both.a[P + i] for i, row in enumerate(forces)}
    if phase is None:
        turns_per_s = (model.speed_rpm or 0.0) / 60.0
        phase = np.asarray(2 * np.pi * turns_per_s / rate_hz * np.arange(motion.rows), dtype=np.float64)
    grid = block_layout(rate_hz, model.band, notches(model), FREQUENCY_CELLS if not forces else CELLS_WITH_FORCE)
    if (whole := valid_blocks(motion.valid, grid).size) < 8:
        raise DataError(_too_little(model, grid, motion, whole))
    return Record(
        model=model, rate_hz=rate_hz, motion=motion, force=force, phase=np.asarray(phase, np.float64), grid=grid
    )


def _too_little(model: Model, grid: BlockLayout, motion: BandLimitedMotion | BandLimitedRecord, whole: int) -> str:
    """What is wrong with a record that has so few whole blocks: it is short, or in pieces."""
    length, low = grid.size / grid.rate_hz, f"band.low {model.band[0]:g} Hz"
    seconds = float(motion.valid.sum()) / grid.rate_hz
    if motion.rows < 6 * grid.size:
        return (
            f"the record has {seconds:.2f} s of valid samples, at least {6 * length:.1f} s are needed for {low}: "
            "record longer"
        )
    return (
        f"the record has {seconds:.2f} s of valid samples, but only {whole} stretches of {length:.2g} s without a "
        f"missing or clipped one; 8 are needed for {low}: see what the gaps come from, or record longer"
    )


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


@dataclass(frozen=True, slots=True)
class Bank:
    """Gram matrices by fold of time: what every sub-model, test and residual spectrum is computed from.

    grams : (folds, cells, k, k); blocks : (folds,); start : (folds,) s, where each begins. tangents : (k, 4) mean of
    the record; fold_tangents : (folds, k, 4) of each. level : (places, folds) of an unknown force that is not even.
    """

    balance: Balance
    grid: BlockLayout
    grams: Array
    blocks: Array
    start: Array
    tangents: Array
    fold_tangents: Array
    level: Array | None = None
    rest: Array | None = None

    def levelled(self, level: Array | None) -> Bank:
        """With a force of this level, (places, folds): what all places have in common of it is taken out of the folds.
        Of the rest, E[F phi] goes with the tangent and with the level of each fold, so what balances it is the mean of
        their product."""
        if level is None:
            return self
        common = np.exp(np.log(level).mean(axis=0))
        common /= np.average(common, weights=self.blocks)
        rest = level / common
        own = rest[[c.row for c in self.balance.columns]] * self.blocks
        tangents = np.einsum("kf,fkt->kt", own / own.sum(axis=1, keepdims=True), self.fold_tangents)
        return replace(self, grams=self.grams / common[:, None, None, None], tangents=tangents, level=level, rest=rest)

    def restrict(self, laws: set[int]) -> Bank:
        """The bank of the model that has only these laws (indices into balance.laws)."""
        from .force_balance import restrict

        balance, keep = restrict(self.balance, laws)
        grams, tangents = self.grams[:, :, keep][:, :, :, keep], self.fold_tangents[:, keep]
        return Bank(
            balance=balance, grid=self.grid, grams=grams, blocks=self.blocks, start=self.start,
            tangents=self.tangents[keep], fold_tangents=tangents, level=self.level, rest=self.rest,
        )  # fmt: skip


def stretches(blocks: NDArray[np.intp], most: int) -> Iterator[NDArray[np.intp]]:
    """Valid blocks in groups of neighbours, at most `most` each."""
    for run in np.split(blocks, np.flatnonzero(np.diff(blocks) > 1) + 1):
        for i in range(0, run.size, most):
            yield run[i : i + most]


def gather(
    record: Record,
    balance: Balance,
    widths: Array,
    linear: Array | None = None,
    per_fold: int = BLOCKS_PER_FOLD,
    seconds: float = np.inf,
    fine: int | None = None,
) -> Bank:
    """The bank of a record, or of its first seconds. per_fold : blocks in a fold of time."""
    grid, k = record.grid, len(balance.columns)
    columns = record.columns(balance, widths, linear, fine)
    if record.force:
        per_fold *= 4
    most = max(1, min(8, int(_HELD_BINS / (k * grid.size) / per_fold))) * per_fold
    usable = valid_blocks(record.motion.valid, grid)
    usable = usable[: max(8, int(min(usable.size, seconds * record.rate_hz / grid.hop)))]

    def part(group: NDArray[np.intp]) -> tuple[list[tuple[Array, int, float, Array]], Array, int]:
        """Gram matrix, number of blocks, start and tangents of each fold; sums of tangents, the rows they are over."""
        first, last = int(group[0]) * grid.hop, int(group[-1]) * grid.hop + grid.size
        z, sums = columns.along(record.stretch(first, last), grid.hop)
        folds = []
        for i in range(0, group.size, per_fold):
            f = group[i : i + per_fold]
            own = sums[i : i + f.size + 1]  # the window halves the weight of the first and of the last
            mean = (own.sum(axis=0) - 0.5 * (own[0] + own[-1])) / (f.size * grid.hop)
            Z = block_spectra(z, f - group[0], grid)
            if record.weights is not None:
                Z = Z * np.sqrt(record.weights[f])
            G = gram_by_cell(Z, grid)
            folds.append((G, f.size, f[0] * grid.hop / record.rate_hz, mean))
        return folds, sums.sum(axis=0), last - first

    parts = map_threads(part, stretches(usable, most))
    grams, counts, starts, means = zip(*(fold for folds, _, _ in parts for fold in folds), strict=True)
    tangents = np.sum([sums for _, sums, _ in parts], axis=0) / sum(rows for _, _, rows in parts)
    blocks = np.array(counts, float)
    return Bank(
        balance=balance,
        grid=grid,
        grams=np.array(grams),
        blocks=blocks,
        start=np.array(starts),
        tangents=tangents,
        fold_tangents=np.array(means),
    )
