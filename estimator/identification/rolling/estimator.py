"""The spectral estimator while samples arrive: the first seconds are fitted as a record, then pieces are added.

The engine is that of a fit: the same band limit, regressors, whitening, Gram matrices and determinant. The Gram
matrices of the pieces enter two memories that forget exponentially. The estimate is the maximum on the slow memory. If
a parameter differs between the two memories by five standard deviations of the difference, twice in a row, the fast
memory replaces the slow one: the estimate then follows the change at once, with a wider interval for a while.

All work is done at fixed absolute rows: the estimate depends on the samples alone, not on how they are cut into blocks.
What an estimate need not wait for, which is the first fit, a renewal of the anchor and the look for missing force, is
done a quarter of a block later, one at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError, NotFiniteError
from estimator.identification.record import spike_rows, surely_without_spikes
from estimator.likelihood.fitting.gauss_newton import record_denoising_filter
from estimator.likelihood.motion.denoise import DenoisingFilter
from estimator.likelihood.motion.force_balance import force_channels, motion_channels, shaft_terms
from estimator.likelihood.motion.located_law import located_laws
from estimator.likelihood.motion.motion_record import MotionRecord, time_folds
from estimator.model.rig import Channel, Model
from estimator.results import BACKGROUND_KEY, SPIKES_KEY, WARM_UP_NEEDED_S_KEY, WARM_UP_S_KEY, Estimate
from estimator.signals.band_limit import BandLimit, BandLimitedMotion, half_length
from estimator.signals.channel_response import anti_alias_response, channel_response
from estimator.signals.shaft_angle import ShaftAngle

from .anchor import anchor_at
from .background import BackgroundSearch, Run, in_line
from .follower import Follower
from .piece import joined_motion, piece_record
from .report import is_coloured, judged_parameters
from .scope import rolling_scope
from .start import FirstFit, first_fit
from .thresholds import LIMITS
from .watch import DEFAULT_CANDIDATES, candidates, missing_force


class RollingEstimator:
    """Stiffness, damping and excitation of a rig while samples arrive, by the spectral likelihood.

    Old samples are forgotten exponentially. The estimate is renewed about twice a second. It depends on the samples
    and on nothing else: live and in a replay, and for any size of the blocks, it is the same to the last bit.

    Parameters
    ----------
    model : Model
        The rig. Linear values and parameters of effects may be unknown (None).
    rate_hz : float
        Sampling rate, Hz.
    time_constant_s : float
        Time after which a sample counts 1/e, s.
    watch : tuple of str
        Catalogue effects whose force is looked for in the residual force. The `extra` of an estimate then holds
        ``missing_force_percent``, the rms force that all of them together would explain in per cent of the rms linear
        bearing force, and ``missing_force_percent_NAME`` for each effect that is certain. After a spike `extra` also
        holds ``spikes_left_out``, the number of samples that were left out.

    run : callable
        How the search for structural modes is run, which takes seconds: ``run(search)`` returns a function that gives
        the result of ``search()``. By default within ``update``. The estimates do not depend on it.

    Raises
    ------
    ValueError
        The time constant is not positive.
    ModelError
        An effect of the model stands at a place where it cannot act.

    Notes
    -----
    ``update(block)`` takes the next rows, (n, channels) float64 in SI units, columns in the order of
    ``model.channels``, NaN where a sample is missing or clipped. It never raises on data, does not change the block and
    keeps no reference to it. ``snapshot()`` returns an `Estimate` and has no side effect. Before the first estimate,
    and where the data allow none, ``parameters`` is empty and ``status`` says why. During the warm-up `extra` holds
    ``warm_up_s`` and ``warm_up_needed_s``.

    Examples
    --------
    >>> from estimator import Channel, Model, RollingEstimator, Setting, simulate
    >>> cap = {"bearing1.x": {"kL": Setting(1.3e6), "c": Setting(20.0), "S": Setting(1.0e-4)}}
    >>> rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 1600.0), mass={"bearing1": 0.2}, linear=cap)
    >>> record = simulate(rig, rate_hz=4096.0, seconds=8.0, seed=1)
    >>> rolling = RollingEstimator(rig, rate_hz=4096.0, time_constant_s=3.0)
    >>> for start in range(0, len(record), 512):
    ...     rolling.update(record[start : start + 512])
    >>> stiffness = rolling.snapshot().parameters["bearing1.x.kL"]
    >>> abs(stiffness.value - 1.3e6) < 4.0 * stiffness.sd
    True
    """

    def __init__(
        self, model: Model, rate_hz: float, time_constant_s: float, watch: tuple[str, ...] = DEFAULT_CANDIDATES,
        run: Run = in_line,
    ) -> None:  # fmt: skip
        if time_constant_s <= 0:
            raise ValueError(f"time constant {time_constant_s} s: it must be positive")
        self._scope = rolling_scope(model)
        self.model, self.rate_hz, self.time_constant_s = self._scope.model, rate_hz, time_constant_s
        self._whole = model
        self.watch = () if self._scope.lacking else watch  # no missing force of an incomplete model
        self._used = [*motion_channels(model), *force_channels(model).values()]
        kinds = [model.channels[c].kind for c in self._used]
        self._filter = BandLimit(
            kinds, rate_hz, model.band, shaft_terms(model), slow=True, undone=anti_alias_response(model, rate_hz),
            dtype=np.float32,
        )  # fmt: skip
        self._gain = np.array([self._gain_of(model.channels[c]) for c in self._used])
        self._block = max(
            LIMITS.min_block_rows, 1 << int(np.ceil(np.log2(LIMITS.block_cycles * rate_hz / model.band[0])))
        )
        self._job_rows = self._block // LIMITS.jobs_per_block
        self._jobs: list[Callable[[], None]] = []  # to be done, one every so many rows
        self._piece = self._block * max(1, int(LIMITS.piece_s * rate_hz / self._block))
        self._wanted = (
            -(-max(int(LIMITS.warm_up_s * rate_hz), LIMITS.start_blocks * self._block) // self._block) * self._block
        )
        self._background = BackgroundSearch(rate_hz, len(self._used), self._block, run)
        self._background_s = 0.0  # when it was found
        self._shaft = ShaftAngle(model, rate_hz)
        self._fresh: list[Array] = []  # rows of the block that is not whole yet
        self._rows: list[Array] = []  # blocks of the last seconds, for a start
        self._kept: list[BandLimitedMotion] = []  # motion of the last seconds
        self._seen = 0  # rows taken in
        self._next = 0  # first row of the next piece of motion
        self._pieces = 0  # of motion, since the start
        self._follower: Follower | None = None
        self._denoising: DenoisingFilter | None = None
        self._margin = 0  # rows that a piece of motion needs on either side of its own
        self._first: FirstFit
        self._fault = ""  # why a piece since the last estimate was of no use
        self._retry_at = 0
        self._moves = np.zeros(0)  # (places,) rms acceleration at the start, m/s^2
        self._spikes = 0  # samples left out
        self._missing: dict[str, float] | None = None
        self._estimate: Estimate | None = None  # before the first fit
        reasons = [self._scope.lacking.get(place, "") for place in model.places]
        self._nothing = all(reasons) and bool(reasons)  # no place has an identifiable parameter
        if self._nothing:
            self._estimate = Estimate(0, {}, 0.0, status=reasons[0])

    def _gain_of(self, channel: Channel) -> float:
        """Gain of a channel by the sensor gain errors that the model gives."""
        if channel.kind == "force":
            return 1.0
        return float(channel_response(self.model, channel.place, np.zeros(1))[0].real)

    def update(self, block: Array) -> None:
        """Take the next rows, (n, channels), SI; NaN where a sample is missing or clipped."""
        taken = 0
        while taken < len(block):
            rows = min(len(block) - taken, self._job_rows - self._seen % self._job_rows)
            self._seen += rows
            if not self._nothing:
                self._fresh.append(np.array(block[taken : taken + rows], dtype=np.float64))
                if self._seen % self._block == 0:
                    self._take(np.concatenate(self._fresh))
                    self._fresh = []
                elif self._jobs and self._seen % self._job_rows == 0:
                    self._do_job()
            taken += rows

    def snapshot(self) -> Estimate:
        """The estimate as of the last update."""
        estimate = self._estimate or self._warming_up()
        extra = estimate.extra
        if self._spikes:
            extra = {**(extra or {}), SPIKES_KEY: float(self._spikes)}
        return replace(estimate, index=self._seen, extra=extra)

    def _warming_up(self) -> Estimate:
        """The estimate before the first fit: no parameters, and the progress of the samples that the fit needs."""
        needed = -(-(self._wanted + self._filter.half) // self._piece) * self._piece + self._job_rows
        seen_s, needed_s, low = self._seen / self.rate_hz, needed / self.rate_hz, self.model.band[0]
        status = f"warming up: {seen_s:.3g} of {needed_s:.3g} s"
        if self._wanted > LIMITS.warm_up_s * self.rate_hz + self._block:
            status += f"; the first fit takes {LIMITS.start_blocks} blocks of {self._block / self.rate_hz:.3g} s"
            status += f", {LIMITS.block_cycles:.0f} periods of band.low = {low:g} Hz each"
        extra = {WARM_UP_S_KEY: seen_s, WARM_UP_NEEDED_S_KEY: needed_s}
        return Estimate(self._seen, {}, 0.0, status=status, extra=extra)

    def _take(self, y: Array) -> None:
        """Take the next whole block (rows, channels), which may be changed."""
        self._shaft.push(y)
        self._leave_out_spikes(y)
        self._rows.append(y)
        motion = self._filter.push(y[:, self._used] / self._gain)
        if motion.rows:
            self._kept.append(motion)
            if self._follower is not None:
                self._advance(self._follower)
            self._trim()
        if self._follower is None and self._is_due_to_start():
            self._jobs.append(self._start)

    def _is_due_to_start(self) -> bool:
        """Whether the first seconds are complete, just after an estimate was due: the next one waits least."""
        if not self._kept or self._seen % self._piece:
            return False
        return self._end - self._kept[0].start >= self._wanted and self._end >= self._retry_at

    def _do_job(self) -> None:
        """Do the next job, for which no estimate waits."""
        try:
            self._jobs.pop(0)()
        except (NotFiniteError, np.linalg.LinAlgError) as error:
            self._show_nothing(str(error))

    def _leave_out_spikes(self, y: Array) -> None:
        """NaN in place of the spikes of a block: one would hide the motion for a time constant."""
        for k in np.compress(~surely_without_spikes(y[:, self._used]), self._used):
            if (rows := spike_rows(y[:, k])).size:
                y[rows, k] = np.nan
                self._spikes += rows.size

    def _trim(self) -> None:
        """Drop the samples and the motion that no later piece and no new start needs."""
        keep = max(self._wanted, self._background.rows) // self._block
        del self._rows[:-keep]
        needed = self._end - self._wanted
        if self._follower is not None:
            needed = min(needed, self._next - self._margin)
        while self._kept and self._kept[0].start + self._kept[0].rows <= needed:
            self._kept.pop(0)
        self._shaft.drop(self._kept[0].start)

    @property
    def _end(self) -> int:
        """Row after the last one whose motion is known."""
        return self._kept[-1].start + self._kept[-1].rows

    def _show_nothing(self, status: str) -> None:
        """The estimate has no parameters, for this reason."""
        self._estimate = Estimate(self._seen, {}, 0.0, status=status)

    def _start(self) -> None:
        """Fit the first seconds, or show why that fails."""
        end = self._end
        self._retry_at = end + self._wanted // 2
        motion = joined_motion(self._kept, self._kept[0].start, end)
        self._moves = np.zeros(len(self.model.places))
        if fault := self._standing(motion):
            self._show_nothing(fault)
            return
        try:
            rows = np.concatenate(self._rows[-(self._wanted // self._block) :])
            self._begin(first_fit(self.model, self._whole, rows, self.rate_hz, self._block))
        except (DataError, NotFiniteError, np.linalg.LinAlgError) as error:
            self._follower = None
            self._show_nothing(str(error))

    def _begin(self, first: FirstFit) -> None:
        """Follow the fit of the first seconds. Raises NotFiniteError."""
        point, data = first.point, first.point.data
        if data.measured_force:  # along a motion that the force makes likely: not as samples arrive
            data = replace(data, denoise_correction=None, denoise_sd=0.0)
        denoised = bool(point.placed) and not data.measured_force
        self._margin = half_length(self.rate_hz, self.model.band) if denoised else 0
        if data.background is not None:
            self._margin = max(
                self._margin, round(LIMITS.ringing_times * data.background.longest_ringing_s * self.rate_hz)
            )
        self._denoising = record_denoising_filter(data, point.nu, point.S) if denoised else None
        watched = located_laws(candidates(first.model, self.watch), data)
        anchor = anchor_at(data, point.kL, point.c, point.nu, point.S, point.placed, watched)
        self._first = replace(first, point=point.without_rows())
        self._follower = Follower(anchor, self.time_constant_s)
        self._moves, self._pieces, self._missing = data.rms[2], 0, None
        self._next = -(-(self._kept[0].start + self._margin) // self._piece) * self._piece
        self._jobs.clear()
        self._advance(self._follower)
        while self._jobs:
            self._do_job()

    def _advance(self, follower: Follower) -> None:
        """Take the pieces of motion that are complete, and renew the estimate."""
        first = self._next
        while self._next + self._piece + self._margin <= self._end:
            self._fault = self._take_piece(follower, self._next) or self._fault
            self._next += self._piece
        if self._next > first:
            self._renew(follower)

    def _take_piece(self, follower: Follower, first: int) -> str:
        """Take the piece of motion that begins at a row; a status if it is of no use, else empty."""
        follower.forget(self._piece / self._block)
        motion = joined_motion(self._kept, first - self._margin, first + self._piece + self._margin)
        if fault := self._standing(motion):
            return fault
        try:
            if (data := self._record(follower, motion)) is not None:
                follower.take(data, bool(self.watch) and self._pieces % LIMITS.pieces_per_watch == 0)
                self._pieces += 1
        except NotFiniteError as error:
            return str(error)
        return ""

    def _record(self, follower: Follower, motion: BandLimitedMotion) -> MotionRecord | None:
        """The valid blocks of some motion as a record; None without any, or while the tacho gives no speed."""
        phase = self._shaft.angle(motion.start, motion.start + motion.rows)
        if phase is None:
            return None
        return piece_record(follower.anchor.data, self._first.model, motion, phase, self._denoising, self._margin)

    def _standing(self, motion: BandLimitedMotion) -> str:
        """A status if a place does not move, else empty."""
        a = motion.a[: len(self._moves)]
        a = a if motion.valid.all() else a[:, motion.valid]
        if not a.size:
            return ""
        rms = np.sqrt(np.einsum("cn,cn->c", a, a) / a.shape[1])
        usual = self._moves if self._moves.any() else np.full(len(a), rms.max(initial=0.0))
        still = np.flatnonzero(rms <= LIMITS.max_still_rms_rel * usual)
        place = self.model.places[still[0]] if still.size else ""
        return f"{place} does not move in the band: check the sensor and the band" if place else ""

    def _renew(self, follower: Follower) -> None:
        """Renew the estimate, or show why there is none."""
        fault, self._fault = self._fault, ""
        n = follower.slow.n
        if fault:
            self._show_nothing(fault)
            return
        seconds = n * self._block / self.rate_hz
        if n < LIMITS.min_estimate_blocks or seconds < LIMITS.min_memory_share * min(
            self.time_constant_s, LIMITS.warm_up_s
        ):
            self._show_nothing("too few valid samples of late")
            return
        try:
            follower.solve()
            if follower.wants_anchor():
                self._jobs.append(partial(self._renew_anchor, follower))
            else:
                self._show(follower)
        except (NotFiniteError, np.linalg.LinAlgError) as error:
            self._show_nothing(str(error))
            return
        if self.watch and self._pieces % LIMITS.pieces_per_look == 1:
            self._jobs.append(partial(self._look_for_missing, follower))

    def _show(self, follower: Follower) -> None:
        """Set the estimate to the maximum on the memory."""
        shown = self._scope.shown(judged_parameters(follower, self._first))
        samples = follower.slow.n**2 / follower.slow.n2 * self._block
        likelihood = follower.fit.log_likelihood if follower.fit is not None else None
        self._estimate = Estimate(self._seen, shown, samples, likelihood, extra=self._extra())
        if self._background.is_due(self._seen, partial(is_coloured, follower)):
            self._jobs.append(self._look_for_background)

    def _extra(self) -> dict[str, float] | None:
        """The `extra` of an estimate, beside its parameters."""
        found = {BACKGROUND_KEY: self._background_s} if self._background_s else {}
        return {**(self._missing or {}), **found} or None

    def _look_for_missing(self, follower: Follower) -> None:
        """Renew the estimate of the missing force."""
        self._missing = missing_force(follower)
        if self._estimate is not None and self._estimate.parameters:
            self._estimate = replace(self._estimate, extra=self._extra())

    def _look_for_background(self) -> None:
        """Follow a fit with structural modes and the spectrum of the force, if the last samples show them surely."""
        first = self._background.step(self._seen, self._first, self._whole, self._rows)
        if first is not None:
            self._background_s = self._seen / self.rate_hz
            self._begin(first)

    def _renew_anchor(self, follower: Follower) -> None:
        """Renew the anchor from the last seconds, if they have enough whole blocks, and show the estimate."""
        block, first = self._block, self._kept[0].start + self._margin
        rows = (self._end - self._margin - first) // block * block
        motion = joined_motion(self._kept, first - self._margin, first + rows + self._margin)
        data = self._record(follower, motion)
        if data is not None and data.blocks >= LIMITS.start_blocks // 2:
            data = replace(data, fold=time_folds(data.blocks))
            follower.renew_anchor(data)
            if self._margin:
                self._denoising = record_denoising_filter(data, follower.anchor.nu, follower.anchor.S)
        self._show(follower)
