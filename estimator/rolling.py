"""The spectral estimator while samples arrive: the same filters, columns, Gram matrices and likelihood as `fit`.

The first seconds are kept and fitted as a record; until that works nothing is shown. Their Gram matrices start the
memory, which then forgets exponentially. A second memory that forgets faster watches for change: when a parameter as
the recent data have it differs from that of the long memory by five standard deviations of the difference, twice in a
row, the recent memory replaces the long one: a change is followed faster, and the interval, wider for a while, stays
honest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .balance import Balance, build, force_channels, motion_channels, restrict, shaft_response
from .bandlimit import BandLimit, Motion
from .columns import Columns
from .dressing import dressed, mean_responses, self_energies
from .errors import DataError
from .estimate import Estimate
from .features import MARGIN
from .gram import Layout, gram, layout, spectra
from .likelihood import Evidence, Likelihood, Local, Point, active, maximise
from .lines import begin
from .maximum import initial, inverse, maximum
from .model import Model
from .record import Record, as_record, gather, notches
from .spectral import judged
from .start import Start
from .watch import CANDIDATES, look, with_candidates

Floats = NDArray[np.float64]
WARM_UP_S = 4.0
SHOW_EVERY_S = 0.45
FAST = 0.25  # time constant of the watching memory over that of the long one
CHANGE = 5.0  # standard deviations


@dataclass(slots=True)
class Memory:
    """Exponentially forgetting sums. n : blocks; n2 : sum of squared weights; tangents : of `rows` rows."""

    keep: float  # what is left after one block
    gram: Floats
    tangents: Floats
    n: float = 0.0
    n2: float = 0.0
    rows: float = 0.0

    def forget(self) -> None:
        factor = self.keep
        self.gram *= factor
        self.tangents *= factor
        self.n *= factor
        self.n2 *= factor**2
        self.rows *= factor

    def add(self, gram: Floats, tangents: Floats, rows: int) -> None:
        self.gram += gram
        self.tangents += tangents
        self.n += 1.0
        self.n2 += 1.0
        self.rows += rows

    def copy_from(self, other: Memory) -> None:
        self.gram, self.tangents = other.gram.copy(), other.tangents.copy()
        self.n, self.n2, self.rows = other.n, other.n2, other.rows


class RollingSpectral:
    """OnlineEstimator by the spectral likelihood. Estimates are renewed about twice a second.

    watch : catalogue effects whose force is looked for in what the model leaves over (watch.py). The estimate's
        `extra` then holds missing_force_percent, rms of the force that all of them together would explain over the
        rms linear bearing force, and missing_force_percent_NAME for each one that is certain. None: half the cost.
    """

    def __init__(
        self, model: Model, rate_hz: float, time_constant_s: float, watch: tuple[str, ...] = CANDIDATES
    ) -> None:
        if time_constant_s <= 0:
            raise ValueError(f"time constant {time_constant_s} s: it must be positive")
        self.model, self.rate_hz, self.time_constant_s, self.watch = model, rate_hz, time_constant_s, watch
        motions, forces = motion_channels(model), force_channels(model)
        self._used = [*motions, *forces.values()]
        kinds = [model.channels[c].kind for c in self._used]
        self._filter = BandLimit(kinds, rate_hz, model.band, shaft_response(model))
        self._grid: Layout = layout(rate_hz, model.band, notches(model))
        self._kept: list[Motion] = []  # what the next blocks and a new start need
        self._seen = 0  # rows taken in
        self._next = 0  # first row of the next block
        self._since_solved = 0
        self._status = "warming up"
        self._fitted: _Fitted | None = None
        self._retry_at = 0
        self._estimate = Estimate(0, {}, 0.0, status="warming up")

    def update(self, block: Floats) -> None:
        """Take the next rows, (n, channels); NaN where a sample is missing or clipped."""
        self._seen += len(block)
        self._since_solved += len(block)
        motion = self._filter.push(block[:, self._used])
        if motion.rows:
            self._kept.append(motion)
            self._advance()

    def snapshot(self) -> Estimate:
        """The estimate as of the last update."""
        return replace(self._estimate, index=self._seen)

    # the rest is private

    def _record(self, first: int = 0) -> Record:
        """What is kept, from the piece that holds row `first` on, as a record."""
        parts = [p for p in self._kept if p.start + p.rows > first]
        return as_record(self.model, self.rate_hz, parts, self._grid)

    def _advance(self) -> None:
        end = self._kept[-1].start + self._kept[-1].rows
        if self._fitted is None:
            wanted = max(int(WARM_UP_S * self.rate_hz), 24 * self._grid.hop)
            if end - self._kept[0].start >= wanted and end >= self._retry_at:
                self._begin()
                self._retry_at = end + wanted // 2
                self._trim(end - wanted)
            return
        fitted, grid = self._fitted, self._grid
        record = self._record(self._next - MARGIN)
        first = record.motion.start
        while self._next + grid.size + MARGIN <= end:
            at = self._next - first
            fitted.forget()
            if record.motion.valid[at : at + grid.size].all():
                z, sums = fitted.columns.evaluate(record.stretch(at, at + grid.size))
                one = gram(spectra(z, np.zeros(1, np.intp), grid), grid)
                fitted.add(one, sums, grid.size)
            self._next += grid.hop
        self._trim(min(self._next - MARGIN, end - max(int(WARM_UP_S * self.rate_hz), 24 * grid.hop)))
        if self._since_solved >= SHOW_EVERY_S * self.rate_hz * 0.8:
            self._solve()

    def _trim(self, needed: int) -> None:
        while len(self._kept) > 1 and self._kept[1].start <= needed:
            self._kept.pop(0)

    def _begin(self) -> None:
        """Fit what is kept as a record, or say why it cannot be."""
        record = self._record()
        try:
            record, start = begin(record, longest=1)
            self._grid = record.grid
            self._fitted = _Fitted.begin(record, start, self.model, self.time_constant_s, self.watch)
        except DataError as e:
            self._estimate = Estimate(self._seen, {}, 0.0, status=str(e))
            return
        blocks = (record.motion.rows - self._grid.size) // self._grid.hop + 1
        self._next = self._kept[0].start + blocks * self._grid.hop
        self._solve()

    def _solve(self) -> None:
        fitted = self._fitted
        if fitted is None:
            return
        self._since_solved = 0
        hop_s = self._grid.hop / self.rate_hz
        if fitted.slow.n < 6 or fitted.slow.n * hop_s < 0.1 * min(self.time_constant_s, WARM_UP_S):
            self._estimate = Estimate(self._seen, {}, 0.0, status="too few valid samples of late")
            return
        fitted.solve()
        parameters = judged(fitted.balance, fitted.local.point, fitted.covariance(), self.model)
        samples = fitted.slow.n**2 / fitted.slow.n2 * self._grid.hop
        self._estimate = Estimate(self._seen, parameters, samples, -fitted.local.nll, extra=fitted.missing())


class _Fitted:
    """Balances, memories and the point of a rolling fit. `wide` is the balance with the candidates, `balance` without;
    the memories hold the Gram matrices of `wide`, of which `own` are the columns of `balance`."""

    def __init__(
        self, start: Start, wide: Balance, laws: int, columns: Columns, grid: Layout, keep: float, fast: float
    ) -> None:
        self.start, self.wide, self.columns, self.grid = start, wide, columns, grid
        self.balance, own = restrict(wide, set(range(laws)))
        self.own = np.array(own, dtype=np.intp)
        k = len(wide.columns)
        self.slow, self.fast = (Memory(a, np.zeros((grid.starts.size, k, k)), np.zeros((k, 4))) for a in (keep, fast))
        self.pairs: NDArray[np.complex128] | None = None
        self.local: Local
        self.suspicions = 0
        self.shared = 0.0  # sum of the products of the two memories' weights

    @classmethod
    def begin(
        cls, record: Record, start: Start, model: Model, time_constant_s: float, watch: tuple[str, ...]
    ) -> _Fitted:
        values: dict[str, float] = {}
        if len(build(model, start.sizes).free) > len(build(model, start.sizes, search=False).free):
            values = maximum(record, start, model).values  # the shapes as the first seconds have them
        own = build(model, start.sizes, values, search=False)
        wide = build(with_candidates(model, watch), start.sizes, values, search=False)
        bank = gather(record, wide, start.widths, start.linear, per_fold=1, fine=len(own.laws))
        columns = Columns(wide, record.scales, start.widths, start.linear, fine=len(own.laws))
        hop_s = record.grid.hop / record.rate_hz
        watching = max(FAST * time_constant_s, 10 * hop_s)
        keeps = (float(np.exp(-hop_s / t)) for t in (time_constant_s, watching))
        fitted = cls(start, wide, len(own.laws), columns, record.grid, *keeps)
        for G in bank.grams:
            fitted.forget()
            fitted.add(G, bank.tangents * record.grid.size, record.grid.size)
        likelihood, fitted.local, _ = fitted._maximise(fitted._initial(values))
        fitted._dress(record)
        return fitted

    def _initial(self, values: dict[str, float]) -> Point:
        return initial(self.balance, self.start, values)

    def _dress(self, record: Record) -> None:
        B = self.balance.coefficients(self.local.point.beta)
        mean = mean_responses(self.balance, B, self.slow.tangents[self.own] / self.slow.rows)
        if any(law.effect.kind == "force" for law in self.balance.laws) and all(m.c > 0 and m.k > 0 for m in mean):
            columns = Columns(self.balance, record.scales, self.start.widths, self.start.linear)
            self.pairs = self_energies(record, columns, B, mean, self.start.nodes.f_hz, WARM_UP_S)

    def forget(self) -> None:
        self.slow.forget()
        self.fast.forget()
        self.shared *= self.slow.keep * self.fast.keep

    def add(self, G: Floats, tangents: Floats, rows: int) -> None:
        self.slow.add(G, tangents, rows)
        self.fast.add(G, tangents, rows)
        self.shared += 1.0

    def _evidence(self, memory: Memory, beta: Floats | None) -> Evidence:
        dressing = None
        if self.pairs is not None and beta is not None:
            B = self.balance.coefficients(beta)
            dressing = dressed(self.pairs, self.balance, B, self.start.nodes.f_hz)
        mean = memory.tangents[self.own] / memory.rows
        own = memory.gram[:, self.own[:, None], self.own]
        return Evidence(self.balance, self.grid, own, memory.n, mean, self.start.nodes, dressing)

    def missing(self) -> dict[str, float] | None:
        """Force that candidates would explain, per cent of the rms linear bearing force; None without candidates."""
        if len(self.wide.laws) == len(self.balance.laws):
            return None
        slow, dressing = self.slow, self._evidence(self.slow, self.local.point.beta).dressing
        if dressing is not None:
            whole = np.zeros((dressing.shape[0], len(self.wide.columns)), complex)
            whole[:, self.own] = dressing
            dressing = whole
        mean = slow.tangents / slow.rows
        wide = Evidence(self.wide, self.grid, slow.gram, slow.n, mean, self.start.nodes, dressing)
        found = look(wide, self.balance, self.local.point, slow.n2 / slow.n)
        sure = {f"missing_force_percent_{name}": percent for name, percent in found.sure.items()}
        return {"missing_force_percent": found.total} | sure

    def _maximise(self, point: Point) -> tuple[Likelihood, Local, bool]:
        likelihood = Likelihood(self._evidence(self.slow, point.beta))
        local, converged = maximise(likelihood, point, iterations=8, tolerance=1e-3)
        return likelihood, local, converged

    def solve(self) -> None:
        """Renew the point from the memory, and the memory if the recent data contradict it."""
        _, self.local, _ = self._maximise(self.local.point)
        self.suspicions = self.suspicions + 1 if self._changed() else 0
        if self.suspicions >= 2:
            self.slow.copy_from(self.fast)
            self.shared, self.suspicions = self.fast.n2, 0
            _, self.local, _ = self._maximise(self.local.point)

    def _changed(self) -> bool:
        """Whether one Newton step on the recent memory leads away from the point of the long one."""
        recent = Likelihood(self._evidence(self.fast, self.local.point.beta)).at(self.local.point)
        V = inverse(recent)
        used = active(self.local.point)
        used = used[np.isfinite(np.diag(V)[used])]
        V = V[np.ix_(used, used)]
        step = V @ recent.gradient[used]
        f, s = self.fast, self.slow
        spread = f.n2 / f.n**2 + s.n2 / s.n**2 - 2 * self.shared / (f.n * s.n)  # the memories share recent blocks
        return bool(np.any(np.abs(step) > CHANGE * np.sqrt(np.diag(V) * f.n * max(spread, 1e-9))))

    def covariance(self) -> Floats:
        """H^-1 for weights that forget: the score varies by n2 / n of what the Hessian says."""
        return inverse(self.local) * (self.slow.n2 / self.slow.n)
