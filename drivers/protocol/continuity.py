"""Puts frames on one absolute sample index: every sample is in exactly one Block or one Gap.

The counter of a frame says where it belongs modulo its wrap; the device clock (or, without one, the host's) says how
many wraps went by, and whether to believe the counter. Late frames are dropped and reported, because their
place was declared a gap: the axis never moves backwards.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.contract.notices import Notices
from drivers.contract.reading import Block, Gap, LinkStats, Reading

from .neighbours import Neighbours, follows
from .protocol import SampleFrames
from .starts import Starts

# reasons of a gap; the first that applies is used
_CAUSES_BY_PRIORITY = ("reconnect", "stuck", "silent", "version", "crc", "overflow")
FAR_S = 86_400.0  # a device clock this far ahead of the host's belongs to another start
AHEAD_S, AHEAD_SHARE = 5.0, 0.2  # so do counter and clock this far ahead of the host's clock, and by this share
SLACK_S, SLACK_SHARE = 2e-4, 0.25  # of a stamp; of a frame
LATE_FRAMES = 64  # a frame this far behind is late; further behind, the device has started again


@dataclass(slots=True, kw_only=True)
class _Anchor:
    """The last frame that was accepted."""

    position: int
    rows: int
    index: int  # absolute, of its row 0
    time_us: int | None  # device clock, unwrapped
    t_host_ns: int
    epoch: int
    lost: int


class Continuity:
    """Sample index of one device, for all links. `cause(reason)` : why samples may be missing before the next frame."""

    def __init__(self, stats: LinkStats, notices: Notices, starts: Starts | None = None) -> None:
        self.rate_hz = 1.0
        self.index = 0  # absolute index of the next sample
        self._stats = stats
        self._notices = notices
        self._starts = starts or Starts()
        self._anchor: _Anchor | None = None
        self._last_counts: NDArray[np.int32] | None = None
        self._causes: set[str] = set()
        self._stood = 0.0  # samples of a pause before frames without a time whose counter continues
        self._late_s = 0.0  # delay of the last frames against the promptest of this start
        self._holes: deque[tuple[int, int]] = deque(maxlen=64)
        self._neighbours = Neighbours()
        self._checked = True  # frames have check sums

    def describe(self, rate_hz: float) -> None:
        """Take the rate of a new description: later frames do not continue the earlier ones."""
        self.rate_hz = rate_hz
        if self._anchor is not None:
            self._anchor.epoch = -1

    def cause(self, reason: str) -> None:
        if reason == "reconnect":
            self._neighbours = Neighbours()
        if self._anchor is not None:
            self._causes.add(reason)

    def begin(self, position: int, epoch: int, time_us: int, t_host_ns: int) -> None:
        """The axis starts at this position, though its samples may not be readable (classic CAN)."""
        if self._anchor is None:
            self._anchor = _Anchor(
                position=position, rows=0, index=0, time_us=time_us, t_host_ns=t_host_ns, epoch=epoch, lost=0
            )

    def feed_unchecked(self, frames: SampleFrames, t_host_ns: int) -> list[Reading]:
        """Readings of a link without check sums: a frame that contradicts its neighbours is dropped, by reason crc."""
        self._checked = False
        out: list[Reading] = []
        for k, piece in enumerate(self._neighbours.plausible(frames, self.rate_hz)):
            if k:
                self._stats.crc_errors += 1
                self.cause("crc")
                text = "frames whose counter or clock contradicts their neighbours': dropped"
                self._notices.add(t_host_ns, "warning", "crc", text)
            out += self.feed(piece, t_host_ns)
        return out

    def feed(self, frames: SampleFrames, t_host_ns: int) -> list[Reading]:
        """Blocks and gaps of these frames; t_host_ns is when their last byte was read."""
        n = len(frames)
        if n == 0:
            return []
        slack_us = self._slack(frames.counts.shape[1]) * 1e6 / self.rate_hz
        good = follows(frames, self.rate_hz, slack_us=slack_us) & (frames.lost[1:] == frames.lost[:-1])
        out: list[Reading] = []
        starts = [0, *(np.flatnonzero(~good) + 1).tolist(), n]
        for start, stop in zip(starts[:-1], starts[1:], strict=True):
            self._run(frames, start, stop, t_host_ns, out)
        return out

    def _slack(self, rows: int) -> float:
        """Samples by which a device's stamps may be off, beyond half a frame; less than lets a lost frame pass."""
        return min(SLACK_S * self.rate_hz, SLACK_SHARE * rows)

    def lose(self, count: int, reason: str, out: list[Reading]) -> None:
        """Declare the next `count` samples missing."""
        if count <= 0:
            return
        out.append(Gap(self.index, count, reason))
        self._holes.append((self.index, self.index + count))
        self.index += count
        self._stats.lost_samples += count

    def _run(self, f: SampleFrames, start: int, stop: int, t_host_ns: int, out: list[Reading]) -> None:
        """Consecutive frames start:stop of one batch."""
        rows, last, restarts = f.counts.shape[1], self._anchor, self._stats.restarts
        time_us = None if f.time_us is None else int(f.time_us[start])
        if not self._starts.readable(int(f.epoch[start]), t_host_ns):
            self._undescribed(stop - start, t_host_ns)
            return
        if last is not None:
            if int(f.epoch[start]) != last.epoch:
                self._restart("another start number or description", (stop - start) * rows, t_host_ns, out)
            else:
                time_us = self._unwrap(last, time_us, f.time_modulus, t_host_ns)
                behind = self._join(last, f, start, stop, time_us, t_host_ns, out)
                if behind:
                    if start + behind < stop:
                        self._run(f, start + behind, stop, t_host_ns, out)
                    return
        same_start = self._stats.restarts == restarts
        final_us = time_us
        if time_us is not None and f.time_us is not None:
            final_us = time_us + int(f.time_us[stop - 1] - f.time_us[start]) % f.time_modulus
        elif (
            last is not None and last.time_us is not None
            and self.index - last.index < f.modulus and same_start
        ):  # fmt: skip
            ahead = self.index + (stop - start - 1) * rows - last.index
            final_us = last.time_us + round(
                ahead * 1e6 / self.rate_hz
            )  # until a frame with a time shows how many wraps passed
        if last is not None and last.time_us is not None and final_us is not None and same_start:
            passed_s = (t_host_ns - last.t_host_ns) / 1e9 - (final_us - last.time_us) / 1e6
            self._late_s = max(0.0, self._late_s + passed_s)
        counts = f.counts[start:stop].reshape(-1, f.counts.shape[2])
        self._starts.taken()
        out.append(Block(self.index, counts, t_host_ns, None if time_us is None else time_us * 1000))
        self.index += len(counts)
        self._causes &= {"overflow"}  # the queue that overflowed still held good frames: its gap comes later
        self._last_counts = f.counts[stop - 1]
        self._anchor = _Anchor(
            position=int(f.position[stop - 1]), rows=rows, index=self.index - rows, time_us=final_us,
            t_host_ns=t_host_ns,
            epoch=int(f.epoch[stop - 1]), lost=int(f.lost[stop - 1]),
        )  # fmt: skip

    @staticmethod
    def _unwrap(last: _Anchor, time_us: int | None, modulus: int, t_host_ns: int) -> int | None:
        """Device time nearest to the last one, moved on by whole wraps as the host's clock says."""
        if time_us is None or last.time_us is None:
            return time_us
        step = (time_us - last.time_us + modulus // 2) % modulus - modulus // 2
        step += modulus * round(((t_host_ns - last.t_host_ns) / 1e3 - step) / modulus)
        return last.time_us + step

    def _join(
        self, last: _Anchor, f: SampleFrames, start: int, stop: int, time_us: int | None, t_host_ns: int,
        out: list[Reading],
    ) -> int:  # fmt: skip
        """Account for the samples between the last frame and this run. Returns the number of its frames to drop."""
        rows = f.counts.shape[1]
        already = self.index - last.index - last.rows  # declared missing since, while the counter stood still
        ahead = (int(f.position[start]) - last.position) % f.modulus
        host, stood = (t_host_ns - last.t_host_ns) * self.rate_hz / 1e9, 0.0
        timed = time_us is not None and last.time_us is not None
        elapsed = (time_us - last.time_us) * self.rate_hz / 1e6 if timed else host  # type: ignore[operator]
        total = ahead + f.modulus * round((elapsed - ahead) / f.modulus)
        if not timed and f.modulus - ahead <= LATE_FRAMES * rows and host < 0.5 * f.modulus:
            total = ahead - f.modulus  # a little behind, and no time for a whole wrap
        elif not timed and (total < 0 or (ahead == last.rows and "reconnect" not in self._causes)):
            total = ahead  # either the host paused or the device did: a later frame with a time shows which
            self._stood += host - ahead if host - ahead > 0.5 * self.rate_hz else 0.0
        elif timed:
            stood, self._stood = self._stood, 0.0
        moved = timed and elapsed > 0.5 * rows
        if total == 0 and (moved or self._changed(f, start)):
            passed = rows * round(elapsed / rows) + rows - last.rows - already
            self._stuck(passed if moved else rows, t_host_ns, out)
            return 1
        if total < last.rows and total > -LATE_FRAMES * rows:
            return self._late(last, total, f, start, stop, t_host_ns)
        slack = 0.5 * rows + self._slack(rows) + min(1e-4 * abs(elapsed), f.modulus / 64)
        # without this test, a wrong clock would declare a gap of samples that never existed
        claimed, most_s = elapsed if timed else total, FAR_S if ahead == last.rows else AHEAD_S
        far = claimed - (1.0 + AHEAD_SHARE) * max(host, 0.0) > (most_s + self._late_s) * self.rate_hz
        if far and timed and total > 0 and claimed - host < FAR_S * self.rate_hz and self._goes_on(last):
            far = abs(total - elapsed) > slack  # the host was behind: the samples in between are lost
        if total < 0 or far or (timed and elapsed < -slack):
            if not self._starts.began(t_host_ns):
                return self._undescribed(stop - start, t_host_ns)
            way = f"on by {(claimed - host) / self.rate_hz:.3g} s that did not pass here" if far else "back"
            self._restart(f"its counter and clock went {way}", (stop - start) * rows, t_host_ns, out)
        elif not timed or abs(total - elapsed) <= slack:
            self._missing(total - last.rows - already, last, f, start, out)
        elif ahead == last.rows and abs(host + stood - elapsed) > 0.25 * elapsed + 0.5 * self.rate_hz and not already:
            self._notices.add(t_host_ns, "warning", "device_clock_jump",
                              f"the device clock jumped by {(elapsed - ahead) / self.rate_hz:.3g} s")  # fmt: skip
        else:
            if ahead == last.rows and not already:
                self._causes.add("silent")  # it sampled nothing for a while and counted on
                text = f"the device did not sample for {(elapsed - ahead) / self.rate_hz:.3g} s, according to its clock"
                self._notices.add(t_host_ns, "warning", "paused", text)
            else:
                self._causes = {"stuck"}
                self._notices.add(t_host_ns, "error", "counter_jump",
                                  "the device's counter disagrees with its clock: the clock is used")  # fmt: skip
            passed = rows * round(elapsed / rows)  # whole frames, as the device counts
            self._missing(passed - last.rows - already, last, f, start, out)
        return 0

    def _goes_on(self, last: _Anchor) -> bool:
        """Whether the device describes itself after a reconnect as the same device in the same start."""
        return self._checked and last.epoch > 0 and "reconnect" in self._causes and self._starts.recognised

    def _undescribed(self, frames: int, t_host_ns: int) -> int:
        """Drop frames after a restart or of another device until its records describe them. Returns their number."""
        text = "frames after a restart that the device has not described yet: dropped until it does"
        self._notices.add(t_host_ns, "warning", "undescribed", text)
        self._stats.count("undescribed_frames", frames)
        return frames

    def _stuck(self, count: int, t_host_ns: int, out: list[Reading]) -> None:
        """Declare samples missing whose counter stands still: they have no place, but their time has passed."""
        self._notices.add(t_host_ns, "error", "stuck_counter", "the device repeats one counter value: dropped")
        self._stats.count("stuck_frames")
        self.lose(count, "stuck", out)

    def _changed(self, f: SampleFrames, start: int) -> bool:
        """Whether a frame with the counter of the last frame carries other samples."""
        return self._last_counts is not None and not np.array_equal(self._last_counts, f.counts[start])

    def _late(self, last: _Anchor, total: int, f: SampleFrames, start: int, stop: int, t_host_ns: int) -> int:
        """Report the frames of this run that lie behind the axis. Returns how many are to be dropped."""
        rows = f.counts.shape[1]
        behind: int = min(stop - start, -(-(last.rows - total) // rows))
        first = last.index + total
        if any(low <= first < high for low, high in self._holes):
            self._stats.count("reordered", behind)
            self._notices.add(t_host_ns, "warning", "reordered", "frames came after their gap was declared: dropped")
        else:
            self._stats.duplicates += behind
            self._notices.add(t_host_ns, "warning", "duplicate", "frames came twice: dropped")
        return behind

    def _missing(self, count: int, last: _Anchor, f: SampleFrames, start: int, out: list[Reading]) -> None:
        by_device = min(max(count, 0), (int(f.lost[start]) - last.lost) % 256 * f.counts.shape[1])
        self.lose(by_device, "device_lost", out)
        if count > by_device:
            cause = next((each for each in _CAUSES_BY_PRIORITY if each in self._causes), "sequence")
            self.lose(count - by_device, cause, out)
            self._causes.clear()

    def _restart(self, why: str, arrived: int, t_host_ns: int, out: list[Reading]) -> None:
        """Account for a restart of the device. The host's clock gives the time of its absence."""
        last = self._anchor
        host = 0 if last is None else round((t_host_ns - last.t_host_ns) * self.rate_hz / 1e9)
        already = 0 if last is None else self.index - last.index - last.rows
        self._stats.restarts += 1
        self._stood = self._late_s = 0.0
        self._notices.add(t_host_ns, "warning", "device_restart", f"the device started again: {why}")
        self.lose(max(1, host - arrived - already), "restart", out)
