"""A record made ready for the spectral likelihood, and the columns of a balance evaluated along it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .balance import Balance, force_channels, motion_channels, shaft_notch, shaft_response
from .bandlimit import Motion, band_limit
from .errors import DataError
from .features import State, depends, law_force, memory_array
from .gram import Layout, gram, layout, spectra, valid_blocks
from .likelihood import Evidence
from .model import Model

Floats = NDArray[np.float64]
BLOCKS_PER_FOLD = 3
_MEMORY = 4e7  # complex bins held at a time, about


@dataclass(frozen=True, slots=True)
class Record:
    """Band-limited motion of a model's channels. motion : rows of the motion channels, in the order of the places.

    force : row -> (n,) measured force. t : s; phase : rad, shaft angle; grid : the blocks and bins used.
    """

    model: Model
    rate_hz: float
    motion: Motion
    force: dict[int, Floats]
    t: Floats
    phase: Floats
    grid: Layout

    @property
    def seconds(self) -> float:
        """Length of what is valid."""
        return float(self.motion.valid.sum() / self.rate_hz)

    def rms(self, name: str) -> Floats:
        """(places,) rms of a, v or x."""
        z = getattr(self.motion, name)[:, self.motion.valid]
        return np.asarray(np.sqrt(np.mean(z**2, axis=1)))


def notches(model: Model) -> tuple[tuple[float, float], ...]:
    """Stretches of frequency, in Hz, that no fit of this model uses."""
    shaft = shaft_notch(model)
    return () if shaft is None else (shaft,)


def prepare(model: Model, y: Floats, rate_hz: float, phase: Floats | None = None) -> Record:
    """The record of (n, channels) rows in SI, NaN where a sample is missing.

    phase : (n,) rad, shaft angle where it was measured; otherwise from the model's speed. Raises DataError.
    """
    motions, forces = motion_channels(model), force_channels(model)
    used = [*motions, *forces.values()]
    kinds = [model.channels[c].kind for c in used]
    both = band_limit(y[:, used], kinds, rate_hz, model.band, shaft_response(model))
    P = len(motions)
    motion = Motion(0, both.a[:P], both.v[:P], both.x[:P], both.u[:P], both.valid)
    t = np.arange(motion.rows) / rate_hz
    if phase is None:
        phase = 2 * np.pi * (model.speed_rpm or 0.0) / 60.0 * t
    grid = layout(rate_hz, model.band, notches(model))
    if valid_blocks(motion.valid, grid).size < 8:
        raise DataError(
            f"the record has {motion.valid.sum() / rate_hz:.2f} s of valid samples in a row, "
            f"at least {6 * grid.size / rate_hz:.1f} s are needed for band.low {model.band[0]:g} Hz: record longer"
        )
    force = {row: both.a[P + i] for i, row in enumerate(forces)}
    return Record(model, rate_hz, motion, force, t, np.asarray(phase, np.float64), grid)


@dataclass(frozen=True, slots=True)
class Prepared:
    """A column's law, ready to be evaluated: (parameters, weight) pairs whose weighted forces add up to it."""

    law: int
    terms: tuple[tuple[Floats, float], ...]
    reads: NDArray[np.bool_]


def prepare_law(balance: Balance, k: int, scale: Floats) -> Prepared:
    """How column k is computed. scale (4,): rms of x, v, xo, vo."""
    column = balance.columns[k]
    law = balance.laws[column.law]
    if column.part in law.linear:
        p = law.p.copy()
        p[list(law.linear)] = 0.0
        p[column.part] = 1.0
        terms: tuple[tuple[Floats, float], ...] = ((p, 1.0),)
    elif column.part < 0:
        terms = ((law.p, 1.0),)
    else:
        d = law.steps[column.part]
        up, down = law.p.copy(), law.p.copy()
        up[column.part] += d
        down[column.part] -= d
        terms = ((up, 0.5 / d), (down, -0.5 / d))
    if law.effect.kind == "memory":
        return Prepared(column.law, terms, np.zeros(4, bool))
    reads = np.any([depends(law.effect, p, scale) for p, _ in terms], axis=0)
    return Prepared(column.law, terms, reads)


def state_of(balance: Balance, record: Record, row: int, widths: Floats, rows: slice) -> State:
    """What the laws at a place see. widths : (places, 2) sd of what the band leaves out of x and v."""
    m, o = record.motion, balance.other(row)
    zero = np.zeros(record.t[rows].size)
    h = np.sqrt(3.0) * np.concatenate([widths[row], widths[o] if o >= 0 else np.zeros(2)])
    xo, vo = (m.x[o, rows], m.v[o, rows]) if o >= 0 else (zero, zero)
    sign = 1.0 if balance.places[row].endswith(".x") else -1.0
    return State(m.x[row, rows], m.v[row, rows], xo, vo, record.t[rows], record.phase[rows], sign, h, m.valid[rows])


