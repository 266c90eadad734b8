"""CAN frames of other makers' devices: a DBC file and a signal map -> samples on a time-derived index axis.

One frame of each mapped message makes a sample. The first frames are held until the timing of the device is known: its
true rate, which frames are of one instant, and the size of values that have no limits. A sample in which a signal is
missing or has no value is a gap.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import ERROR_FLAG, REMOTE_FLAG, CanFrames
from drivers.contract.notices import Notices
from drivers.contract.reading import Block, Gap, Info, LinkStats, Reading
from drivers.protocol.device_info import Expected
from drivers.protocol.period import off_nominal
from drivers.protocol.steady_stamps import SteadyStamps
from drivers.protocol.time_axis import TimeAxis

from .cycles import Timing
from .findings import Finding, look, nothing_matched
from .signal_plan import Field, Message, compile_plan

MAX_OPEN = 4096  # frames kept of a sample that is not complete
LEARN_FRAMES, LEARN_S = 32, 1.0  # of each message, that are held before a live device's samples are read; or
FEW_FRAMES, FEW_S = 8, 2.0  # fewer frames over a longer time
LEARN_RECORDED = 4096  # frames of a capture that are held
ALONE_SHARE = 0.99  # with so many of the frames from the device, each damaged frame counts as a sample
MOST_COUNT = 2.0**31

I64Array = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class _Frames:
    """Frames of mapped messages. which : the message of each. holes : frames known to be damaged before each."""

    frames: CanFrames
    which: I64Array
    holes: I64Array

    def pick(self, which: NDArray[np.bool_] | slice) -> _Frames:
        return _Frames(self.frames.pick(which), self.which[which], self.holes[which])

    def then(self, other: _Frames) -> _Frames:
        a, b = self.frames, other.frames
        joined = CanFrames(
            np.concatenate([a.ids, b.ids]), np.concatenate([a.lengths, b.lengths]),
            np.concatenate([a.payload, b.payload]), np.concatenate([a.t_ns, b.t_ns]),
        )  # fmt: skip
        return _Frames(joined, np.concatenate([self.which, other.which]), np.concatenate([self.holes, other.holes]))

    def __len__(self) -> int:
        return len(self.which)


class MappedDecoder:
    """Decodes frames of mapped messages to readings.

    recorded : host time of a block is the recorded time of its last frame (a capture), not the time of the read.
    findings : of the first frames; known once `learned`.
    """

    def __init__(
        self, stats: LinkStats, dbc: bytes, signals: Mapping[str, str], expected: Expected | None = None,
        *, rate_hz: float | None = None, recorded: bool = False,
    ) -> None:  # fmt: skip
        self.stats = stats
        self.notices = Notices()
        self.learned = False
        self.findings: list[Finding] = []
        self.plan = compile_plan(dbc, signals)
        self._nominal_hz = rate_hz if rate_hz is not None else expected.rate_hz if expected else None
        self._axis = TimeAxis(self._nominal_hz)
        self._recorded = recorded
        self._steady = SteadyStamps()
        self._timing = Timing.unknown()
        self._late_ns = np.zeros(len(self.plan.messages))
        self._open: _Frames | None = None
        self._counts = np.empty((0, len(self.plan.signals)), np.int32)
        self._valid = np.empty(0, np.bool_)
        self._times = np.empty(0, np.int64)
        self._row_holes = np.empty(0, np.int64)
        self._index = 0
        self._info: Info | None = None
        self._reason = "source"
        self._sources: dict[str, int] = {}
        self._seen: Counter[int] = Counter()
        self._reported: set[str] = set()
        self._pending_holes = 0
        self._unsure = self._within = 0

    def cause(self, reason: str) -> None:
        """Why samples may be missing before the next frame; each "crc" is one damaged frame."""
        if reason == "crc":
            self._pending_holes += 1
        elif self._info is not None and reason in ("reconnect", "overflow"):
            self._reason = reason

    def nothing(self) -> str:
        """Why no sample has come."""
        if self._open is not None and len(self._open) and not self.learned:
            return "too few have come to know their rate"
        if self._axis.rate_hz is None and self._axis.held:
            return "the frames come so unevenly that their rate is not known yet"
        if self._axis.held:
            return "the frames were held up and come at once; samples follow when it is clear whether any is missing"
        return nothing_matched(self.plan, dict(self._seen))

    def wanted(self, frames: CanFrames) -> NDArray[np.bool_]:
        """(n,) frames of mapped messages, whatever their page and source."""
        out = np.zeros(len(frames), np.bool_)
        plain = (frames.ids & np.uint32(ERROR_FLAG | REMOTE_FLAG)) == 0
        for message in self.plan.messages:
            out |= plain & ((frames.ids & np.uint32(message.mask)) == message.identifier)
        return out

    def feed(
        self, frames: CanFrames, t_host_ns: int, final: bool = False, holes: I64Array | None = None
    ) -> list[Reading]:
        """Readings of these frames; with `final`, also of the frames that are held.

        holes : (n + 1,) number of damaged frames before each frame, and behind the last.
        """
        self.stats.frames += len(frames)
        mine = self._mine(frames, t_host_ns, holes)
        if not self._recorded:
            mine = replace(mine, frames=replace(mine.frames, t_ns=self._steady.take(mine.frames.t_ns, t_host_ns)))
        if self._open is not None and len(mine):
            mine = self._open.then(mine)
        elif self._open is not None:
            mine = self._open
        self._open = None
        if not self.learned and not self._learn(mine, t_host_ns, final):
            self._open = mine
            return list(self.notices.take())
        self._read_rows(mine, t_host_ns, final)
        return self._place(t_host_ns, final)

    def finish(self, t_host_ns: int) -> list[Reading]:
        """Readings of the frames that are held, at the rate of the rig file if none was measured."""
        if not self.learned or (self._axis.rate_hz is None and self._nominal_hz is None):
            return list(self.notices.take())
        return self.feed(CanFrames.build([]), t_host_ns, final=True)

    # -- which frames, and what the first ones show ----------------------------------------------------------------

    def _mine(self, frames: CanFrames, t_host_ns: int, holes: I64Array | None) -> _Frames:
        which = self._which(frames, t_host_ns)
        found = np.flatnonzero(which >= 0)
        if not self.learned and len(self._seen) < MAX_OPEN:
            ids, numbers = np.unique(frames.ids, return_counts=True)
            self._seen.update(dict(zip(ids.tolist(), numbers.tolist(), strict=True)))
        before = np.zeros(len(found), np.int64)
        if holes is not None and holes.any():
            total = np.cumsum(holes)
            before = np.diff(total[found], prepend=0)
            left = int(total[-1] - (total[found[-1]] if len(found) else 0))
        else:
            left = 0
        if len(found):
            before[0] += self._pending_holes
            self._pending_holes = 0
        self._pending_holes += left
        if len(found) == len(which):
            return _Frames(frames, which, before)
        return _Frames(frames.pick(found), which[found], before)  # type: ignore[arg-type]

    def _which(self, frames: CanFrames, t_host_ns: int) -> I64Array:
        """(n,) number of the mapped message of each frame, -1 for none."""
        which = np.full(len(frames), -1, np.int64)
        plain = (frames.ids & np.uint32(ERROR_FLAG | REMOTE_FLAG)) == 0
        for number, message in enumerate(self.plan.messages):
            hit = plain & ((frames.ids & np.uint32(message.mask)) == message.identifier)
            if message.mask != 0xFFFF_FFFF and hit.any():
                hit &= self._one_source(message, frames, hit, t_host_ns)
            if message.paged and hit.any():
                rows = np.flatnonzero(hit)
                payload, lengths = frames.payload[rows], frames.lengths[rows]
                pages = [page.hit(payload, lengths) for page in message.pages]
                hit[rows] = np.logical_or.reduce(pages)
            which[hit] = number
        return which

    def _one_source(
        self, message: Message, frames: CanFrames, hit: NDArray[np.bool_], t_host_ns: int
    ) -> NDArray[np.bool_]:
        """J1939: frames of the first source address seen. Frames of other addresses are counted, with a warning."""
        address = frames.ids & np.uint32(0xFF)
        first = self._sources.setdefault(message.name, int(address[np.flatnonzero(hit)[0]]))
        same = address == first
        others = int((hit & ~same).sum())
        if others:
            self.stats.count("other_source", others)
            text = f"{message.name} comes from several source addresses: only 0x{first:02X} is taken"
            self.notices.add(t_host_ns, "warning", "other_source", text)
        return np.asarray(same)

    def _learn(self, mine: _Frames, t_host_ns: int, final: bool) -> bool:
        """Learn the timing from the frames that are held. False if more frames are needed."""
        n, messages, t_ns = len(mine), len(self.plan.messages), mine.frames.t_ns
        if n == 0:
            return False
        span_s = float(t_ns[-1] - t_ns[0]) / 1e9
        enough = n >= LEARN_FRAMES * messages and span_s >= LEARN_S
        if self._recorded:
            enough = n >= LEARN_RECORDED
        elif n >= FEW_FRAMES * messages and span_s >= FEW_S:
            enough = True
        if not enough and not final:
            return False
        self.learned = True
        self._timing = Timing.learn(mine.which, t_ns, messages)
        self.findings = look(self.plan.messages, mine.which, mine.frames, self._timing, self._nominal_hz)
        for each in self.findings:
            self.notices.add(t_host_ns, each.level, each.code, each.text)
        self._fit_steps(mine)
        self._axis.trust_hints = messages == 1 and n >= ALONE_SHARE * sum(self._seen.values())
        return True

    # -- rows ------------------------------------------------------------------------------------------------------

    def _read_rows(self, mine: _Frames, t_host_ns: int, final: bool) -> None:
        """Decode and append the rows that are complete or closed."""
        if len(mine) == 0:
            return
        n, times, row, mixed = self._rows_of(mine, final)
        if n == 0:
            return
        self._fit_steps(mine)
        warnings: Counter[tuple[str, str]] = Counter()
        counts, valid = self._values(mine, row, n, warnings)
        fresh: dict[str, list[str]] = {}
        for (code, text), number in warnings.items():
            self.stats.count(code, number)
            if text not in self._reported:
                self._reported.add(text)
                fresh.setdefault(code, []).append(text)
        for code, texts in fresh.items():
            self.notices.add(t_host_ns, "warning", code, "; ".join(texts))
        holes = (
            np.bincount(row[row < n], mine.holes[row < n], n).astype(np.int64)
            if mine.holes.any()
            else np.zeros(n, np.int64)
        )
        self._counts = np.concatenate([self._counts, counts])
        self._valid = np.concatenate([self._valid, valid & ~mixed])
        self._times = np.concatenate([self._times, times])
        self._row_holes = np.concatenate([self._row_holes, holes])

    def _values(
        self, mine: _Frames, row: I64Array, n: int, warnings: Counter[tuple[str, str]]
    ) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """Counts (n, channels), and (n,) whether each row has a value of every channel."""
        counts = np.zeros((n, len(self.plan.signals)), np.int32)
        if len(self.plan.messages) == 1 and len(self.plan.messages[0].pages) == 1:  # a row is a frame
            whole = np.ones(n, np.bool_)
            page = self.plan.messages[0].pages[0]
            for each, column in zip(page.fields, page.columns, strict=True):
                counts[:, column], good = each.read(mine.frames.payload, mine.frames.lengths, warnings)
                whole &= good
            return counts, whole
        valid = np.zeros((n, len(self.plan.signals)), np.bool_)
        for number, message in enumerate(self.plan.messages):
            rows = np.flatnonzero((mine.which == number) & (row < n))
            payload, lengths = mine.frames.payload[rows], mine.frames.lengths[rows]
            for page in message.pages:
                here = page.hit(payload, lengths) if message.paged and len(message.pages) > 1 else None
                for each, column in zip(page.fields, page.columns, strict=True):
                    value, good = each.read(payload, lengths, warnings if here is None else None)
                    good = good if here is None else good & here
                    counts[row[rows[good]], column] = value[good]
                    valid[row[rows[good]], column] = True
        return counts, np.asarray(valid.all(axis=1))

    def _rows_of(self, mine: _Frames, final: bool) -> tuple[int, I64Array, I64Array, NDArray[np.bool_]]:
        """Number of closed rows, their times, the row of each frame, and whether rows are mixed."""
        t_ns = mine.frames.t_ns
        if len(self.plan.messages) == 1:
            return len(mine), t_ns, np.arange(len(mine)), np.zeros(len(mine), np.bool_)
        rows = self._timing.rows(mine.which, t_ns)
        n = rows.n
        slipped = self._timing.slipped(mine.which, t_ns, rows, self._late_ns)
        if slipped is not None:
            text = (
                f"frames of {self.plan.messages[slipped].label} slip against those of the other messages: clocks of "
                "their own, so phases between them mean nothing"
            )
            self._warn(int(t_ns[-1]) if self._recorded else 0, "own_clocks", text, once="own_clocks")
        last = rows.row == n - 1
        if not final and len(np.unique(mine.which[last])) < len(self.plan.messages):
            n -= 1  # the last row is still open
            if int(last.sum()) <= MAX_OPEN:
                self._open = mine.pick(last)
        return n, rows.first_ns[:n], rows.row, rows.mixed[:n]

    def _fit_steps(self, mine: _Frames) -> None:
        """Choose the steps of float signals by their values; a value that does not fit enlarges the step."""
        changed: dict[int, Field] = {}
        factors = np.ones(len(self.plan.signals))
        for number, message in enumerate(self.plan.messages):
            if not any(field.floating for page in message.pages for field in page.fields):
                continue
            part = mine.frames.pick(mine.which == number)
            for page in message.pages:
                for field, column in zip(page.fields, page.columns, strict=True):
                    largest = field.largest(part.payload, part.lengths) if field.floating else 0.0
                    if field.floating and (field.step == 0.0 or largest >= field.step * (MOST_COUNT - 1.0)):
                        changed[column] = field.stepped(largest)
                        factors[column] = field.step / changed[column].step if field.step else 1.0
        if changed:
            self.plan = self.plan.with_messages(tuple(m.with_fields(changed) for m in self.plan.messages))
            self._counts = np.rint(self._counts * factors).astype(np.int32)

    # -- the axis --------------------------------------------------------------------------------------------------

    def _place(self, t_host_ns: int, final: bool) -> list[Reading]:
        new = len(self._times) - self._axis.held
        times = self._times[len(self._times) - new :]
        placed = self._axis.place(times, final, self._row_holes[len(self._times) - new :])
        out: list[Reading] = []
        self._warn_of_time(t_host_ns, final)
        if placed.unsure:
            self._unsure, self._within = self._unsure + placed.unsure, max(self._within, placed.within)
            rate_hz = self._axis.rate_hz or 1.0
            text = (
                "where samples are missing, frames come late or in bursts: the place of a gap is uncertain by up to "
                f"{1e3 * (self._within + 1) / rate_hz:.3g} ms; use an adapter that stamps each frame"
            )
            self._warn(t_host_ns, "coarse_stamps", text, once="coarse_stamps")
        if self._axis.rate_hz is not None and len(placed.index):
            info = Info(self.plan.signals, self._axis.rate_hz, "", self.plan.count_bits)
            if info != self._info:
                self._info = info
                out.append(info)
            self._emit(placed.index, t_host_ns, out)
        return out + self.notices.take()

    def _warn_of_time(self, t_host_ns: int, final: bool) -> None:
        axis = self._axis
        if self._steady.jumped_ns:
            text = f"the clock that stamps the frames was set forwards by {self._steady.jumped_ns / 1e9:.3g} s"
            self.notices.add(t_host_ns, "warning", "clock_set_forwards", f"{text}: counted on by the steady clock")
            self._steady.jumped_ns = 0
        if axis.stepped_back:
            axis.stepped_back = 0
            self.notices.add(t_host_ns, "warning", "clock_set_back", "the time stamps of the frames went back")
        if axis.leapt:
            axis.leapt = 0
            text = "the time stamps of the frames leapt by days: counted as a gap of a second"
            self.notices.add(t_host_ns, "warning", "clock_leapt", text)
        if axis.rate_hz is None:
            return
        found, nominal_hz = axis.measured, axis.nominal_hz
        if found is not None and nominal_hz is not None and off_nominal(found, 1e9 / nominal_hz):
            hz = f"{axis.rate_hz:.6g}"
            text = f"frames come at {hz} Hz, not at the {nominal_hz:g} Hz of the rig file: {hz} Hz is used"
            self._warn(t_host_ns, "rate_untrue", f"{text}; set acquisition.rate_hz = {hz}", once="rate_untrue")
        elif (hz_now := axis.drifted()) is not None:
            text = f"frames come at {hz_now:.6g} Hz, the record counts {axis.rate_hz:g} Hz"
            self._warn(t_host_ns, "rate_untrue", f"{text}: set acquisition.rate_hz = {hz_now:.6g}", once="rate_untrue")

    def _warn(self, t_host_ns: int, code: str, text: str, once: str) -> None:
        if once not in self._reported:
            self._reported.add(once)
            self.notices.add(t_host_ns, "warning", code, text)

    def _emit(self, index: I64Array, t_host_ns: int, out: list[Reading]) -> None:
        n = len(index)
        counts, valid, times, holes = self._counts[:n], self._valid[:n], self._times[:n], self._row_holes[:n]
        self._counts, self._valid = self._counts[n:], self._valid[n:]
        self._times, self._row_holes = self._times[n:], self._row_holes[n:]
        if not valid.all():
            index, counts, times, holes = index[valid], counts[valid], times[valid], holes[valid]
        cuts = (np.flatnonzero(np.diff(index) != 1) + 1).tolist()
        for start, stop in zip([0, *cuts], [*cuts, len(index)], strict=True):
            if start == stop:
                continue
            if index[start] > self._index:
                missing = int(index[start]) - self._index
                out.append(Gap(self._index, missing, "crc" if holes[start] else self._reason))
                self.stats.lost_samples += missing
            self._reason = "source"
            self._index = int(index[stop - 1]) + 1
            t_ns = int(times[stop - 1]) if self._recorded else t_host_ns
            out.append(Block(int(index[start]), np.ascontiguousarray(counts[start:stop]), t_ns))
