"""A log as a link, and the check that a log replayed gives its own estimates."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from daq.base.contract.clock import Clock, SystemClock
from daq.base.contract.errors import LogError
from daq.base.contract.sink import Session, Sink, Status
from daq.log import codec as codec
from daq.log.entries import Head
from daq.rig.rig import Rig
from drivers.contract import Block, Gap, LinkStats, Notice, Reading
from estimator.results import Estimate

from .acquire import Notify, RunSummary, acquire_from
from .estimators import MakeEstimator
from .pipeline import OWN_CODES

READ_ROWS = 1 << 16  # per read
OPEN_END = ("recovered", "stopped_behind")  # notices of logs whose last samples were not estimated from


class Replayable(Protocol):
    """A log, or the segments of a session: their samples, and the estimates as they were logged."""

    @property
    def path(self) -> Path: ...
    @property
    def attachments(self) -> Mapping[str, bytes]: ...
    @property
    def head(self) -> Head: ...
    @property
    def rate_hz(self) -> float: ...
    @property
    def first(self) -> int: ...
    @property
    def stop(self) -> int: ...
    @property
    def started_ns(self) -> int | None: ...
    @property
    def growing(self) -> bool: ...
    @property
    def complete(self) -> bool: ...
    @property
    def notices(self) -> Sequence[Notice]: ...
    @property
    def rig_text(self) -> str: ...
    def readings(self, joined: bool = True) -> Iterator[Reading]: ...
    def estimate_bytes(self) -> Iterator[bytes]: ...


class ReplayDriver:
    """The readings of a log, in order. speed : times real time, by the samples' own time axis; None: at once.

    Notices of the service itself (clipping, faults of the disk) are left out, because the replay makes them again.
    A log that is still being written is reported: its replay ends where the log ended when it was read.
    """

    kind = "replay"

    def __init__(self, recording: Replayable, speed: float | None = None, clock: Clock | None = None) -> None:
        if speed is not None and not speed > 0:
            raise ValueError(f"a speed of {speed} times real time is not above 0")
        self.stats = LinkStats()
        self.wall_offset_ns = recording.head.wall_offset_ns if recording.started_ns is not None else None
        self._recording = recording
        self._speed = speed
        self._clock: Clock = clock or SystemClock()
        self._closed = threading.Event()
        self._source: Iterator[Reading] | None = None
        self._next: Reading | None = None
        self._growing_reported = not recording.growing
        self._start_ns = 0
        self.exhausted = False

    def open(self) -> None:
        self._source = self._recording.readings(joined=self._speed is None)
        self._start_ns = self._clock.now_ns()

    def close(self) -> None:
        self._closed.set()
        self.exhausted = True

    def read(self, timeout_s: float) -> list[Reading]:
        out: list[Reading] = []
        rows = 0
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while rows < READ_ROWS and not self._closed.is_set():
            reading = self._next or next(self._source or iter(()), None)
            self._next = None
            if reading is None:
                self.exhausted = True
                break
            if isinstance(reading, Block) and not self._due(reading, deadline_ns, bool(out)):
                self._next = reading
                break
            if isinstance(reading, Notice) and (reading.code in OWN_CODES or reading.code.startswith("log_")):
                continue
            if isinstance(reading, Block) and not self._growing_reported:
                self._growing_reported = True
                out.append(self._growing(reading.t_host_ns))
            out.append(reading)
            self._count(reading)
            rows += len(reading.counts) if isinstance(reading, Block) else 1
        return out

    def _due(self, block: Block, deadline_ns: int, have_some: bool) -> bool:
        """Wait until the block's last sample is due; False if that is after the deadline or other readings go first."""
        if self._speed is None:
            return True
        end_s = (block.index + len(block.counts) - self._recording.first) / self._recording.rate_hz / self._speed
        due_ns = self._start_ns + round(end_s * 1e9)
        wait_ns = due_ns - self._clock.now_ns()
        if wait_ns <= 0:
            return True
        if have_some:
            return False
        self._closed.wait(min(due_ns, deadline_ns) / 1e9 - self._clock.now_ns() / 1e9)
        return due_ns <= deadline_ns

    def _growing(self, t_host_ns: int) -> Notice:
        path, stop = self._recording.path, self._recording.stop
        text = f"{path}: is being written; replayed up to sample {stop - 1}"
        return Notice(t_host_ns, "warning", "log_growing", text)

    def _count(self, reading: Reading) -> None:
        if isinstance(reading, Block):
            self.stats.frames += 1
            self.stats.bytes += reading.counts.nbytes
        elif isinstance(reading, Gap):
            self.stats.lost_samples += reading.count


class EstimateCheck:
    """A sink that compares every estimate with the logged ones, byte for byte, NaN included."""

    def __init__(self, recording: Replayable) -> None:
        self._recording = recording
        self._logged = recording.estimate_bytes()
        self._next = next(self._logged, None)
        self.compared = 0
        self._extra = 0
        self._equal = True

    @property
    def nothing(self) -> bool:
        """Whether there is nothing to compare."""
        return self._next is None and not self.compared

    @property
    def identical(self) -> bool:
        """Whether exactly the logged estimates came again; a log that was cut may give more at its end."""
        if not (self._equal and self._next is None):
            return False
        recording = self._recording
        return not self._extra or not recording.complete or any(n.code in OPEN_END for n in recording.notices)

    def start(self, session: Session) -> None: ...
    def readings(self, batch: Sequence[Reading]) -> None: ...
    def status(self, status: Status) -> None: ...
    def close(self) -> None: ...

    def estimate(self, estimate: Estimate) -> None:
        if self._next is None:
            self._extra += 1
            return
        self._equal &= codec.encode_estimate(estimate) == self._next
        self._next = next(self._logged, None)
        self.compared += 1


def logged_rig(log: Replayable) -> Rig:
    """The rig file of the session that made the log. Raises LogError if the log holds none."""
    return Rig.parse(log.rig_text, where=f"{log.path}: rig.toml", attached=log.attachments)


def replay_into(
    log: Replayable, rig: Rig | None = None, sinks: Sequence[Sink] = (), *,
    speed: float | None = None, check: bool = False, seconds: float | None = None,
    stop: threading.Event | None = None, notify: Notify | None = None, make: MakeEstimator | None = None,
) -> RunSummary:  # fmt: skip
    """Run the readings of a log through the pipeline into `sinks`; speed None is as fast as it goes.

    check : the summary says whether the estimates are `identical` to the logged ones. make : instead of the rig's
    estimator. Raises LogError if the log has no rig file and none is given, or if there is nothing to check.
    """
    rig = rig or logged_rig(log)
    checker = EstimateCheck(log) if check else None
    if checker is not None and checker.nothing:
        raise LogError(f"{log.path}: holds no estimates to check; replay it without --check")
    all_sinks = [*sinks, *([checker] if checker is not None else [])]
    outcome = acquire_from(rig, ReplayDriver(log, speed), all_sinks, seconds, stop, notify=notify, make=make)
    return outcome if checker is None else replace(outcome, identical=checker.identical, compared=checker.compared)
