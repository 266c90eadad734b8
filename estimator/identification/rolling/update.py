"""The memories of a rolling fit, and how its point is renewed from them (estimator.py)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.identification.batch.linear_start import LinearStart, restarted_about
from estimator.identification.batch.maximum import Maximum, initial, inverse, maximum, without_noise
from estimator.identification.batch.report import BLOCK_ENERGY_CORRELATION
from estimator.likelihood.motion.force_balance import Balance, build_balance, restrict
from estimator.likelihood.motion.known_spectra import excitation_shapes
from estimator.likelihood.motion.law_columns import Columns
from estimator.likelihood.motion.law_smoothing import MARGIN_ROWS
from estimator.likelihood.motion.stream_record import Record, gather
from estimator.likelihood.motion.streaming_spectra import BlockSpectra
from estimator.likelihood.path.gram_likelihood import Evidence, Likelihood, Local, Point, active, maximise
from estimator.likelihood.path.jacobian import levels
from estimator.likelihood.path.measured_force import is_force_measured
from estimator.likelihood.response.second_order import second_order_change, self_energies
from estimator.model.rig import Model
from estimator.results import Parameter
from estimator.signals.blocks import valid_blocks
from estimator.signals.moving_lines import MovingLines

from .below_band import SlowMotion
from .level import ExcitationLevel, LevelHistory
from .memory import Memory, TangentNoiseSums
from .memory_laws import HiddenStates, linear_of
from .recorder_fall import RollingRollOff
from .watch import watched_force, with_candidates

WARM_UP_S = 4.0
FAST_TIME_CONSTANT_REL = 0.25  # time constant of the watching memory over that of the long one
MIN_CHANGE_SD = 5.0  # standard deviations
SOLUTIONS_PER_CHECK = 2  # solutions, for a change
BLOCKS_PER_WATCH = 3  # blocks: every other one at most, so that no two share rows
SOLUTIONS_PER_LOOK = 8  # solutions
MIN_WATCHED_BLOCKS = 6  # blocks
MAX_ROLL_OFF_FITS = 4  # fits of the first blocks, each with the roll-off that the last one left
MAX_CENTRE_FITS = 4  # fits of the first seconds, each about the centre that the last one's lopsided laws make
MAX_NEWTON_NATS = (
    10.0  # nats: a standard deviation or so of each parameter; one Newton step from there leaves a few per cent
)


class RollingFit:
    """Balances, memories and the point of a rolling fit. `wide` is the balance with the candidates, `balance` without;
    `own` are the columns of `balance` among those of `wide`. Memories: `slow` and `fast` of `balance`, `seen` of
    `wide`."""

    def __init__(
        self, record: Record, start: LinearStart, wide: Balance, laws: int, time_constant_s: float, columns: Columns
    ) -> None:
        grid = record.grid
        if wide.common is not None:  # it depends on frequency alone
            at, reaction = start.nodes.f_hz, wide.common
            held = reaction(at)
            wide = replace(wide, common=lambda f_hz: held if f_hz is at else reaction(f_hz))
        self.start, self.wide, self.grid = start, wide, grid
        self.balance, own = restrict(wide, set(range(laws)))
        self.own = np.array(own, dtype=np.intp)
        self.columns = record.columns(self.balance, columns.widths, columns.linear)
        self.states = HiddenStates(self.columns, start.nodes.f_hz)
        self.fall = RollingRollOff(record, start, _spectral_shape(record, start))
        self.spectra = BlockSpectra(columns, self.own, grid)
        hop_s = grid.hop / record.rate_hz
        watching = max(FAST_TIME_CONSTANT_REL * time_constant_s, 10 * hop_s)
        self.own_flutter, self.wide_flutter = TangentNoiseSums(self.columns), TangentNoiseSums(columns)
        sizes = (len(own), self.own_flutter.size), (len(wide.columns), self.wide_flutter.size)
        self.slow, self.fast, self.seen = (
            Memory(float(np.exp(-hop_s / t)), np.zeros((grid.starts.size, k, k)), np.zeros((k, 4)), np.zeros(m))
            for t, (k, m) in ((time_constant_s, sizes[0]), (watching, sizes[0]), (time_constant_s, sizes[1]))
        )
        self.calm = record.calm
        self.rate_hz, self.band = record.rate_hz, record.model.band
        self.centre = SlowMotion(self.columns, record)
        self.lines = MovingLines(grid.f_hz, record.model.tacho is not None)
        self.pairs: NDArray[np.complex128] | None = None
        self.local: Local
        self.level: ExcitationLevel
        self.moves = LevelHistory(max(2, int(WARM_UP_S / hop_s)))
        self.suspicions = 0
        self.shared = 0.0  # sum of the products of the two memories' weights
        self.turn = 0  # blocks taken
        self.solved = 0
        self.settled = False
        self.missing: dict[str, float] | None = None
        self.held: dict[str, Parameter] = {}  # numbers of the first seconds

    @classmethod
    def begin(
        cls, record: Record, start: LinearStart, model: Model, time_constant_s: float, watch: tuple[str, ...]
    ) -> RollingFit:
        values: dict[str, float] = {}
        held: dict[str, Parameter] = {}
        linear = start.linear.copy()
        searched = len(build_balance(model, start.sizes).free) > len(
            build_balance(model, start.sizes, search=False).free
        )
        point: Point | None = None
        for _ in range(MAX_CENTRE_FITS):
            if searched:
                best = maximum(record, start, model)  # the shapes as the first seconds have them
                values, held = best.values, _held_parameters(best)
            own = build_balance(model, start.sizes, values, search=False)
            point = point or initial(own, start, values)
            B = own.coefficients(point.beta)
            linear[:] = linear_of(own, B)
            columns = record.columns(own, start.widths, linear)
            centre, states = SlowMotion(columns, record), HiddenStates(columns, start.nodes.f_hz)
            states.follow(B, record)
            bank = gather(record, own, start.widths, linear)
            bank.tangents[states.columns] = 0.0
            gram, blocks = bank.grams.sum(axis=0), float(bank.blocks.sum())
            colour = _spectral_shape(record, start)
            first = Evidence(own, record.grid, gram, blocks, bank.tangents, start.nodes, states.dressing, colour)
            local, _ = maximise(Likelihood(first), point)
            point = local.point
            if not centre.reach and not states.columns.size and colour is None:
                break
            start = restarted_about(start, record, first, point)
            record = centre.whole(record, own.coefficients(point.beta))
        wide = build_balance(with_candidates(model, watch), start.sizes, values, search=False)
        columns = record.columns(wide, start.widths.copy(), linear, fine=len(own.laws))
        fitted = cls(record, start, wide, len(own.laws), time_constant_s, columns)
        fitted.local, fitted.held = local, held
        fitted.level = ExcitationLevel.of_first(local.power, record.grid.per_cell, is_force_measured(own))
        return fitted

    def settle(self, record: Record) -> None:
        """The first blocks have been taken (once more, now that the force is known in which moving lines are seen)."""
        for _ in range(MAX_ROLL_OFF_FITS):
            self.local, _ = maximise(self._likelihood(self.slow, None), self.local.point)
            if not self.fall.follow(self.local, self.slow.n):
                break
        self._dress(record)
        self.settled = True

    def _dress(self, record: Record) -> None:
        """Take what dresses the laws from the last seconds."""
        B = self.balance.coefficients(self.local.point.beta)
        self.states.follow(B, record)
        record = self.centre.whole(record, B)
        mean = self.fast.tangents / self.fast.rows
        self.pairs = self_energies(record, self.columns, B, mean, self.start.nodes.f_hz, WARM_UP_S)
        moved = self.moves.follow()
        if self.settled:
            self.columns.widths *= np.sqrt(moved)  # those of `spectra` too: one array
        for memory in (self.slow, self.fast, self.seen):
            memory.apart = float(self.settled)

    def _follow_level(self, record: Callable[[], Record]) -> None:
        """Dress the laws anew where the level of the force has moved: what they fluctuate goes with the motion, and so
        does what the band leaves out."""
        if self.moves.moved():
            last = record()
            if valid_blocks(last.motion.valid, self.grid).size >= len(self.moves) // 2:
                self._dress(last)
        for memory in (self.slow, self.fast, self.seen):
            memory.dress(self.pairs)

    def forget(self) -> None:
        for memory in (self.slow, self.fast, self.seen):
            memory.forget()
        self.shared *= self.slow.keep * self.fast.keep

    def skip(self) -> None:
        """The next block does not follow on the last one."""
        self.lines.restart()
        self.spectra.restart()

    @property
    def margin(self) -> int:
        """Rows of a record that a block needs on either side of its own."""
        return MARGIN_ROWS + self.centre.reach + (0 if self.calm is None else self.calm.reach)

    def take(self, record: Record, at: int, measured: bool) -> None:
        """Add the block that begins at row `at`, its lines left out. measured : the angle is that of a tacho."""
        watches = len(self.wide.laws) > len(self.balance.laws) and self.turn % BLOCKS_PER_WATCH == 0
        B = self.balance.coefficients(self.local.point.beta)
        stretch = self.centre.stretch(record, at, at + self.grid.size, B)
        Z, tangents = self.spectra.take(stretch, watches)
        own = self.own if watches else np.arange(self.own.size)
        tangents[own[self.states.columns]] = 0.0
        speed_hz = None
        if measured:
            speed_hz = float(stretch.phase[-1] - stretch.phase[0]) / (2 * np.pi * (stretch.t[-1] - stretch.t[0]))
        weights = self.lines(Z.force(B, own), speed_hz)
        G, square = Z.gram(self.grid, weights), 1.0 if weights is None else float(np.mean(weights**2))
        rows, G_own = self.grid.size, G[:, self.own[:, None], self.own] if watches else G
        level = self.level.of(B, G_own)
        self.moves.add(level)
        if watches:
            self.seen.add(G / level, tangents, self.wide_flutter.of(stretch), rows, square, level)
            tangents = tangents[self.own]
        self.turn += 1
        motion, G = self.own_flutter.of(stretch), G_own / level
        self.slow.add(G, tangents, motion, rows, square, level)
        self.fast.add(G, tangents, motion, rows, square, level)
        self.shared += square

    def _likelihood(self, memory: Memory, beta: Array | None) -> Likelihood:
        """Of the balance's own columns. beta : where the responses are dressed; None: they are not."""
        gram, mean = self._still(memory)
        if memory is self.seen:
            gram, mean = gram[:, self.own[:, None], self.own], mean[self.own]
        nodes, dressing = self.start.nodes, self._dressing(memory, beta)
        return Likelihood(Evidence(self.balance, self.grid, gram, memory.n, mean, nodes, dressing, self.fall.colour))

    def _still(self, memory: Memory) -> tuple[Array, Array]:
        """Gram matrices and mean tangents without what the noise of displacement sensors does in the laws."""
        gram, mean = memory.gram, memory.tangents / memory.rows
        noise = self.local.point.noise
        if memory.motion.size == 0 or not noise.any():
            return gram, mean
        sums = self.wide_flutter if memory is self.seen else self.own_flutter
        still = without_noise(sums.flutter(memory.motion), noise, self.rate_hz, self.band)
        return still(gram, np.asarray(memory.n * self.grid.per_cell[:, None, None], np.float64), mean)

    def _dressing(self, memory: Memory, beta: Array | None) -> NDArray[np.complex128] | None:
        remembered = self.states.dressing
        if memory.pairs is None or beta is None:
            return remembered
        by_laws = second_order_change(
            memory.pairs, self.balance, self.balance.coefficients(beta), self.start.nodes.f_hz
        )
        return by_laws if remembered is None else by_laws + remembered

    def solve(self, record: Callable[[], Record]) -> None:
        """Renew the point from the memory, and the memory if the recent data contradict it. record : makes the last
        seconds."""
        self._follow_level(record)
        self._renew()
        if self.states.columns.size:
            self.states.follow(self.balance.coefficients(self.local.point.beta))
        if self.solved % SOLUTIONS_PER_CHECK == 0:
            self.suspicions = self.suspicions + 1 if self._changed() else 0
            if self.suspicions >= 2:
                self._replace()
        if self.solved % SOLUTIONS_PER_LOOK == 1:
            self.missing = self._look()
        self.solved += 1

    def _renew(self) -> None:
        """One Newton step from the last point, which is never far; from farther away, to the maximum."""
        point = self.local.point
        likelihood = self._likelihood(self.slow, point.beta)
        count = np.asarray(0.5 * self.slow.n * self.grid.per_cell, np.float64)
        S, noise = levels(*likelihood.power(point.beta), count, point.S, point.noise)
        local = likelihood.at(Point(point.beta, S, noise))
        step, decrement = _newton_step(local)[::2]
        p, P = point.beta.size, S.size
        beta = point.beta + step[:p]
        if decrement < MAX_NEWTON_NATS and likelihood.damping(beta).min() > 0.0:
            # S and noise are best for the old beta: along the step they fall as a parabola, half its first slope
            level = np.asarray(S * np.exp(0.5 * step[p : p + P]), np.float64)
            self.local = replace(local, point=Point(beta, level, np.maximum(noise + 0.5 * step[p + P :], 0.0)))
        else:
            self.local, _ = maximise(likelihood, point, iterations=8, tolerance=1e-3)
        self.fall.follow(local, self.slow.n)

    def _changed(self) -> bool:
        """Whether one Newton step on the recent memory leads away from the point of the long one."""
        recent = self._likelihood(self.fast, self.local.point.beta).at(self.local.point)
        step, variance, _ = _newton_step(recent)
        f, s = self.fast, self.slow
        spread = f.n2 / f.n**2 + s.n2 / s.n**2 - 2 * self.shared / (f.n * s.n)  # the memories share recent blocks
        return bool(np.any(np.abs(step) > MIN_CHANGE_SD * np.sqrt(variance * f.n * max(spread, 1e-9))))

    def _replace(self) -> None:
        """The recent memory in place of the long one; of the candidates nothing recent enough is kept."""
        self.slow.copy_from(self.fast)
        self.shared, self.suspicions = self.fast.n2, 0
        self.seen.clear()
        self.missing = None
        self.local, _ = maximise(self._likelihood(self.slow, self.local.point.beta), self.local.point, 8, 1e-3)

    def _look(self) -> dict[str, float] | None:
        """Force that candidates would explain, per cent of the rms linear bearing force; None if it is not known."""
        seen, beta = self.seen, self.local.point.beta
        if len(self.wide.laws) == len(self.balance.laws) or seen.n < MIN_WATCHED_BLOCKS:
            return None
        dressing = self._dressing(seen, beta)
        if dressing is not None:
            whole = np.zeros((dressing.shape[0], len(self.wide.columns)), complex)
            whole[:, self.own] = dressing
            dressing = whole
        gram, mean = self._still(seen)
        colour = self.fall.colour
        wide = Likelihood(Evidence(self.wide, self.grid, gram, seen.n, mean, self.start.nodes, dressing, colour))
        # blocks that share no rows vary less than the likelihood's count of them says
        redundancy = seen.n2 / seen.n / (1.0 + 2.0 * BLOCK_ENERGY_CORRELATION)
        own = self._likelihood(seen, beta)
        count = np.asarray(0.5 * seen.n * self.grid.per_cell, np.float64)
        point = Point(beta, *levels(*own.power(beta), count, self.local.point.S, self.local.point.noise))
        found = watched_force(wide, self.balance, point, redundancy)
        if found is None:
            point = maximise(own, self.local.point, iterations=4, tolerance=1e-2)[0].point
            found = watched_force(wide, self.balance, point, redundancy)
        if found is None:
            return None
        sure = {f"missing_force_percent_{name}": percent for name, percent in found.sure.items()}
        return {"missing_force_percent": found.total} | sure

    def shown(self) -> tuple[Point, Array]:
        """The point and its covariance, H^-1 for weights that forget: the score varies by n2 / n of what the Hessian
        says."""
        covariance = inverse(self.local) * (self.slow.n2 / self.slow.n)
        return self.level.shown(self.local.point, covariance, self.slow, self.fast)