class Columns:
    """Evaluates the columns of a balance along a record, stretch by stretch."""

    def __init__(self, balance: Balance, record: Record, widths: Floats, linear: Floats | None = None) -> None:
        """linear : (places, 3) m, kL, c for effects with a memory."""
        self.balance, self.record, self.widths = balance, record, widths
        x, v = record.rms("x"), record.rms("v")
        self.laws: dict[int, Prepared] = {}
        self.memory: dict[int, Floats] = {}
        for k, column in enumerate(balance.columns):
            if column.kind != "law":
                continue
            i, o = column.row, balance.other(column.row)
            scale = np.array([x[i], v[i], x[o] if o >= 0 else 0.0, v[o] if o >= 0 else 0.0])
            self.laws[k] = prepare_law(balance, k, scale)
            effect = balance.laws[column.law].effect
            if effect.kind == "memory":
                m = record.motion
                lin = np.ones(3) if linear is None else linear[i]
                xs, vs = np.where(m.valid, m.x[i], 0.0), np.where(m.valid, m.v[i], 0.0)
                parts = [w * memory_array(effect, p, lin, xs, vs, record.rate_hz) for p, w in self.laws[k].terms]
                self.memory[k] = np.sum(parts, axis=0)

    def evaluate(self, rows: slice) -> tuple[Floats, Floats]:
        """(columns, n) and the (columns, 4) sums of tangents over the valid rows."""
        record, m = self.record, self.record.motion
        n = record.t[rows].size
        out, tangents = np.empty((len(self.balance.columns), n)), np.zeros((len(self.balance.columns), 4))
        states: dict[int, State] = {}
        for k, column in enumerate(self.balance.columns):
            if column.kind == "f":
                out[k] = record.force[column.row][rows]
            elif column.kind != "law":
                out[k] = getattr(m, column.kind)[column.row, rows]
            elif k in self.memory:
                out[k] = self.memory[k][rows]
                valid = m.valid[rows]
                x, v, z = m.x[column.row, rows][valid], m.v[column.row, rows][valid], out[k][valid]
                xx, vv = float(x @ x), float(v @ v)
                if xx > 0 and vv > 0:  # the regression gain: what the memory does on average
                    tangents[k, :2] = valid.sum() * np.array([float(z @ x) / xx, float(z @ v) / vv])
            else:
                if column.row not in states:
                    states[column.row] = state_of(self.balance, record, column.row, self.widths, rows)
                prepared = self.laws[k]
                effect = self.balance.laws[column.law].effect
                out[k] = 0.0
                for p, weight in prepared.terms:
                    force, sums = law_force(effect, p, states[column.row], prepared.reads)
                    out[k] += weight * force
                    tangents[k] += weight * sums
                if not np.isfinite(out[k]).all():
                    raise DataError(
                        f"the force of effect {effect.name} at {self.balance.places[column.row]} is not finite along "
                        "the measured motion: check its expression and limits"
                    )
        return out, tangents


@dataclass(frozen=True, slots=True)
class Bank:
    """Gram matrices by fold of time: what every sub-model, test and residual spectrum is computed from.

    grams : (folds, cells, k, k); blocks : (folds,); start : (folds,) s, where each begins.
    """

    balance: Balance
    grid: Layout
    grams: Floats
    blocks: Floats
    start: Floats
    tangents: Floats

    def evidence(self, folds: NDArray[np.bool_] | None = None) -> Evidence:
        """The sum over the folds (all, or those marked)."""
        keep = np.ones(self.blocks.size, bool) if folds is None else folds
        return Evidence(
            self.balance, self.grid, self.grams[keep].sum(axis=0), float(self.blocks[keep].sum()), self.tangents
        )

    def restrict(self, laws: set[int]) -> Bank:
        """The bank of the model that has only these laws (indices into balance.laws)."""
        from .balance import restrict

        balance, keep = restrict(self.balance, laws)
        return Bank(
            balance, self.grid, self.grams[:, :, keep][:, :, :, keep], self.blocks, self.start, self.tangents[keep]
        )


def stretches(blocks: NDArray[np.intp], most: int) -> Iterator[NDArray[np.intp]]:
    """Valid blocks in groups of neighbours, at most `most` each."""
    for run in np.split(blocks, np.flatnonzero(np.diff(blocks) > 1) + 1):
        for i in range(0, run.size, most):
            yield run[i : i + most]


def gather(
    record: Record,
    balance: Balance,
    widths: Floats,
    linear: Floats | None = None,
    per_fold: int = BLOCKS_PER_FOLD,
    seconds: float = np.inf,
) -> Bank:
    """The bank of a record, or of its first seconds. per_fold : blocks in a fold of time."""
    grid, k = record.grid, len(balance.columns)
    columns = Columns(balance, record, widths, linear)
    most = max(1, min(8, int(_MEMORY / (k * grid.size) / per_fold))) * per_fold
    grams, counts, starts = [], [], []
    tangents, weight = np.zeros((k, 4)), 0.0
    usable = valid_blocks(record.motion.valid, grid)
    usable = usable[: max(8, int(min(usable.size, seconds * record.rate_hz / grid.hop)))]
    for group in stretches(usable, most):
        rows = slice(int(group[0]) * grid.hop, int(group[-1]) * grid.hop + grid.size)
        z, sums = columns.evaluate(rows)
        tangents += sums
        weight += rows.stop - rows.start
        for i in range(0, group.size, per_fold):
            part = group[i : i + per_fold]
            grams.append(gram(spectra(z, part - group[0], grid), grid))
            counts.append(part.size)
            starts.append(part[0] * grid.hop / record.rate_hz)
    return Bank(balance, grid, np.array(grams), np.array(counts, float), np.array(starts), tangents / weight)
