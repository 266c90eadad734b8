"""The spectral estimator while samples arrive: the same filters, columns, Gram matrices and likelihood as `fit`.

The first seconds are kept and fitted as a record; until that works nothing is shown. Their Gram matrices start the
memory, which then forgets exponentially. A second memory that forgets faster watches for change: when a parameter as
the recent data have it differs from that of the long memory by five standard deviations of the difference, twice in a
row, the recent memory replaces the long one: a change is followed faster, and the interval, wider for a while, stays
honest.

Lines that were there at the start are left out of the grid for good, those that come or move block by block
(moving_lines.py); a tacho channel gives the angle of the shaft. The candidates of watch.py have a memory of their own,
of every third block, and are looked at every three seconds. What is computed when depends on the data alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .balance import Balance, build, force_channels, motion_channels, restrict, shaft_response
from .bandlimit import BandLimit, Motion
from .columns import Columns, Stretch
from .dressing import dressed, mean_responses, self_energies
from .errors import DataError
from .estimate import Estimate
from .features import MARGIN
from .gram import Layout, gram, layout, spectra
from .likelihood import Evidence, Likelihood, Local, Point, active, maximise, spectrum_of_force
from .lines import begin
from .maximum import initial, inverse, maximum
from .model import Model
from .moving_lines import MovingLines
from .record import Record, as_record, gather, notches
from .shaft_speed import ShaftAngle
from .spectral import OVERLAP, judged
from .start import Start
from .watch import CANDIDATES, look, with_candidates

Floats = NDArray[np.float64]
WARM_UP_S = 4.0
SHOW_EVERY_S = 0.45
FAST = 0.25  # time constant of the watching memory over that of the long one
CHANGE = 5.0  # standard deviations
CHECKED_EVERY = 2  # solutions, for a change
WATCHED_EVERY = 3  # blocks: every other one at most, so that no two share rows
LOOKED_EVERY = 8  # solutions
FEWEST_WATCHED = 6  # blocks
CLOSE = 10.0  # nats: a standard deviation or so of each parameter; one Newton step from there leaves a few per cent


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

    def add(self, gram: Floats, tangents: Floats, rows: int, square: float = 1.0) -> None:
        """square : mean square of the weights of the bins, whose mean is 1."""
        self.gram += gram
        self.tangents += tangents
        self.n += 1.0
        self.n2 += square
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
        self._shaft = ShaftAngle(model, rate_hz)
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
        self._shaft.push(block)
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
        record = as_record(self.model, self.rate_hz, parts, self._grid)
        if not self._shaft.measured:
            return record
        angle = self._shaft.angle(record.motion.start, record.motion.start + record.motion.rows)
        return record if angle is None else replace(record, phase=angle)

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
                fitted.take(record.stretch(at, at + grid.size), self._shaft.measured)
            else:
                fitted.lines.restart()
            self._next += grid.hop
        self._trim(min(self._next - MARGIN, end - max(int(WARM_UP_S * self.rate_hz), 24 * grid.hop)))
        if self._since_solved >= SHOW_EVERY_S * self.rate_hz * 0.8:
            self._solve()

    def _trim(self, needed: int) -> None:
        while len(self._kept) > 1 and self._kept[1].start <= needed:
            self._kept.pop(0)
        self._shaft.drop(self._kept[0].start)

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
        self._estimate = Estimate(self._seen, parameters, samples, -fitted.local.nll, extra=fitted.missing)


class _Fitted:
    """Balances, memories and the point of a rolling fit. `wide` is the balance with the candidates, `balance` without;
    `own` are the columns of `balance` among those of `wide`. Memories: `slow` and `fast` of `balance`, `seen` of
    `wide`."""

    def __init__(
        self, record: Record, start: Start, wide: Balance, laws: int, time_constant_s: float, columns: Columns
    ) -> None:
        grid = record.grid
        self.start, self.wide, self.wide_columns, self.grid = start, wide, columns, grid
        self.balance, own = restrict(wide, set(range(laws)))
        self.own = np.array(own, dtype=np.intp)
        self.columns = Columns(self.balance, record.scales, start.widths, start.linear)
        hop_s = grid.hop / record.rate_hz
        watching = max(FAST * time_constant_s, 10 * hop_s)
        self.slow, self.fast, self.seen = (
            Memory(float(np.exp(-hop_s / t)), np.zeros((grid.starts.size, k, k)), np.zeros((k, 4)))
            for t, k in ((time_constant_s, len(own)), (watching, len(own)), (time_constant_s, len(wide.columns)))
        )
        self.lines = MovingLines(grid.f_hz, any(c.kind == "tacho" for c in record.model.channels))
        self.pairs: NDArray[np.complex128] | None = None
        self.local: Local
        self.suspicions = 0
        self.shared = 0.0  # sum of the products of the two memories' weights
        self.turn = 0  # blocks taken
        self.solved = 0
        self.missing: dict[str, float] | None = None

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
        fitted = cls(record, start, wide, len(own.laws), time_constant_s, columns)
        for G in bank.grams:
            fitted.forget()
            fitted._add(G, bank.tangents * record.grid.size, 1.0)
        fitted.local, _ = maximise(fitted._likelihood(fitted.slow, None), initial(fitted.balance, start, values))
        fitted._dress(record)
        return fitted

    def _dress(self, record: Record) -> None:
        B = self.balance.coefficients(self.local.point.beta)
        mean = mean_responses(self.balance, B, self.slow.tangents / self.slow.rows)
        if any(law.effect.kind == "force" for law in self.balance.laws) and all(m.c > 0 and m.k > 0 for m in mean):
            self.pairs = self_energies(record, self.columns, B, mean, self.start.nodes.f_hz, WARM_UP_S)

    def forget(self) -> None:
        for memory in (self.slow, self.fast, self.seen):
            memory.forget()
        self.shared *= self.slow.keep * self.fast.keep

    @property
    def _watches(self) -> bool:
        """Whether the candidates' columns are needed of the next block."""
        return len(self.wide.laws) > len(self.balance.laws) and self.turn % WATCHED_EVERY == 0

    def take(self, stretch: Stretch, measured: bool) -> None:
        """Add a block, its lines left out. measured : the stretch's angle is that of a tacho."""
        watches = self._watches
        z, tangents = (self.wide_columns if watches else self.columns).evaluate(stretch)
        Z = spectra(z, np.zeros(1, np.intp), self.grid)
        B = self.balance.coefficients(self.local.point.beta)
        speed_hz = None
        if measured:
            speed_hz = float(stretch.phase[-1] - stretch.phase[0]) / (2 * np.pi * (stretch.t[-1] - stretch.t[0]))
        weights = self.lines(B @ (Z[self.own, 0] if watches else Z[:, 0]), speed_hz)
        if weights is not None:
            Z = Z * np.sqrt(weights)
        self._add(gram(Z, self.grid), tangents, 1.0 if weights is None else float(np.mean(weights**2)))

    def _add(self, G: Floats, tangents: Floats, square: float) -> None:
        """G, tangents : of the columns of `wide` where the candidates are watched, else of `balance`."""
        rows = self.grid.size
        if G.shape[1] > self.own.size:
            if self._watches:
                self.seen.add(G, tangents, rows, square)
            G, tangents = G[:, self.own[:, None], self.own], tangents[self.own]
        self.turn += 1
        self.slow.add(G, tangents, rows, square)
        self.fast.add(G, tangents, rows, square)
        self.shared += square

    def _likelihood(self, memory: Memory, beta: Floats | None) -> Likelihood:
        """Of the balance's own columns. beta : where the responses are dressed; None: they are not."""
        gram, mean = memory.gram, memory.tangents / memory.rows
        if memory is self.seen:
            gram, mean = gram[:, self.own[:, None], self.own], mean[self.own]
        nodes, dressing = self.start.nodes, self._dressing(beta)
        return Likelihood(Evidence(self.balance, self.grid, gram, memory.n, mean, nodes, dressing))

    def _dressing(self, beta: Floats | None) -> NDArray[np.complex128] | None:
        if self.pairs is None or beta is None:
            return None
        return dressed(self.pairs, self.balance, self.balance.coefficients(beta), self.start.nodes.f_hz)

    def solve(self) -> None:
        """Renew the point from the memory, and the memory if the recent data contradict it."""
        self._renew()
        if self.solved % CHECKED_EVERY == 0:
            self.suspicions = self.suspicions + 1 if self._changed() else 0
            if self.suspicions >= 2:
                self._replace()
        if self.solved % LOOKED_EVERY == 0:
            self.missing = self._look()
        self.solved += 1

    def _renew(self) -> None:
        """One Newton step from the last point, which is never far; from farther away, to the maximum."""
        point = self.local.point
        likelihood = self._likelihood(self.slow, point.beta)
        count: Floats = 0.5 * self.slow.n * self.grid.per_cell
        S, noise = spectrum_of_force(*likelihood.power(point.beta), count, point)
        local = likelihood.at(Point(point.beta, S, noise))
        step, decrement = _newton(local)[::2]
        p, P = point.beta.size, S.size
        beta = point.beta + step[:p]
        if decrement < CLOSE and likelihood.damping(beta).min() > 0.0:
            # S and noise are best for the old beta: along the step they fall as a parabola, half its first slope
            S, noise = S * np.exp(0.5 * step[p : p + P]), np.maximum(noise + 0.5 * step[p + P :], 0.0)
            self.local = replace(local, point=Point(beta, S, noise))
        else:
            self.local, _ = maximise(likelihood, point, iterations=8, tolerance=1e-3)

    def _changed(self) -> bool:
        """Whether one Newton step on the recent memory leads away from the point of the long one."""
        recent = self._likelihood(self.fast, self.local.point.beta).at(self.local.point)
        step, variance, _ = _newton(recent)
        f, s = self.fast, self.slow
        spread = f.n2 / f.n**2 + s.n2 / s.n**2 - 2 * self.shared / (f.n * s.n)  # the memories share recent blocks
        return bool(np.any(np.abs(step) > CHANGE * np.sqrt(variance * f.n * max(spread, 1e-9))))

    def _replace(self) -> None:
        """The recent memory in place of the long one; of the candidates nothing recent enough is kept."""
        self.slow.copy_from(self.fast)
        self.shared, self.suspicions = self.fast.n2, 0
        self.seen.copy_from(Memory(self.seen.keep, np.zeros_like(self.seen.gram), np.zeros_like(self.seen.tangents)))
        self.missing = None
        self.local, _ = maximise(self._likelihood(self.slow, self.local.point.beta), self.local.point, 8, 1e-3)

    def _look(self) -> dict[str, float] | None:
        """Force that candidates would explain, per cent of the rms linear bearing force; None if it is not known."""
        seen, beta = self.seen, self.local.point.beta
        if len(self.wide.laws) == len(self.balance.laws) or seen.n < FEWEST_WATCHED:
            return None
        local, _ = maximise(self._likelihood(seen, beta), self.local.point, iterations=4, tolerance=1e-2)
        dressing = self._dressing(beta)
        if dressing is not None:
            whole = np.zeros((dressing.shape[0], len(self.wide.columns)), complex)
            whole[:, self.own] = dressing
            dressing = whole
        mean = seen.tangents / seen.rows
        wide = Evidence(self.wide, self.grid, seen.gram, seen.n, mean, self.start.nodes, dressing)
        # blocks that share no rows vary less than the likelihood's count of them says
        found = look(wide, self.balance, local.point, seen.n2 / seen.n / (1.0 + 2.0 * OVERLAP))
        sure = {f"missing_force_percent_{name}": percent for name, percent in found.sure.items()}
        return {"missing_force_percent": found.total} | sure

    def covariance(self) -> Floats:
        """H^-1 for weights that forget: the score varies by n2 / n of what the Hessian says."""
        return inverse(self.local) * (self.slow.n2 / self.slow.n)


def _newton(local: Local) -> tuple[Floats, Floats, float]:
    """Newton step and variances (p + 2 P,) as in `Local`, zero for what the data leave free; decrement in nats."""
    V, used = inverse(local), active(local.point)
    used = used[np.isfinite(np.diag(V)[used])]
    V, g = V[np.ix_(used, used)], local.gradient[used]
    step, variance = np.zeros(local.gradient.size), np.zeros(local.gradient.size)
    step[used], variance[used] = -V @ g, np.diag(V)
    return step, variance, -float(g @ step[used])
