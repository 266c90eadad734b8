"""Places samples that carry no counter: arrival times give the index, at the device's true rate.

A frame can come late (queues, bursts) but never early. So the earliest arrivals within a short look-ahead show how
many samples have passed, and a sample is missing only if no later frame catches up. The period is measured first and
then followed, so that a clock error or drift is no loss. A loss is placed where frames are known to be damaged, else
at the first sample that shows it. Where stamps come in bursts, its place is uncertain by the length of a burst.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .first_period import LEAST_SAMPLES, first_period
from .look_ahead import earliest_ahead, earliest_until, even_ends
from .period import NOMINAL_REL, Period, off_nominal, round_rate

LOOK_AHEAD_S = 1.0  # a logger needed up to 0.7 s to catch up after a stall
MAX_LOOK_AHEAD = 4096  # samples
MAX_DRIFT_REL = 1e-3  # relative rate error that is followed from piece to piece
FOLLOWED_DRIFT_REL = 2e-4  # once it has been followed for long
EXACT_DRIFT_REL = 2e-3  # and where each stamp places its sample
UNEVEN_PARTS = 8  # of the first samples, if some were held up: the most even one shows how late frames usually are
PIECE_SAMPLES = 256  # between two points by which the period is followed; or as many as come in
PIECE_S, LEAST_PIECE_SAMPLES = 1.0, 16
MOST_PIECE_SAMPLES = 1024  # placed by one line, at most; and no more than drift by
PIECE_DRIFT_SAMPLES = 0.25
LOOK_AGAIN_RATIO = 1.05  # of held samples, between two looks: each look costs as much as there are
FLAT_SAMPLES = 0.4  # by which the earliest arrivals vary where nothing is missing
MOST_UNSURE_REL = 2e-2  # of the period
HISTORY_PIECES = 32  # over which the period is followed
MOST_LATE_SHARE = 0.25  # of the look-ahead: later frames were held up, and are waited for
CLOSE_SAMPLES = 0.35  # lateness short of a whole sample by this counts as one: no sample comes early
STEP_BACK_NS = 1_000_000
FAR_NS, LEAP_NS = 86_400_000_000_000, 1_000_000_000

F64Array = NDArray[np.float64]
I64Array = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Placed:
    """Samples that were placed. index : of each. unsure : missing samples whose place is uncertain by `within`."""

    index: I64Array
    unsure: int = 0
    within: int = 0


class TimeAxis:
    """`place` takes the times of new samples; indices of those that can be placed come out, the rest is held.

    nominal_hz : stated rate; the measured rate is used where the two differ.
    learn : samples over which the rate is measured; samples are held until then.
    """

    def __init__(self, nominal_hz: float | None, learn: int = LEAST_SAMPLES) -> None:
        self.rate_hz: float | None = None  # of the axis, once it is known
        self.trust_hints = False  # each damaged frame was a sample: no others come
        self.nominal_hz = nominal_hz
        self.measured: Period | None = None
        self.stepped_back = 0  # times the clock went back
        self.leapt = 0  # times that it leapt over days
        self._learn_samples = learn
        self._next_look = 0.0  # held samples from which on they are looked at again
        self._period_ns = 0.0
        self._held = np.empty(0, np.int64)
        self._hints = np.empty(0, np.int64)
        self._last_ns: int | None = None
        self._leaps_ns = 0  # of all leaps so far
        self._anchor_ns = 0  # the next sample, if none is missing, comes at this time
        self._rest_ns = 0.0  # and this part of a nanosecond
        self._next = 0  # its index
        self._least_unsure_rel = MAX_DRIFT_REL
        self._unsure_rel = MAX_DRIFT_REL  # of the period, so much of which is followed
        self._late = 0.0  # samples by which frames have lately been late
        self._even_late: deque[float] = deque(maxlen=HISTORY_PIECES)  # the latest of each look-ahead of late
        self._latest, self._since_even = 0.0, 0
        self._history: deque[tuple[int, float]] = deque(maxlen=HISTORY_PIECES)
        self._followed = True  # the newest of the history
        self._of_late_ns, self._of_late_rel = 0.0, 0.0  # the period over the history, and how far that may be off
        self._origin_ns = 0

    @property
    def held(self) -> int:
        return len(self._held)

    def place(self, t_ns: I64Array, final: bool = False, hints: I64Array | None = None) -> Placed:
        """Place the oldest held samples, as many as are certain; with `final`, all.

        hints : (n,) frames known to be damaged just before each sample.
        """
        t_ns = self._without_leaps(t_ns)
        self._held = np.concatenate([self._held, t_ns])
        self._hints = np.concatenate([self._hints, np.zeros(len(t_ns), np.int64) if hints is None else hints])
        if len(self._held) == 0 or (len(self._held) < self._next_look and not final):
            return Placed(np.empty(0, np.int64))
        self._next_look = LOOK_AGAIN_RATIO * len(self._held)
        if self.rate_hz is None and not self._learn(final):
            return Placed(np.empty(0, np.int64))
        times = self._held
        passed = (times - self._anchor_ns - self._rest_ns) / self._period_ns
        lag = np.asarray(passed - np.arange(len(times)), np.float64)
        known = self._known(lag, self._ahead())
        placed = self._pieces(lag if known is None else lag - known, known, final)
        sure = len(placed.index)
        self._held, self._hints = times[sure:], self._hints[sure:]
        self._next_look = LOOK_AGAIN_RATIO * len(self._held)
        return placed

    def _without_leaps(self, t_ns: I64Array) -> I64Array:
        """The times without steps back, and with each leap over days replaced by a second."""
        if len(t_ns) == 0:
            return t_ns
        steps = np.diff(t_ns, prepend=t_ns[:1] if self._last_ns is None else [self._last_ns])
        self._last_ns = int(t_ns[-1])
        self.stepped_back += int((steps < -STEP_BACK_NS).sum())
        far, back = steps > FAR_NS, steps < -FAR_NS
        if far.any() or back.any():
            self.leapt += int(far.sum())
            leaps = self._leaps_ns + np.cumsum(np.where(far, steps - LEAP_NS, np.where(back, steps, 0)))
            self._leaps_ns = int(leaps[-1])
            return np.asarray(t_ns - leaps)
        return np.asarray(t_ns - self._leaps_ns)

    def _known(self, lag: F64Array, ahead: int) -> I64Array | None:
        """(n,) samples before each that are known to be missing, so far; None if there are none.

        If a damaged frame was no sample, the frames behind it would be early, which is impossible.
        """
        if not self.trust_hints or not self._hints.any():
            return None
        for at in np.flatnonzero(self._hints).tolist():
            known = lag - np.cumsum(self._hints)
            behind, before = known[at : at + ahead], known[max(0, at - ahead) : at]
            burst = 2.0 * (self._late + 1.0)
            early = (float(before.min()) if len(before) > burst else 0.0) - float(behind.min())
            if len(behind) > burst and early > 1.0 - CLOSE_SAMPLES:
                self._hints[at] = max(0, self._hints[at] - int(early + CLOSE_SAMPLES))
        return np.asarray(np.cumsum(self._hints))

    def _pieces(self, lag: F64Array, known: I64Array | None, final: bool) -> Placed:
        n, done, base, level = len(lag), 0, 0.0, 0
        earliest = earliest_ahead(lag, self._ahead())
        low, high = float(earliest.min()), float(earliest.max())
        if known is None and low > -0.5 and high < 1.0 - CLOSE_SAMPLES and high - low < FLAT_SAMPLES:
            return self._flat(lag, earliest)
        earliest, whole, settled = self._beyond(lag, earliest, final)
        missing = np.zeros(n, np.int64)
        unsure = within = 0
        size = max(1, min(MOST_PIECE_SAMPLES, round(PIECE_DRIFT_SAMPLES / self._unsure_rel)))
        while done < n:
            stop = min(done + size, n)
            beyond = slice(done, stop + round(4.0 * (self._late + 2.0)))
            raw = np.where(settled[beyond], np.floor(earliest[beyond] - base + CLOSE_SAMPLES), level)
            found, sure = self._levels(raw, level, whole - done, n - done, final)
            certain = min(sure, stop - done)
            sure = self._apart(found[:certain], level)
            if sure == 0:
                break
            here = slice(done, done + sure)
            missing[here] = found[:sure]
            if found[sure - 1] > level:
                more, width = self._sharpen(missing, lag - base, level, here, self._hints if known is None else None)
                unsure, within = unsure + more, max(within, width)
            self._is_late(lag[here] - found[:sure] - base)
            rest = (earliest[here] - found[:sure])[settled[here]]
            if len(rest):
                base += _drift(_quantile(rest, 0.5) - base, self._unsure_rel * sure)
            done, level = done + sure, int(found[sure - 1])
            passed = done + level + (0 if known is None else int(known[done - 1]))
            self._remember(self._next + passed, passed + base)
            if done < stop and sure == certain:
                break
        index = self._next + np.arange(done) + missing[:done]
        if known is not None and done:
            index, level = index + known[:done], level + int(known[done - 1])
        self._advance(done + level, base)
        return Placed(index, unsure, within)

    def _beyond(self, lag: F64Array, earliest: F64Array, final: bool) -> tuple[F64Array, int, BoolArray]:
        """Earliest arrivals up to an even look-ahead, the number of samples with one, and which samples reached one."""
        n, ahead = len(lag), self._ahead()
        found = even_ends(lag, earliest, ahead, min(self._even_late), final)
        if found is None:
            return earliest, max(0, n - ahead + 1), np.ones(n, np.bool_)
        ends, settled = found
        return earliest_until(lag, ends), int(np.searchsorted(ends, n, side="right")), settled

    def _flat(self, lag: F64Array, earliest: F64Array) -> Placed:
        """Place all samples on one line: none is missing and the clock drifts little."""
        n = len(lag)
        last = earliest[-PIECE_SAMPLES:]
        base = _drift(_quantile(last, 0.5), self._unsure_rel * n)
        self._is_late(lag - base)
        for stop in range(MOST_PIECE_SAMPLES, n + 1, MOST_PIECE_SAMPLES):
            self._remember(self._next + stop, stop + float(earliest[stop - 1]))
        index = self._next + np.arange(n)
        self._remember(self._next + n, n + base)
        self._advance(n, base)
        return Placed(index)

    def _is_late(self, late: F64Array) -> None:
        """Follow by how many samples frames are late, and by how many in an even look-ahead."""
        ahead = self._ahead()
        self._late = max(min(_quantile(late, 0.98), MOST_LATE_SHARE * ahead), 0.9 * self._late)
        self._latest = max(self._latest, float(late.max()))
        self._since_even += len(late)
        if self._since_even >= max(ahead, PIECE_SAMPLES):
            self._even_late.append(self._latest)
            self._latest, self._since_even = 0.0, 0

    def _apart(self, found: I64Array, level: int) -> int:
        """Samples of a piece to place now. A step near the end of the piece waits for the samples behind it."""
        steps = np.flatnonzero(np.diff(found, prepend=level))
        near = steps[steps > max(0.0, len(found) - self._late - 3.0)]
        return int(near[0]) if len(near) else len(found)

    def _levels(self, raw: F64Array, level: int, whole: int, held: int, final: bool) -> tuple[I64Array, int]:
        """(n,) samples missing before each, and how many of these are certain.

        A step up counts if it exceeds the recent lateness of frames, or lasts longer than a burst. Until then the step
        waits.
        """
        n = len(raw)
        result = np.full(n, level, np.int64)
        if not (raw > level).any():
            return result, n
        raw = np.maximum.accumulate(np.maximum(raw, level))
        steps = [*np.flatnonzero(np.diff(raw, prepend=level) > 0).tolist(), n]
        late, even_late = min(self._late, *self._even_late), max(self._late, min(self._even_late))
        for start, stop in zip(steps[:-1], steps[1:], strict=True):
            if start >= whole and not final:
                return result, start  # a later frame may still catch up
            lasts = (held if stop == n else stop) - start
            if raw[start] - level > (late if start < whole else even_late) + 0.5 or lasts >= 2.0 * (late + 1.0):
                level = int(raw[start])
            elif stop == n and not final:
                return result, start
            result[start:] = level
        return result, n

    def _sharpen(
        self, missing: I64Array, lag: F64Array, level: int, here: slice, hints: I64Array | None
    ) -> tuple[int, int]:
        """Move each step to known damaged frames. Returns the samples of uncertain place, and their uncertainty.

        A step shows at the first sample without an earlier arrival behind it. The loss lies between this sample and the
        first sample that comes in time for the new level.
        """
        unsure = within = 0
        steps = np.flatnonzero(np.diff(missing[here], prepend=level)) + here.start
        for start in steps.tolist():
            before = int(missing[start - 1]) if start > here.start else level
            size = int(missing[start]) - before
            prompt = np.flatnonzero(lag[start:] < missing[start] + 1.0 - CLOSE_SAMPLES)
            stop = start + (int(prompt[0]) if len(prompt) else 0)
            if stop == start:
                continue
            end = min(stop + round(self._late) + 2, here.stop)
            after = np.flatnonzero(missing[start:end] > missing[start])
            end = start + int(after[0]) if len(after) else end
            if hints is None:
                unsure, within = unsure + size, max(within, stop - start)
                continue
            here_missing = np.minimum(np.cumsum(hints[start:end]), size)
            left = size - int(here_missing[-1])
            missing[start:end] = before + here_missing + left
            if left:
                unsure, within = unsure + left, max(within, stop - start)
        return unsure, within

    def _learn(self, final: bool) -> bool:
        """Measure the period of the first samples."""
        times = self._held
        nominal_ns = None if self.nominal_hz is None else 1e9 / self.nominal_hz
        arrivals = _with_damaged(times, self._hints) if self.trust_hints else times
        first = first_period(arrivals, nominal_ns, final, self._learn_samples)
        if first is None:
            return False
        self.measured, found = first.measured, first.used
        if nominal_ns is not None and (first.measured is None or not off_nominal(first.measured, nominal_ns)):
            self.rate_hz = self.nominal_hz
        error_rel = 0.0 if found.exact else found.error_rel
        self._least_unsure_rel = EXACT_DRIFT_REL if found.exact else FOLLOWED_DRIFT_REL
        self._unsure_rel = max(EXACT_DRIFT_REL if found.exact else MAX_DRIFT_REL, min(2.0 * error_rel, MOST_UNSURE_REL))
        self._period_ns = found.ns
        self.rate_hz = self.rate_hz or round_rate(found.rate_hz, found.error_rel)
        self._anchor_ns = self._origin_ns = int(times[0])
        ahead = self._ahead()
        some = times[: 4 * ahead]
        lag = np.asarray((some - times[0]) / self._period_ns - np.arange(len(some)), np.float64)
        late: F64Array = lag - earliest_ahead(lag, ahead)
        self._late = max(0.0, _quantile(late, 0.9))
        parts = np.array_split(late, 1 if first.even else UNEVEN_PARTS)
        self._even_late.append(min(float(part.max()) for part in parts if len(part)))
        number = np.arange(len(times[:ahead])) + (np.cumsum(self._hints[:ahead]) if self.trust_hints else 0)
        self._rest_ns = float((times[:ahead] - times[0] - number * self._period_ns).min())
        return True

    def _ahead(self) -> int:
        """Samples of the look-ahead."""
        return max(4, min(MAX_LOOK_AHEAD, round(LOOK_AHEAD_S * 1e9 / self._period_ns)))

    def _remember(self, index: int, passed: float) -> None:
        """Follow the period over the last pieces. index : of the next sample; passed : periods since the anchor."""
        time_ns = (self._anchor_ns - self._origin_ns) + self._rest_ns + passed * self._period_ns
        piece = min(PIECE_SAMPLES, max(LEAST_PIECE_SAMPLES, round(PIECE_S * 1e9 / self._period_ns)))
        if not self._history or index - self._history[-1][0] >= piece:
            self._history.append((index, time_ns))
            self._followed = False

    def _advance(self, samples: int, base: float) -> None:
        passed_ns = (samples + base) * self._period_ns + self._rest_ns
        whole = int(passed_ns)
        self._anchor_ns, self._rest_ns = self._anchor_ns + whole, passed_ns - whole
        self._next += samples
        half = len(self._history) // 2
        if half >= 4 and not self._followed:
            self._followed = True
            points = np.array(self._history)
            far = points[half:] - points[: len(points) - half]
            periods = far[:, 1] / far[:, 0]
            period_ns = float(np.median(periods))
            spread = 3.0 * float(np.median(np.abs(periods - period_ns))) / period_ns
            self._of_late_ns, self._of_late_rel = period_ns, spread
            if abs(period_ns / self._period_ns - 1.0) < 2.0 * self._unsure_rel:
                self._period_ns = period_ns
                self._unsure_rel = min(self._unsure_rel, max(self._least_unsure_rel, spread))

    def drifted(self) -> float | None:
        """The recent rate if it differs from that of the axis; None if it does not, or too little is known."""
        if self.rate_hz is None or len(self._history) < HISTORY_PIECES // 2 or not self._of_late_ns:
            return None
        rate_hz = 1e9 / self._of_late_ns
        return rate_hz if abs(rate_hz / self.rate_hz - 1.0) > max(NOMINAL_REL, self._of_late_rel) else None


def _with_damaged(times: I64Array, hints: I64Array) -> I64Array:
    """Arrivals with each damaged frame added at the time of the next arrival; at most a few before each arrival."""
    few = np.minimum(hints, 8)
    return np.repeat(times, few + 1)


def _quantile(values: F64Array, share: float) -> float:
    """The value at this quantile, not interpolated; numpy's quantile takes ten times as long."""
    k = int(share * (len(values) - 1))
    return float(np.partition(values, k)[k])


def _drift(error: float, most: float) -> float:
    """How far to move the line with the device's clock, slowly."""
    if error < -0.5:  # frames cannot be early: those before were late, or the clock was set back
        return error
    return float(np.clip(error, -most, most))