def _spectral_shape(record: Record, start: LinearStart) -> Array | None:
    """(nodes, places) shape of S that the model gives, each the mean of the bins that a node stands for; None: flat."""
    by_bin, weight = excitation_shapes(record.model, record.model.places, record.grid.f_hz).T, start.nodes.weight
    if (by_bin == 1.0).all():
        return None
    first = np.concatenate([[0], np.cumsum(weight)[:-1]]).astype(np.intp)
    return np.asarray(np.add.reduceat(by_bin, first, axis=0) / weight[:, None])


def _held_parameters(best: Maximum) -> dict[str, Parameter]:
    """The searched numbers by name."""
    spread = np.sqrt(np.diag(inverse(best.local)))
    return {
        f.name: Parameter(best.values[f.name], float(spread[j]), f.unit, True, "held at what the first seconds gave")
        for j, f in enumerate(best.balance.free)
        if f.searched
    }


def _newton_step(local: Local) -> tuple[Array, Array, float]:
    """Newton step and variances (p + 2 P,) as in `Local`, zero for what the data leave free; decrement in nats."""
    V, used = inverse(local), active(local.point)
    used = used[np.isfinite(np.diag(V)[used])]
    V, g = V[np.ix_(used, used)], local.gradient[used]
    step, variance = np.zeros(local.gradient.size), np.zeros(local.gradient.size)
    step[used], variance[used] = -V @ g, np.diag(V)
    return step, variance, -float(g @ step[used])
