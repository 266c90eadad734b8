"""The log of a session in segments: each is a complete log, and together they replay as one."""

from __future__ import annotations

import os
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from daq.base.contract.clock import Clock, SystemClock
from daq.base.contract.dates import SINCE_2001_NS, Recorded, utc_text
from daq.base.contract.errors import LogError
from daq.base.contract.sink import Session, SinkHealth, Status
from daq.log.place import being_written
from daq.log.reader import read_log
from daq.log.scan import Findings, ends_closed
from daq.log.writer import LogWriter
from drivers.contract import Block, Gap, Info, Notice, Reading
from estimator.results import Estimate

from .chores import Chores
from .names import ALARM_CODE, NUMBER_KEY, SCHEDULE_KEY, SEGMENTS_KEY, marked, segment_name, segments
from .retention import in_words, remove_old, total_bytes
from .sizes import Cut, Keep

RETRY_S = 1.0  # pause before a segment that could not be opened is tried again
KEEP_EVERY_S = 60.0  # old segments are removed this often without a new one: other programs may fill the disk
MAX_EARLY = 1000  # notices that wait for the next segment
MAX_CLOSING = 3  # segments that are being closed: with more, the disk stalls and the present segment continues
UNCLOSED_SEGMENTS = 2  # the last segments of a folder, which are searched for an alarm after a crash
CLOSE_S = 30.0  # to close and remove segments at the end


@dataclass(slots=True, kw_only=True)
class _Part:
    """A segment that is written. first : index of its first sample; end : where it must end; None: nowhere."""

    writer: LogWriter
    first: int
    end: int | None
    alarm: bool = False


@dataclass(slots=True, kw_only=True)
class _State:
    """State of the stream so far."""

    session: Session
    info: Info
    status: Status | None = None
    early: deque[Reading] = field(default_factory=lambda: deque(maxlen=MAX_EARLY))
    number: int = 0
    now_ns: int = 0  # Unix time of the newest sample
    stop: int = 0  # index behind the newest sample
    origin: int | None = None  # index of the block of the estimator with the first sample
    forced: int = 0  # of a schedule: stored up to this index in any case
    lost: Gap | None = None  # came while no segment could be opened


