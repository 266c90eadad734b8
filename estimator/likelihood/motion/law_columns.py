"""The columns of a force balance evaluated along a stretch of band-limited motion, live or offline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.errors import NotFiniteError

from .denoise import restore_mean_tangent
from .force_balance import Balance
from .law_smoothing import (
    FINE_GRID_FACTOR,
    HALF_SUPPORT_ROWS,
    MARGIN_ROWS,
    LawStates,
    compile_law,
    decimated,
    harmonics_alias,
    has_kink,
    law_force,
    reads_states,
)
from .linear_memory import filtered_series, linear_response
from .memory_law import memory_force, memory_force_and_response


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Consecutive rows, MARGIN_ROWS more on either side. a, v, x, u : (places, n); force : row -> (n,); valid : (n,).

    slow : (places, n) displacement below the band that the laws see beside x (below_band.py). calm : (places, n) what
    they see beside x where sensors are noisy (denoise.py).
    """

    a: Array
    v: Array
    x: Array
    u: Array
    valid: NDArray[np.bool_]
    force: dict[int, Array]
    t: Array
    phase: Array
    rate_hz: float
    slow: Array | None = None
    calm: Array | None = None

    @property
    def rows(self) -> int:
        return int(self.t.size - 2 * MARGIN_ROWS)

    def seen(self, row: int) -> Array:
        """(n,) displacement at a place as its laws see it."""
        return self.x[row] if self.slow is None else np.asarray(self.x[row] + self.slow[row])

    def calmed(self, row: int) -> Array:
        """(n,) the same without the noise of sensors."""
        return self.seen(row) if self.calm is None else np.asarray(self.seen(row) + self.calm[row])

    def part(self, start: int, stop: int) -> Stretch:
        """Rows start ... stop - 1 with their margins."""
        rows = slice(start, stop + 2 * MARGIN_ROWS)
        a, v, x, u = (z[:, rows] for z in (self.a, self.v, self.x, self.u))
        force = {i: z[rows] for i, z in self.force.items()}
        slow, calm = (None if z is None else z[:, rows] for z in (self.slow, self.calm))
        return Stretch(
            a=a,
            v=v,
            x=x,
            u=u,
            valid=self.valid[rows],
            force=force,
            t=self.t[rows],
            phase=self.phase[rows],
            rate_hz=self.rate_hz,
            slow=slow,
            calm=calm,
        )


@dataclass(frozen=True, slots=True)
class _Law:
    """A column's law: (parameters, weight) pairs whose weighted forces add up to it."""

    terms: tuple[tuple[Array, float], ...]
    reads: NDArray[np.bool_]
    fine: bool  # evaluated on the finer grid


