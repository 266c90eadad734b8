"""The spectral estimator while samples arrive, with the filters, regressors, Gram matrices and likelihood of a fit.

The first seconds are fitted as a record; until that succeeds no parameter is shown. Their Gram matrices start the slow
memory, which then forgets exponentially. A fast memory detects changes: if a parameter differs between the two memories
by five standard deviations of the difference, twice in a row, the fast memory replaces the slow one. The estimate then
follows the change at once, and its interval is wider for a while.

Lines of the first seconds are left out for good, lines that come or move block by block; a tacho channel gives the
shaft angle. The candidate effects have a memory of their own, of every third block, and are scored every three seconds.
The order of all computations depends on the data alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.effects import CATALOGUE
from estimator.errors import DataError, NotFiniteError
from estimator.identification.record import spike_rows
from estimator.likelihood.motion.force_balance import force_channels, motion_channels, shaft_reaction
from estimator.likelihood.motion.harmonics import known_lines
from estimator.likelihood.motion.stream_record import Record, as_record, notches
from estimator.model.rig import Model
from estimator.results import SPIKES_KEY, Estimate
from estimator.signals.band_limit import BandLimit, BandLimitedMotion
from estimator.signals.blocks import BlockLayout, block_layout
from estimator.signals.channel_response import RESPONSE_EFFECTS, anti_alias_response, fault_response
from estimator.signals.shaft_angle import ShaftAngle

from .report import judged_parameters
from .scope import rolling_scope
from .start import first_fit, start_without_lines
from .update import WARM_UP_S, RollingFit
from .watch import DEFAULT_CANDIDATES

SHOW_EVERY_S = 0.45  # of samples, between two estimates
MIN_BLOCKS = 6  # in the slow memory, for an estimate
CATCH_UP_FACTOR = 2  # on the blocks per call, until the first blocks have been taken
MAX_STILL_RMS_REL = 1e-6  # of the usual acceleration of a place, or of the other places: it does not move


class RollingEstimator:
    """Stiffness, damping and excitation of a rig while samples arrive, by the spectral likelihood.

    Old samples are forgotten exponentially. The estimate is renewed about twice a second. It depends on the samples
    and on how they are cut into blocks, and on nothing else: equal blocks give equal bits, live and in a replay.

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
        bearing force, and ``missing_force_percent_NAME`` for each effect that is certain. An empty tuple halves the
        cost. After a spike `extra` also holds ``spikes_left_out``, the number of samples that were left out.

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
    and where the data allow none, ``parameters`` is empty and ``status`` says why.

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
        self, model: Model, rate_hz: float, time_constant_s: float, watch: tuple[str, ...] = DEFAULT_CANDIDATES
    ) -> None:
        if time_constant_s <= 0:
            raise ValueError(f"time constant {time_constant_s} s: it must be positive")
        self._scope = rolling_scope(model)
        self.model, self.rate_hz, self.time_constant_s = self._scope.model, rate_hz, time_constant_s
        self.watch = () if self._scope.lacking else watch  # no missing force of an incomplete model
        motions, forces = motion_channels(model), force_channels(model)
        self._used = [*motions, *forces.values()]
        kinds = [model.channels[c].kind for c in self._used]
        undone = anti_alias_response(model, rate_hz)
        self._filter = BandLimit(kinds, rate_hz, model.band, shaft_reaction(model), slow=True, undone=undone)
        self._grid: BlockLayout = block_layout(rate_hz, model.band, notches(model))
        self._lines = _known_line_stretches(model, self._grid)
        self._kept: list[BandLimitedMotion] = []  # what the next blocks and a new start need
        self._rows: list[Array] = []  # samples of the last seconds, for a new start
        self._shaft = ShaftAngle(model, rate_hz)
        self._seen = 0  # rows taken in
        self._next = 0  # first row of the next block
        self._since_solved = 0
        self._since_taken = False
        self._ahead: Record | None = None  # what the next blocks are cut from
        self._fitted: RollingFit | None = None
        self._retry_at = 0
        self._moves = np.zeros(0)  # (places,) rms acceleration at the start, m/s^2
        self._unshown = ""  # why a block since the last estimate was of no use: a law that is not finite
        self._spikes = 0  # samples left out
        self._fault = ""  # why the last block is of no use: a place that does not move, a law that is not finite
        gains = _sensor_gains(self.model)[self._used]
        self._gain = None if (gains == 1.0).all() else gains
        self._estimate = Estimate(0, {}, 0.0, status="warming up")
        reasons = [self._scope.lacking.get(place, "") for place in model.places]
        self._nothing = all(reasons) and bool(reasons)  # no place has an identifiable parameter
        if self._nothing:
            self._estimate = Estimate(0, {}, 0.0, status=reasons[0])

    def update(self, block: Array) -> None:
        """Take the next rows, (n, channels), SI; NaN where a sample is missing or clipped."""
        self._seen += len(block)
        if self._nothing:
            return
        self._since_solved += len(block)
        self._shaft.push(block)
        y = self._without_spikes(block[:, self._used])
        self._keep_rows(block, y)
        motion = self._filter.push(y if self._gain is None else y / self._gain)
        if motion.rows:
            self._kept.append(motion)
            self._ahead = None
        if self._fitted is not None:
            self._advance(self._fitted, 1 + len(block) // self._grid.hop)
        elif motion.rows:
            self._start()

    def _keep_rows(self, block: Array, y: Array) -> None:
        """Keep the samples of a block, (rows, channels), with those of the used channels without spikes."""
        own = np.array(block, dtype=np.float64)
        own[:, self._used] = y
        self._rows.append(own)
        while sum(map(len, self._rows[1:])) >= self._start_rows:
            self._rows.pop(0)

    @property
    def _start_rows(self) -> int:
        """Rows that a start needs."""
        return max(int(WARM_UP_S * self.rate_hz), 24 * self._grid.hop)

    def _without_spikes(self, y: Array) -> Array:
        """A block (rows, channels) with NaN in place of its spikes: one would hide the motion for a time constant."""
        for k, channel in enumerate(y.T):
            if (rows := spike_rows(channel)).size:
                y = y.copy()
                y[rows, k] = np.nan
                self._spikes += rows.size
        return y

    def snapshot(self) -> Estimate:
        """The estimate as of the last update."""
        extra = self._estimate.extra
        if self._spikes:
            extra = {**(extra or {}), SPIKES_KEY: float(self._spikes)}
        return replace(self._estimate, index=self._seen, extra=extra)

    def _show_nothing(self, status: str) -> None:
        """The estimate has no parameters, for this reason."""
        self._estimate = Estimate(self._seen, {}, 0.0, status=status)

    def _record(self, first: int = 0) -> Record:
        """The kept motion as a record, from the piece that holds row `first` on."""
        parts = [p for p in self._kept if p.start + p.rows > first]
        record = as_record(self.model, self.rate_hz, parts, self._grid)
        if self._fitted is not None:
            record = replace(record, calm=self._fitted.calm)
        if not self._shaft.measured:
            return record
        angle = self._shaft.angle(record.motion.start, record.motion.start + record.motion.rows)
        return record if angle is None else replace(record, phase=angle)

    def _start(self) -> None:
        """Fit the first seconds, once there are enough samples."""
        end = self._kept[-1].start + self._kept[-1].rows
        wanted = self._start_rows
        if end - self._kept[0].start >= wanted and end >= self._retry_at:
            self._begin()
            self._retry_at = end + wanted // 2
            if self._fitted is None:
                self._trim(end - wanted)

    def _advance(self, fitted: RollingFit, most: int) -> None:
        """Take the next blocks, at most `most`, and renew the estimate when none is left.

        The work is spread over the calls. A whole record given in one call is worked through in it.
        """
        grid, end = self._grid, self._kept[-1].start + self._kept[-1].rows
        at_once, taken = most > 1, 0
        while (
            taken < (most if fitted.settled else CATCH_UP_FACTOR * most)
            and self._next + grid.size + fitted.margin <= end
        ):
            record = self._ahead = self._ahead or self._record(self._next - fitted.margin)
            at = self._next - record.motion.start
            fitted.forget()
            self._fault = self._standing(record.motion.a[:, at : at + grid.size])
            if record.motion.valid[at : at + grid.size].all() and not self._fault:
                try:
                    fitted.take(record, at, self._shaft.measured)
                except NotFiniteError as error:
                    self._fault = self._unshown = str(error)
                    fitted.skip()
            else:
                fitted.skip()
            self._next += grid.hop
            taken += 1
        if taken:
            self._since_taken = True
        if self._since_taken and self._next + grid.size + fitted.margin > end and (at_once or not taken):
            if not fitted.settled and not (self._settle(fitted) and at_once):
                return
            self._trim(min(self._next - fitted.margin, end - self._start_rows))
            self._since_taken = False
            if self._since_solved >= SHOW_EVERY_S * self.rate_hz * 0.6:
                self._solve()

    def _standing(self, a: Array) -> str:
        """A status if a place does not move, else empty. a : (places, n) acceleration, m/s^2."""
        if not a.size:
            return ""
        rms = np.sqrt(np.einsum("cn,cn->c", a, a) / a.shape[1])
        usual = self._moves if self._moves.any() else np.full(len(a), rms.max(initial=0.0))
        still = np.flatnonzero(rms <= MAX_STILL_RMS_REL * usual)
        return (
            f"{self.model.places[still[0]]} does not move in the band: check the sensor and the band"
            if len(still)
            else ""
        )

    def _trim(self, needed: int) -> None:
        """Drop kept motion before row `needed`."""
        while len(self._kept) > 1 and self._kept[1].start <= needed:
            self._kept.pop(0)
        self._shaft.drop(self._kept[0].start)

    def _begin(self) -> None:
        """Fit the kept motion as a record, or show why that fails."""
        record = self._record()
        self._moves = np.zeros(len(record.motion.a))
        self._fault = self._standing(record.motion.a[:, record.motion.valid])
        if self._fault:
            self._show_nothing(self._fault)
            return
        try:
            model, point = first_fit(self.model, np.concatenate(self._rows), self.rate_hz, self._grid.size // 2)
            record, start = start_without_lines(record, model, point, self._lines)
            self._grid = record.grid
            self._fitted = RollingFit.begin(record, start, self.model, self.time_constant_s, self.watch)
        except (DataError, NotFiniteError) as e:
            self._show_nothing(str(e))
            return
        self._moves, self._next, self._ahead = record.rms("a"), record.motion.start, None

    def _settle(self, fitted: RollingFit) -> bool:
        """Fit the first blocks once all are taken; False if too few of them are valid, and a new start is due."""
        if fitted.slow.n < MIN_BLOCKS:
            self._fitted = None
            return False
        try:
            fitted.settle(self._record())
        except NotFiniteError as error:
            self._fitted = None
            self._show_nothing(str(error))
            return False
        self._since_solved = self._seen
        return True

    def _solve(self) -> None:
        """Renew the estimate from the memories, or show why there is none."""
        fitted = self._fitted
        if fitted is None:
            return
        self._since_solved = 0
        hop_s = self._grid.hop / self.rate_hz
        fault, self._unshown = self._fault or self._unshown, ""
        if fault:
            self._show_nothing(fault)
            return
        if fitted.slow.n < MIN_BLOCKS or fitted.slow.n * hop_s < 0.1 * min(self.time_constant_s, WARM_UP_S):
            self._show_nothing("too few valid samples of late")
            return
        try:
            fitted.solve(self._record)
        except NotFiniteError as error:
            self._show_nothing(str(error))
            return
        parameters = judged_parameters(fitted.balance, *fitted.shown(), self.model)
        samples = fitted.slow.n**2 / fitted.slow.n2 * self._grid.hop
        shown = self._scope.shown(parameters | fitted.held)
        self._estimate = Estimate(self._seen, shown, samples, -fitted.local.nll, extra=fitted.missing)


def _known_line_stretches(model: Model, grid: BlockLayout) -> tuple[tuple[float, float], ...]:
    """Stretches (f1, f2) in Hz about the lines of the model's periodic effects, strong or weak.

    Empty with a tacho, as the lines move with the speed, and where the stretches would take half of the band.
    """
    half, low, high = 3.5 * grid.rate_hz / grid.size, *model.band
    lines = [hz for hz in known_lines(model) if low - half < hz < high + half]
    if model.tacho is not None or 4 * half * len(lines) > high - low:
        return ()
    return tuple((hz - half, hz + half) for hz in sorted(lines))


def _sensor_gains(model: Model) -> Array:
    """(channels,) gain of each channel by the sensor gain errors that the model gives."""
    out = np.ones(len(model.channels))
    for use in model.effects:
        gain = use.name in RESPONSE_EFFECTS and CATALOGUE[use.name].scales_channel
        for place, settings in use.parameters.items() if gain else ():
            own = [k for k, c in enumerate(model.channels) if c.place == place and c.kind != "force"]
            out[own] *= fault_response(use.name, {name: s.value for name, s in settings.items()}, np.zeros(1))[0].real
    return out