class SegmentedLog:
    """A sink. The segments are cut on multiples of the estimator's blocks, so a replay of the folder gives equal bits.

    folder : of the segments; stem : of their names. block_rows : rows of an estimator's block at a rate in Hz.
    live, recorded : as of `LogWriter`. Raises LogError at once if the folder cannot be written.
    """

    def __init__(
        self, folder: Path, stem: str, cut: Cut, keep: Keep, *, block_rows: Callable[[float], int],
        live: bool = True, clock: Clock | None = None, recorded: Recorded | None = None,
    ) -> None:  # fmt: skip
        self.folder, self._stem, self._cut, self._keep = folder, stem, cut, keep
        self._block_rows, self._live, self._recorded = block_rows, live, recorded
        self._clock: Clock = clock or SystemClock()
        self._id = uuid.uuid4().hex
        self._state: _State | None = None
        self._part: _Part | None = None  # that is written
        self._closing: list[_Part] = []
        self._before: Path | None = None  # the segment before
        self._own: set[Path] = set()
        self._notices: deque[Notice] = deque()
        self._said: set[str] = set()
        self._dropped_closed = self._dropped_unopened = 0  # samples
        self._retry_ns = self._keep_ns = 0
        writable(folder)
        self._chores = Chores("segments", self._failed)
        self._chores.put(partial(mark_unclosed, folder))

    # -- the sink ---------------------------------------------------------------------------------------------------

    def start(self, session: Session) -> None:
        self._state = _State(session=session, info=session.info)

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Block):
                self._block(reading)
            else:
                self._other(reading)

    def estimate(self, estimate: Estimate) -> None:
        if self._part is not None:
            self._part.writer.estimate(estimate)

    def status(self, status: Status) -> None:
        if self._state is None:
            return
        self._state.status = status
        if self._part is not None:
            self._part.writer.status(status)
        due = self._clock.now_ns() >= self._keep_ns
        if due or (self._disk_is_full(self._state) and self._chores.idle()):
            self._chores.put(self._remove_old)
            self._keep_ns = self._clock.now_ns() + round(KEEP_EVERY_S * 1e9)

    def health(self) -> SinkHealth:
        lag_s, dropped = 0.0, self._dropped_closed + self._dropped_unopened
        for part in [*self._closing, *([self._part] if self._part else [])]:
            health = part.writer.health()
            self._notices.extend(health.notices)
            lag_s, dropped = max(lag_s, health.lag_s), dropped + health.dropped
        notices = []
        while self._notices:
            notices.append(self._notices.popleft())
        return SinkHealth(lag_s, dropped, tuple(notices))

    def close(self) -> None:
        self._end_part()
        self._chores.put(self._remove_old)
        self._chores.close(CLOSE_S if self._live else None)

    def _disk_is_full(self, state: _State) -> bool:
        """Whether the disk is full or faulty: no segment can be opened, or the one that is written waits for room."""
        return state.lost is not None if self._part is None else self._part.writer.faulty

    # -- where a segment begins and ends ----------------------------------------------------------------------------

    def _other(self, reading: Reading) -> None:
        """Store a reading other than a block in the present segment; a notice of an alarm marks its segment."""
        state = self._state
        if state is None:
            return
        if isinstance(reading, Info):
            state.info = reading
        if isinstance(reading, Notice) and reading.code == ALARM_CODE:
            self._mark_alarm(state)
        if self._part is not None:
            self._part.writer.readings([reading])
        elif isinstance(reading, Notice) or (isinstance(reading, Gap) and not state.number and state.lost is None):
            state.early.append(reading)

    def _mark_alarm(self, state: _State) -> None:
        """Keep the segment with the alarm and the one before; a schedule stores the following samples."""
        if self._part is not None:
            self._part.alarm = True
        self._chores.put(self._mark_before)
        if self._cut.for_s is not None:
            state.forced = state.stop + round(self._cut.for_s * state.info.rate_hz)

    def _block(self, block: Block) -> None:
        """Store a block: in two segments if one ends within it, or not at all between the windows of a schedule."""
        state = self._state
        if state is None or not len(block.counts):
            return
        rows = self._block_rows(state.info.rate_hz)
        state.origin = block.index // rows * rows if state.origin is None else state.origin
        state.stop, state.now_ns = block.index + len(block.counts), self._unix_ns(block)
        while len(block.counts):
            wanted = self._wanted(state, block.index)
            if self._part is not None:
                head, block = split(block, self._end(state, self._part, block), state.info.rate_hz)
                if len(head.counts):
                    self._part.writer.readings([head])
                if len(block.counts):
                    self._turn(state, self._part, block)
            elif not wanted:
                block = split(block, self._next_window(state, block.index), state.info.rate_hz)[1]
            elif not self._open(state, block):
                first = block.index if state.lost is None else state.lost.index
                state.lost = Gap(first, state.stop - first, "storage")
                self._dropped_unopened += len(block.counts)
                return

    def _end(self, state: _State, part: _Part, block: Block) -> int:
        """End of a segment: a multiple of the estimator's block, or the end of this block if that comes first."""
        rows, stop = self._block_rows(state.info.rate_hz), block.index + len(block.counts)
        ends = [] if part.end is None else [part.end]
        if self._cut.every_s is not None:
            ends.append(self._window_end(state, part.first))
        if self._cut.size_bytes is not None and part.writer.size_bytes >= self._cut.size_bytes:
            ends.append(block.index)
        if not ends:
            return stop
        at = -(-max(min(ends), block.index) // rows) * rows
        return min(stop, at) if at > part.first else stop

    def _turn(self, state: _State, part: _Part, block: Block) -> None:
        """End the present segment before the first row of a block, and open the next one."""
        if not self._wanted(state, block.index):
            self._end_part()
        elif part.writer.faulty or len(self._closing) >= MAX_CLOSING or not self._open(state, block):
            part.end = block.index + round(
                RETRY_S * state.info.rate_hz
            )  # the present segment continues until a new one is tried again

    def _period(self, state: _State) -> tuple[int, int]:
        """Rows of a period of the schedule, and those of it that are stored: whole blocks."""
        rows, rate_hz = self._block_rows(state.info.rate_hz), state.info.rate_hz
        every = max(1, round((self._cut.every_s or 0.0) * rate_hz / rows)) * rows
        return every, min(every, max(1, -(-round((self._cut.for_s or 0.0) * rate_hz) // rows)) * rows)

    def _wanted(self, state: _State, index: int) -> bool:
        if self._cut.every_s is None or index < state.forced:
            return True
        every, length = self._period(state)
        return (index - (state.origin or 0)) % every < length

    def _next_window(self, state: _State, index: int) -> int:
        every, _ = self._period(state)
        origin = state.origin or 0
        return origin + -(-(index + 1 - origin) // every) * every

    def _window_end(self, state: _State, first: int) -> int:
        every, length = self._period(state)
        origin = state.origin or 0
        return max(origin + (first - origin) // every * every + length, state.forced)

    def _open(self, state: _State, block: Block) -> bool:
        """Begin a segment with the first row of a block, and end the one before; False if it cannot be opened now."""
        if not self._live:
            self._chores.wait()
        elif self._clock.now_ns() < self._retry_ns:
            return False
        rate_hz = state.info.rate_hz
        start_ns = self._unix_ns(block) - round((len(block.counts) - 1) * 1e9 / rate_hz)
        path = self.folder / segment_name(self._stem, start_ns)
        try:
            writer = LogWriter(path, live=self._live, clock=self._clock, recorded=self._recorded)
        except LogError as error:
            if not self._live:
                raise
            self._retry_ns = self._clock.now_ns() + round(RETRY_S * 1e9)
            self._say_once("error", "log_fault", f"{error}; acquisition goes on, and it is tried again")
            return False
        self._said.clear()
        self._end_part()
        state.number += 1
        self._own.add(path)
        seconds = self._cut.seconds
        end = None if seconds is None else block.index + round(seconds * rate_hz)
        self._part = _Part(writer=writer, first=block.index, end=end)
        self._introduce(state, writer, start_ns)
        return True

    def _introduce(self, state: _State, writer: LogWriter, start_ns: int) -> None:
        """Write session, description, clock and earlier notices, which make the segment complete in itself."""
        about = {SEGMENTS_KEY: self._id, NUMBER_KEY: str(state.number), "started": utc_text(start_ns)}
        if self._cut.every_s is not None:
            about[SCHEDULE_KEY] = f"{self._cut.for_s:g} s of {self._cut.every_s:g} s"
        writer.start(replace(state.session, info=state.info, metadata={**state.session.metadata, **about}))
        if state.status is not None:
            writer.status(state.status)
        writer.readings([*([state.lost] if state.lost is not None else []), *state.early])
        state.lost = None
        state.early.clear()

    def _end_part(self) -> None:
        part, self._part = self._part, None
        if part is not None:
            self._closing = [*self._closing, part]
            self._chores.put(partial(self._close_part, part))

    # -- chores -----------------------------------------------------------------------------------------------------

    def _close_part(self, part: _Part) -> None:
        if part.writer.faulty:
            self._remove_old()  # this makes room for the end of the present segment
        part.writer.close()
        health = part.writer.health()
        self._notices.extend(health.notices)
        self._closing = [other for other in self._closing if other is not part]
        self._dropped_closed += health.dropped
        self._before = part.writer.path
        if part.alarm:
            self._mark_before()
        self._remove_old()

    def _mark_before(self) -> None:
        if self._before is not None and self._before.exists():
            self._before = self._before.rename(marked(self._before))
            self._own.add(self._before)

    def _remove_old(self) -> None:
        if not self._keep.anything or self._state is None:
            return
        part = self._part
        written = {p.writer.path for p in [*self._closing, *([part] if part else [])]}
        removed = remove_old(self.folder, self._keep, self._state.now_ns, self._own, written)
        self._own.difference_update(removed.paths)
        if removed.paths:
            self._say("info", "log_removed", in_words(removed))
        if removed.failed:
            self._say_once("error", "log_not_removed", removed.failed)
        if removed.kept_alarms:
            text = (
                f"{removed.kept_alarms} segments with an alarm are over --keep and stay; move them, or --remove-alarms"
            )
            self._say_once("warning", "log_kept_alarms", f"{self.folder}: {text}")

    # -- the rest ---------------------------------------------------------------------------------------------------

    def _unix_ns(self, block: Block) -> int:
        """Unix time of the last row of a block."""
        offset = self._recorded.wall_offset_ns if self._recorded is not None else self._clock.wall_offset_ns()
        if offset is None:
            offset = 0 if block.t_host_ns >= SINCE_2001_NS else self._clock.wall_offset_ns()
        return max(0, block.t_host_ns + offset)

    def _failed(self, error: Exception) -> None:
        text = error.strerror if isinstance(error, OSError) else repr(error)
        self._say_once("error", "log_fault", f"{self.folder}: {text}; acquisition goes on")

    def _say_once(self, level: str, code: str, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._say(level, code, text)

    def _say(self, level: str, code: str, text: str) -> None:
        self._notices.append(Notice(self._clock.now_ns(), level, code, text))


def writable(folder: Path) -> None:
    """Make a folder if need be. Raises LogError if it cannot be written into."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        text = f"cannot write segments into {folder}: {error.strerror}; choose another --out"
        raise LogError(text) from error


def mark_unclosed(folder: Path) -> None:
    """Name those of the last segments that hold an alarm, which a crash left unnamed."""
    for segment in segments(folder)[-UNCLOSED_SEGMENTS:]:
        if (
            segment.alarm
            or being_written(segment.path)
            or ends_closed(segment.path, Findings(size=total_bytes([segment.path])))
        ):
            continue
        with suppress(LogError):
            if any(notice.code == ALARM_CODE for notice in read_log(segment.path).notices):
                segment.path.rename(marked(segment.path))


def split(block: Block, at: int, rate_hz: float) -> tuple[Block, Block]:
    """The rows of a block before an index and those from it on; either may be empty. Times are those of last rows."""
    rows = min(max(0, at - block.index), len(block.counts))
    if rows == len(block.counts):
        return block, replace(block, index=block.index + rows, counts=block.counts[rows:])
    period_ns = 1e9 / rate_hz
    host_ns = block.t_host_ns - round((len(block.counts) - rows) * period_ns)
    device_ns = None if block.t_device_ns is None else block.t_device_ns + round(rows * period_ns)
    head = Block(block.index, block.counts[:rows], host_ns, block.t_device_ns)
    return head, Block(block.index + rows, block.counts[rows:], block.t_host_ns, device_ns)