class Columns:
    """Evaluates the columns of a balance.

    rms : (places, 2) of x and v. widths : (places, 2) sd of what the band leaves out of x and v. linear : (places, 3)
    m, kL, c for effects with a memory. fine : only the first so many laws get the finer grid where they need it.
    folding_hz : the sampling rate less the upper band edge.
    """

    def __init__(
        self,
        balance: Balance,
        rms: Array,
        widths: Array,
        linear: Array | None = None,
        fine: int | None = None,
        folding_hz: float = np.inf,
    ) -> None:
        self.balance, self.widths, self._folding_hz = balance, widths, folding_hz
        self.fine = len(balance.laws) if fine is None else fine
        self.linear = np.ones((len(balance.places), 3)) if linear is None else linear
        self._laws: dict[int, _Law] = {}
        self._read = np.zeros((len(balance.places), 4), bool)  # x, v, xo, vo by a law that gets the finer grid
        for k, column in enumerate(balance.columns):
            if column.kind == "law":
                other = balance.other(column.row)
                scale = np.concatenate([rms[column.row], rms[other] if other >= 0 else np.zeros(2)])
                self._laws[k] = law = self._law(k, scale)
                self._read[column.row] |= law.reads & law.fine

    def _law(self, k: int, scale: Array) -> _Law:
        column = self.balance.columns[k]
        law = self.balance.laws[column.law]
        if column.part in law.linear:
            p = law.p.copy()
            p[list(law.linear)] = 0.0
            p[column.part] = 1.0
            terms: tuple[tuple[Array, float], ...] = ((p, 1.0),)
        elif column.part < 0:
            terms = ((law.p, 1.0),)
        else:
            d = law.steps[column.part]
            up, down = law.p.copy(), law.p.copy()
            up[column.part] += d
            down[column.part] -= d
            terms = ((up, 0.5 / d), (down, -0.5 / d))
        if law.effect.kind == "memory":
            return _Law(terms, np.zeros(4, bool), False)
        compile_law(law.effect, law.p)
        reads = np.any([reads_states(law.effect, p, scale) for p, _ in terms], axis=0)
        p = terms[0][0]
        finer = has_kink(law.effect, p, scale) or harmonics_alias(law.effect, p, scale, self._folding_hz)
        return _Law(terms, reads, column.law < self.fine and finer)

    def state(self, row: int, stretch: Stretch) -> LawStates:
        """What the laws at a place see."""
        other = self.balance.other(row)
        h = np.sqrt(3.0) * np.concatenate([self.widths[row], self.widths[other] if other >= 0 else np.zeros(2)])
        xo, vo = (stretch.calmed(other), stretch.v[other]) if other >= 0 else (np.zeros(stretch.t.size),) * 2
        sign = 1.0 if self.balance.places[row].endswith(".x") else -1.0
        return LawStates(
            x=stretch.calmed(row),
            v=stretch.v[row],
            xo=xo,
            vo=vo,
            t=stretch.t,
            phase=stretch.phase,
            s=sign,
            h=h,
            valid=stretch.valid,
        )

    def evaluate(self, stretch: Stretch) -> tuple[Array, Array]:
        """(columns, rows) and (columns, 4) sums of tangents over the valid rows. Raises DataError if not finite."""
        out, tangents = self.along(stretch, stretch.rows)
        return out, tangents[0]

    def along(self, stretch: Stretch, piece: int) -> tuple[Array, Array]:
        """(columns, rows), and the sums of tangents over every `piece` valid rows, (pieces, columns, 4)."""
        starts = range(0, stretch.rows, piece)
        inner = slice(MARGIN_ROWS, MARGIN_ROWS + stretch.rows)
        out = np.empty((len(self.balance.columns), stretch.rows))
        tangents = np.zeros((len(starts), len(self.balance.columns), 4))
        for k, column in enumerate(self.balance.columns):
            if column.kind == "f":
                out[k] = stretch.force[column.row][inner]
            elif column.kind != "law":
                out[k] = getattr(stretch, column.kind)[column.row, inner]
            elif self.balance.laws[column.law].effect.kind == "memory":
                out[k], gains = self._memory(k, stretch, inner)
                tangents[:, k] = gains * (piece / stretch.rows)
        for i, start in enumerate(starts):
            part = stretch.part(start, min(start + piece, stretch.rows)) if len(starts) > 1 else stretch
            states: dict[tuple[int, bool], LawStates] = {}
            for k, column in enumerate(self.balance.columns):
                if column.kind == "law" and self.balance.laws[column.law].effect.kind != "memory":
                    out[k, start : start + part.rows], tangents[i, k] = self.law(k, part, states)
        for k, column in enumerate(self.balance.columns):
            if column.kind == "law" and not np.isfinite(out[k]).all():
                raise self.not_finite(k)
        return out, tangents

    def law(self, k: int, stretch: Stretch, states: dict[tuple[int, bool], LawStates]) -> tuple[Array, Array]:
        """(rows,) force of law column k and (4,) sums of its tangents over the valid rows.

        states : what the laws of this stretch have seen, by place and grid; filled here.
        """
        column, law = self.balance.columns[k], self._laws[k]
        effect = self.balance.laws[column.law].effect
        if effect.kind == "memory":
            return self._memory(k, stretch, slice(MARGIN_ROWS, MARGIN_ROWS + stretch.rows))
        key = (column.row, law.fine)
        if key not in states:
            wide = self.state(column.row, stretch)
            states[key] = wide.finer(self._read[column.row]) if law.fine else wide.inner()
        total, tangents = law_force(effect, law.terms[0][0], states[key], law.reads)
        first = law.terms[0][1]
        if first != 1.0:
            total *= first
            tangents *= first
        for p, weight in law.terms[1:]:
            force, sums = law_force(effect, p, states[key], law.reads)
            total += weight * force
            tangents += weight * sums
        if law.fine:
            total, tangents = decimated(total), tangents / FINE_GRID_FACTOR
        if stretch.calm is not None:
            inner = slice(MARGIN_ROWS, MARGIN_ROWS + stretch.rows)
            mean = tangents / max(1, int(stretch.valid[inner].sum()))
            restore_mean_tangent(total, mean, stretch.calm[:, inner], column.row, self.balance.other(column.row))
        return total, tangents

    def not_finite(self, k: int) -> NotFiniteError:
        """What is wrong where the force of law column k is not a number."""
        column = self.balance.columns[k]
        return NotFiniteError(self.balance.laws[column.law].effect.name, self.balance.places[column.row])

    def tangent_series(self, k: int, stretch: Stretch) -> tuple[Array, Array, int]:
        """Tangents of column k along x and v, and how many rows there are to a row of the stretch."""
        column, law = self.balance.columns[k], self._laws[k]
        wide = self.state(column.row, stretch)
        state = wide.finer(self._read[column.row]) if law.fine else wide.inner()
        effect = self.balance.laws[column.law].effect
        kx, kv = np.zeros(state.x.size), np.zeros(state.x.size)
        for p, weight in law.terms:
            series = (np.zeros(state.x.size), np.zeros(state.x.size))
            law_force(effect, p, state, law.reads, series)
            kx += weight * series[0]
            kv += weight * series[1]
        if law.fine:
            return (
                kx[HALF_SUPPORT_ROWS * FINE_GRID_FACTOR : -HALF_SUPPORT_ROWS * FINE_GRID_FACTOR],
                kv[HALF_SUPPORT_ROWS * FINE_GRID_FACTOR : -HALF_SUPPORT_ROWS * FINE_GRID_FACTOR],
                FINE_GRID_FACTOR,
            )
        return kx, kv, 1

    def mean_response(self, k: int, stretch: Stretch | None, f_hz: Array) -> NDArray[np.complex128] | None:
        """(f,) N/m at f_hz: what column k, with memory, answers in the mean to the displacement of its place.

        Exact if its states obey linear equations; else an average over the stretch, None without one.
        """
        column, law = self.balance.columns[k], self._laws[k]
        effect, lin = self.balance.laws[column.law].effect, self.linear[column.row]
        out = np.zeros(f_hz.size, complex)
        for p, weight in law.terms:
            linear = linear_response(effect, p, lin)
            if linear is not None:
                out += weight * linear(2 * np.pi * f_hz)
            elif stretch is not None:
                x, v = stretch.x[column.row], stretch.v[column.row]
                out += weight * memory_force_and_response(effect, p, lin, x, v, stretch.rate_hz)[1].at(f_hz)
            else:
                return None
        return out

    def _memory(self, k: int, stretch: Stretch, inner: slice) -> tuple[Array, Array]:
        """Force of an effect with states, from rest at the start of the stretch, and its mean gain to x and v."""
        column, law = self.balance.columns[k], self._laws[k]
        effect = self.balance.laws[column.law].effect
        x, v, lin = stretch.x[column.row], stretch.v[column.row], self.linear[column.row]
        force = np.zeros(x.size)
        for p, weight in law.terms:
            linear = linear_response(effect, p, lin)
            if linear is None:
                force += weight * memory_force(effect, p, lin, x, v, stretch.rate_hz)
            else:
                force += weight * filtered_series(linear, x, stretch.rate_hz)
        f, valid = force[inner], stretch.valid[inner]
        x, v, z = x[inner][valid], v[inner][valid], f[valid]
        gains = np.zeros(4)
        xx, vv = float(x @ x), float(v @ v)
        if xx > 0 and vv > 0:
            gains[:2] = valid.sum() * np.array([float(z @ x) / xx, float(z @ v) / vv])
        return f, gains
