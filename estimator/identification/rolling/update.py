"""The memories of a rolling fit, and the renewal of its working point from them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.errors import NotFiniteError
from estimator.likelihood.motion.force_balance import Balance, build_balance, restrict
from estimator.likelihood.motion.known_spectra import excitation_shapes
from estimator.likelihood.motion.law_columns import Columns
from estimator.likelihood.motion.law_smoothing import MARGIN_ROWS
from estimator.likelihood.motion.stream_record import Record, gather
from estimator.likelihood.motion.streaming_spectra import BlockSpectra
from estimator.likelihood.path.gram_likelihood import Evidence, Likelihood, Local, Point, active, inverse, maximise
from estimator.likelihood.path.jacobian import is_force_measured, levels
from estimator.likelihood.response.second_order import second_order_change, self_energies, without_noise
from estimator.model.rig import Model
from estimator.results import Parameter
from estimator.signals.blocks import valid_blocks
from estimator.signals.moving_lines import MovingLines

from .level import ExcitationLevel, LevelHistory
from .memory import Memory, TangentNoiseSums
from .memory_laws import HiddenStates, linear_of
from .report import BLOCK_ENERGY_CORRELATION
from .start import RollingStart
from .watch import watched_force, with_candidates

WARM_UP_S = 4.0  # of samples, at least, before the first fit
FAST_TIME_CONSTANT_REL = 0.25  # time constant of the fast memory over that of the slow one
MIN_CHANGE_SD = 5.0  # between the two memories, of a parameter that has changed
SOLUTIONS_PER_CHECK = 2  # check for a change
BLOCKS_PER_WATCH = 3  # of the memory with the candidates: two at least, so that no two blocks share rows
SOLUTIONS_PER_LOOK = 8  # look for missing force
MIN_WATCHED_BLOCKS = 6  # of the memory with the candidates
MAX_FIRST_FITS = 4  # of the first seconds, each about the linear values of the one before
MAX_NEWTON_NATS = 10.0  # about one standard deviation of each parameter: one Newton step leaves a few per cent of it


class RollingFit:
    """Balances, memories and the working point of a rolling fit.

    balance : force balance of the model. wide : the same with the candidates. own : columns of `balance` in `wide`.
    slow, fast : memories of `balance`. watched : memory of `wide`.
    """

    def __init__(
        self, record: Record, start: RollingStart, wide: Balance, *, laws: int, time_constant_s: float, columns: Columns
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
        self.colour = _spectral_shape(record, start)
        self.spectra = BlockSpectra(columns, self.own, grid)
        hop_s = grid.hop / record.rate_hz
        watching = max(FAST_TIME_CONSTANT_REL * time_constant_s, 10 * hop_s)
        self.own_tangent_noise, self.wide_tangent_noise = TangentNoiseSums(self.columns), TangentNoiseSums(columns)
        sizes = (len(own), self.own_tangent_noise.size), (len(wide.columns), self.wide_tangent_noise.size)
        self.slow, self.fast, self.watched = (
            Memory(float(np.exp(-hop_s / t)), np.zeros((grid.starts.size, k, k)), np.zeros((k, 4)), np.zeros(m))
            for t, (k, m) in ((time_constant_s, sizes[0]), (watching, sizes[0]), (time_constant_s, sizes[1]))
        )
        self.calm = record.calm
        self.rate_hz, self.band = record.rate_hz, record.model.band
        self.lines = MovingLines(grid.f_hz, record.model.tacho is not None)
        self.self_energies: NDArray[np.complex128] | None = None
        self.local: Local
        self.level: ExcitationLevel
        self.level_history = LevelHistory(max(2, int(WARM_UP_S / hop_s)))
        self.changes_in_a_row = 0
        self.shared = 0.0  # sum of the products of the weights of `slow` and `fast`
        self.blocks_taken = 0
        self.solutions = 0
        self.settled = False
        self.missing: dict[str, float] | None = None
        self.held: dict[str, Parameter] = {}  # nonlinear parameters, held at the values of the first seconds

    @classmethod
    def begin(
        cls, record: Record, start: RollingStart, model: Model, time_constant_s: float, watch: tuple[str, ...]
    ) -> RollingFit:
        """The rolling fit of the first seconds. watch : names of the candidate effects. Raises DataError."""
        linear, own = start.linear.copy(), build_balance(model, start.sizes, start.values, search=False)
        point = start.point(own)
        for _ in range(MAX_FIRST_FITS):
            B = own.coefficients(point.beta)
            linear[:] = linear_of(own, B)
            states = HiddenStates(record.columns(own, start.widths, linear), start.nodes.f_hz)
            states.follow(B, record)
            gram, blocks, tangents = gather(record, own, start.widths, linear)
            tangents[states.columns] = 0.0
            colour = _spectral_shape(record, start)
            first = Evidence(
                balance=own,
                grid=record.grid,
                gram=gram,
                blocks=blocks,
                tangents=tangents,
                nodes=start.nodes,
                dressing=states.dressing,
                colour=colour,
            )
            local, _ = maximise(Likelihood(first), point)
            point = local.point
            if not states.columns.size and colour is None:
                break
            start = start.renewed(record, own, tangents, point)
        wide = build_balance(with_candidates(model, watch), start.sizes, start.values, search=False)
        columns = record.columns(wide, start.widths.copy(), linear, fine=len(own.laws))
        fitted = cls(record, start, wide, laws=len(own.laws), time_constant_s=time_constant_s, columns=columns)
        fitted.local, fitted.held = local, dict(start.held)
        fitted.level = ExcitationLevel.of_first(local.power, record.grid.per_cell, is_force_measured(own))
        return fitted

    def settle(self, record: Record) -> None:
        """Fit the memory of the first blocks, once all of them have been taken. record : the last seconds."""
        self.local, _ = maximise(self._likelihood(self.slow, None), self.local.point)
        self._renew_corrections(record)
        self.settled = True

    def _renew_corrections(self, record: Record) -> None:
        """Renew the second-order correction of the laws from a record of the last seconds."""
        B = self.balance.coefficients(self.local.point.beta)
        self.states.follow(B, record)
        mean = self.fast.tangents / self.fast.rows
        self.self_energies = self_energies(record, self.columns, B, mean, self.start.nodes.f_hz, WARM_UP_S)
        level_ratio = self.level_history.renew()
        if self.settled:
            self.columns.widths *= np.sqrt(level_ratio)  # those of `spectra` too: one array
        for memory in (self.slow, self.fast, self.watched):
            memory.stale_share = float(self.settled)

    def _follow_level(self, record: Callable[[], Record]) -> None:
        """Renew the second-order correction where the level of the excitation has changed. record : makes the record of
        the last seconds."""
        if self.level_history.has_changed():
            last = record()
            if valid_blocks(last.motion.valid, self.grid).size >= len(self.level_history) // 2:
                with suppress(NotFiniteError):  # as it was, while a law is not finite in the last seconds
                    self._renew_corrections(last)
        for memory in (self.slow, self.fast, self.watched):
            memory.take_self_energies(self.self_energies)

    def forget(self) -> None:
        """Let all memories decay by one block."""
        for memory in (self.slow, self.fast, self.watched):
            memory.forget()
        self.shared *= self.slow.keep * self.fast.keep

    def skip(self) -> None:
        """Leave a block out, so that the next one does not follow on the last one."""
        self.lines.restart()
        self.spectra.restart()

    @property
    def margin(self) -> int:
        """Rows of a record that a block needs on either side of its own."""
        return MARGIN_ROWS + (0 if self.calm is None else self.calm.reach)

    def take(self, record: Record, at: int, measured: bool) -> None:
        """Add the block that begins at row `at`, without its moving lines. measured : whether a tacho gives the angle.

        Raises NotFiniteError, before any memory has changed.
        """
        watches = len(self.wide.laws) > len(self.balance.laws) and self.blocks_taken % BLOCKS_PER_WATCH == 0
        B = self.balance.coefficients(self.local.point.beta)
        stretch = record.stretch(at, at + self.grid.size)
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
        self.level_history.add(level)
        if watches:
            self.watched.add(G / level, tangents, self.wide_tangent_noise.of_block(stretch), rows, square, level)
            tangents = tangents[self.own]
        self.blocks_taken += 1
        motion, G = self.own_tangent_noise.of_block(stretch), G_own / level
        self.slow.add(G, tangents, motion, rows, square, level)
        self.fast.add(G, tangents, motion, rows, square, level)
        self.shared += square

    def _likelihood(self, memory: Memory, beta: Array | None) -> Likelihood:
        """Likelihood of `balance` on a memory. beta : parameters of the second-order correction; None: without it."""
        gram, mean = self._without_tangent_noise(memory)
        if memory is self.watched:
            gram, mean = gram[:, self.own[:, None], self.own], mean[self.own]
        return self._likelihood_of(self.balance, memory, gram, mean, self._correction(memory, beta))

    def _likelihood_of(
        self, balance: Balance, memory: Memory, gram: Array, mean: Array, correction: NDArray[np.complex128] | None
    ) -> Likelihood:
        """Likelihood of a balance. gram, mean : Gram matrices and mean tangents of its columns, of a memory."""
        return Likelihood(
            Evidence(
                balance=balance,
                grid=self.grid,
                gram=gram,
                blocks=memory.n,
                tangents=mean,
                nodes=self.start.nodes,
                dressing=correction,
                colour=self.colour,
            )
        )

    def _without_tangent_noise(self, memory: Memory) -> tuple[Array, Array]:
        """Gram matrices and mean tangents of a memory without the tangent noise of displacement sensors."""
        gram, mean = memory.gram, memory.tangents / memory.rows
        noise = self.local.point.noise
        if memory.motion.size == 0 or not noise.any():
            return gram, mean
        sums = self.wide_tangent_noise if memory is self.watched else self.own_tangent_noise
        still = without_noise(sums.tangent_noise(memory.motion), noise, self.rate_hz, self.band)
        return still(gram, np.asarray(memory.n * self.grid.per_cell[:, None, None], np.float64), mean)

    def _correction(self, memory: Memory, beta: Array | None) -> NDArray[np.complex128] | None:
        """(nodes, columns) correction of the mean responses by second order and by forces with memory; None: none."""
        remembered = self.states.dressing
        if memory.self_energies is None or beta is None:
            return remembered
        by_laws = second_order_change(
            memory.self_energies, self.balance, self.balance.coefficients(beta), self.start.nodes.f_hz
        )
        return by_laws if remembered is None else by_laws + remembered

    def solve(self, record: Callable[[], Record]) -> None:
        """Renew the point from the slow memory, and that memory if the recent data contradict it. record : makes the
        record of the last seconds."""
        self._follow_level(record)
        self._renew()
        if self.states.columns.size:
            self.states.follow(self.balance.coefficients(self.local.point.beta))
        if self.solutions % SOLUTIONS_PER_CHECK == 0:
            self.changes_in_a_row = self.changes_in_a_row + 1 if self._changed() else 0
            if self.changes_in_a_row >= 2:
                self._replace()
        if self.solutions % SOLUTIONS_PER_LOOK == 1:
            self.missing = self._missing_force()
        self.solutions += 1

    def _renew(self) -> None:
        """Renew the point by one Newton step on the slow memory, or by a full maximisation if the step is long."""
        point = self.local.point
        likelihood = self._likelihood(self.slow, point.beta)
        count = np.asarray(0.5 * self.slow.n * self.grid.per_cell, np.float64)
        S, noise = levels(*likelihood.power(point.beta), count, point.S, point.noise)
        local = likelihood.at(Point(point.beta, S, noise))
        step, decrement = _newton_step(local)[::2]
        p, P = point.beta.size, S.size
        beta = point.beta + step[:p]
        if decrement < MAX_NEWTON_NATS and likelihood.damping(beta).min() > 0.0:
            # S and noise fit the old beta; along the step they fall as a parabola, by half the first slope
            level = np.asarray(S * np.exp(0.5 * step[p : p + P]), np.float64)
            self.local = replace(local, point=Point(beta, level, np.maximum(noise + 0.5 * step[p + P :], 0.0)))
        else:
            self.local, _ = maximise(likelihood, point, iterations=8, tolerance=1e-3)

    def _changed(self) -> bool:
        """Whether one Newton step on the fast memory leads away from the point of the slow one."""
        recent = self._likelihood(self.fast, self.local.point.beta).at(self.local.point)
        step, variance, _ = _newton_step(recent)
        f, s = self.fast, self.slow
        spread = f.n2 / f.n**2 + s.n2 / s.n**2 - 2 * self.shared / (f.n * s.n)  # the memories share recent blocks
        return bool(np.any(np.abs(step) > MIN_CHANGE_SD * np.sqrt(variance * f.n * max(spread, 1e-9))))

    def _replace(self) -> None:
        """Replace the slow memory by the fast one, and clear that of the candidates, which has no recent one."""
        self.slow.copy_from(self.fast)
        self.shared, self.changes_in_a_row = self.fast.n2, 0
        self.watched.clear()
        self.missing = None
        self.local, _ = maximise(self._likelihood(self.slow, self.local.point.beta), self.local.point, 8, 1e-3)

    def _missing_force(self) -> dict[str, float] | None:
        """The `extra` of an estimate: force that candidates would explain, per cent of the rms linear bearing force;
        None if it is not known."""
        watched, beta = self.watched, self.local.point.beta
        if len(self.wide.laws) == len(self.balance.laws) or watched.n < MIN_WATCHED_BLOCKS:
            return None
        correction = self._correction(watched, beta)
        if correction is not None:
            of_own, correction = correction, np.zeros((correction.shape[0], len(self.wide.columns)), complex)
            correction[:, self.own] = of_own
        wide = self._likelihood_of(self.wide, watched, *self._without_tangent_noise(watched), correction)
        # blocks that share no rows carry more information each than the likelihood counts
        redundancy = watched.n2 / watched.n / (1.0 + 2.0 * BLOCK_ENERGY_CORRELATION)
        own = self._likelihood(watched, beta)
        count = np.asarray(0.5 * watched.n * self.grid.per_cell, np.float64)
        point = Point(beta, *levels(*own.power(beta), count, self.local.point.S, self.local.point.noise))
        found = watched_force(wide, self.balance, point, redundancy)
        if found is None:
            point = maximise(own, self.local.point, iterations=4, tolerance=1e-2)[0].point
            found = watched_force(wide, self.balance, point, redundancy)
        if found is None:
            return None
        certain = {f"missing_force_percent_{name}": percent for name, percent in found.certain.items()}
        return {"missing_force_percent": found.total} | certain

    def shown(self) -> tuple[Point, Array]:
        """The point and its covariance: H^-1 n2 / n for weights that decay. S is that of the fast memory."""
        covariance = inverse(self.local) * (self.slow.n2 / self.slow.n)
        return self.level.shown(self.local.point, covariance, self.slow, self.fast)


def _spectral_shape(record: Record, start: RollingStart) -> Array | None:
    """(nodes, places) spectral shape of S in the model, each the mean of the bins of a node; None: flat."""
    by_bin, weight = excitation_shapes(record.model, record.model.places, record.grid.f_hz).T, start.nodes.weight
    if (by_bin == 1.0).all():
        return None
    first = np.concatenate([[0], np.cumsum(weight)[:-1]]).astype(np.intp)
    return np.asarray(np.add.reduceat(by_bin, first, axis=0) / weight[:, None])


def _newton_step(local: Local) -> tuple[Array, Array, float]:
    """Newton step and variances (p + 2 P,), zero for what the data leave free, and the decrement in nats."""
    V, used = inverse(local), active(local.point)
    used = used[np.isfinite(np.diag(V)[used])]
    V, g = V[np.ix_(used, used)], local.gradient[used]
    step, variance = np.zeros(local.gradient.size), np.zeros(local.gradient.size)
    step[used], variance[used] = -V @ g, np.diag(V)
    return step, variance, -float(g @ step[used])
