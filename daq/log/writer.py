"""The MCAP sink: takes readings from the core loop without delaying it, and writes them from a separate thread."""

from __future__ import annotations

import tempfile
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from daq.base.contract.clock import Clock, SystemClock
from daq.base.contract.dates import Recorded
from daq.base.contract.errors import LogError
from daq.base.contract.sink import Session, SinkHealth, Status
from drivers.contract import Block, Gap, Notice, Reading
from estimator.results import Estimate

from .encoder import LogEncoder
from .file import LogFile

FLUSH_NS = 400_000_000  # a chunk ends and reaches the operating system this often: kill -9 costs less than 1 s
SYNC_NS = 1_000_000_000  # and the disk itself this often: a power cut costs about 2 s
RETRY_NS = 500_000_000
GIVE_UP_NS = 1_000_000_000
TAKE_BYTES = 1 << 20  # of what waits, encoded before the next look at the time
SMALL_ITEM_BYTES = 2048  # about what an estimate, a status or a notice takes

Item = Session | Reading | Estimate | Status


class LogWriter:
    """The log at `path`. Raises LogError at once if it cannot be created.

    live : acquisition must not wait. The queue for the disk is bounded by `limit_bytes`; beyond it the newest samples
        are not stored, and a Gap of reason "storage" replaces them. A full or failing disk is tried again every 0.5 s
        and the same file goes on when it recovers. False: the caller waits for the disk (import, fast replay), and a
        fault of the disk is a LogError from any method. The log gets its name when it is complete, if `wanted` then.
    file : makes the file from its path.
    recorded : the samples are not of now, see `Recorded`.
    A log without samples or gaps is removed. An earlier measurement at `path` is kept under another name.
    A file that was removed, alone or with its folder, is put back with all its bytes; one that was moved is followed;
    bytes that another program cut off are lost. `health` gives notices for the operator.
    """

    def __init__(
        self, path: str | Path, *, live: bool = True, limit_bytes: int = 64 << 20, clock: Clock | None = None,
        wanted: Callable[[], bool] = lambda: True, file: Callable[..., LogFile] = LogFile,
        recorded: Recorded | None = None,
    ) -> None:  # fmt: skip
        self._clock: Clock = clock or SystemClock()
        self._file = file(Path(path), whole=not live)
        self._wanted = wanted
        self._holds_data = False
        self._encoder = LogEncoder(self._file, recorded)
        self._live = live
        self._limit = limit_bytes
        self._changed = threading.Condition()
        self._queue: deque[tuple[Item, int]] = deque()  # each with its bytes
        self._queued = 0  # bytes
        self._lost: Gap | None = None  # not yet written to the log
        self._dropped = 0
        self._encoded = self._safe = 0  # samples that the encoder has taken, and of those the ones that are on the disk
        self._notices: list[Notice] = []
        self._closing = self._abandoned = False
        self._progress = 0
        self._behind_since_ns: int | None = None
        self._problem = ""
        self._reported_cut = self._reported_hidden = False
        self._failed = ""
        self._thread = threading.Thread(target=self._run, name=f"log {path}", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path:
        """Path of the log. It differs from the requested path only if that was taken after a removal."""
        return self._file.path

    @property
    def faulty(self) -> bool:
        """Whether writing to the disk fails at present; it is tried again."""
        return bool(self._problem)

    @property
    def size_bytes(self) -> int:
        """Size of the file so far, with the bytes that wait for the disk; without the samples of the last 0.4 s."""
        return self._file.tell()

    # -- core loop ------------------------------------------------------------------------------------------------

    def start(self, session: Session) -> None:
        self._put(session, sum(map(len, session.attachments.values())))

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            self._put(reading, reading.counts.nbytes if isinstance(reading, Block) else SMALL_ITEM_BYTES)

    def estimate(self, estimate: Estimate) -> None:
        self._put(estimate, SMALL_ITEM_BYTES)

    def status(self, status: Status) -> None:
        self._put(status, SMALL_ITEM_BYTES)

    def health(self) -> SinkHealth:
        """Lag, dropped samples and notices since the last call."""
        with self._changed:
            notices, self._notices = tuple(self._notices), []
            behind = self._behind_since_ns
        lag_s = 0.0 if behind is None else (self._clock.now_ns() - behind) / 1e9
        return SinkHealth(lag_s, self._dropped, notices)

    def close(self) -> None:
        """Complete the log. Gives up, and says so in `health`, if the disk makes no progress for a second."""
        with suppress(RuntimeError):  # not held: a Ctrl-C on the way out of a `with` leaves it so, and the writer waits
            while True:
                self._changed.release()
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        try:
            self._wait()
        except BaseException:  # Ctrl-C: a log that can be made again is not left incomplete
            self._wanted = lambda: False
            self._thread.join(0.0 if self._live else GIVE_UP_NS / 1e9)
            raise
        if not self._live:
            self._raise_failure()

    def _wait(self) -> None:
        seen, since = (-1, 0), self._clock.now_ns()
        while self._thread.is_alive():
            self._thread.join(0.05)
            now = (self._progress, self._file.restored)
            if now != seen:
                seen, since = now, self._clock.now_ns()
            elif self._live and self._clock.now_ns() - since > GIVE_UP_NS:
                self._abandoned = True
                why = self._problem or ("the disk stalls" if self._file.pending else "this computer is too busy")
                lacking = f"up to {self._give_up()} samples of its end are not in it"
                text = f"{self.path} could not be completed: {why}; {lacking}; rotorscope recover may mend it"
                self._report("error", "log_incomplete", text)
                return

    def _give_up(self) -> int:
        """Number of samples that may not be on the disk; from now on they count as dropped."""
        with self._changed:
            waiting = sum(len(item.counts) for item, _ in self._queue if isinstance(item, Block))
            lacking = self._encoded - self._safe + waiting
            self._dropped += lacking
            return lacking

    def _raise_failure(self) -> None:
        if self._failed:
            raise LogError(self._failed)

    def _put(self, item: Item, size: int) -> None:
        with self._changed:
            if self._closing:
                return
            if not self._live:
                self._changed.wait_for(lambda: self._queued < self._limit or self._failed)
                self._raise_failure()
            room = self._limit if isinstance(item, Block) else self._limit + self._limit // 8
            full = self._live and self._queued and self._queued + size > room
            if full or self._failed:
                self._drop(item)
                return
            if isinstance(item, Block | Gap):
                self._record_lost(resumed=isinstance(item, Block))
            self._queue.append((item, size))
            self._queued += size
            self._changed.notify_all()

    def _drop(self, item: Item) -> None:
        if not isinstance(item, Block):
            return
        lost = self._lost
        if lost is None:
            text = f"{self.path}: the disk is too slow; samples from {item.index} are not stored"
            self._note("error", "log_overflow", text)
            lost = Gap(item.index, 0, "storage")
        self._lost = Gap(lost.index, item.index + len(item.counts) - lost.index, "storage")
        self._dropped += len(item.counts)

    def _record_lost(self, resumed: bool) -> None:
        if self._lost is None:
            return
        self._queue.append((self._lost, 0))
        if resumed:
            text = f"{self.path}: stored again; {self._lost.count} samples from {self._lost.index} are missing"
            self._note("warning", "log_resumed", text)
        self._lost = None

    # -- writer thread --------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._loop()
        except Exception as error:  # no failure of the log may stop acquisition
            what = str(error.strerror or error) if isinstance(error, OSError) else repr(error)
            if not self._live:
                self._file.close()
            with self._changed:
                self._give_up()
                self._failed = f"{self.path}: the log has stopped: {what}; make room or choose another --out"
                self._note("error", "log_failed", self._failed)
                self._changed.notify_all()

    def _loop(self) -> None:
        flush_ns = sync_ns = self._clock.now_ns()
        while True:
            due = flush_ns + FLUSH_NS - self._clock.now_ns()
            items, closing = self._take(max(due, 0) / 1e9)
            for item in items:
                if closing and self._unwanted():
                    break
                self._encode(item)
                self._progress += 1
            now = self._clock.now_ns()
            if closing and not items:
                break
            if now - flush_ns >= FLUSH_NS:
                self._encoder.flush()
                flush_ns = now
                self._look_after_file()
            self._push(sync=now - sync_ns >= SYNC_NS)
            sync_ns = now if now - sync_ns >= SYNC_NS else sync_ns
        if self._holds_data and not self._unwanted():
            self._encoder.finish()
            self._look_after_file()
            while not self._push(sync=True) and not self._abandoned:
                self._sleep(RETRY_NS)
            if not self._live:
                self._keep()
            elif self._file.removed:
                self._rescue()
        else:
            self._file.discard()
        self._file.close()

    def _unwanted(self) -> bool:
        return not self._live and not self._wanted()

    def _keep(self) -> None:
        self._file.keep()
        if self._file.kept is not None:
            self._report("warning", "log_kept", f"{self.path}: what lay there is kept as {self._file.kept}")

    def _take(self, timeout_s: float) -> tuple[list[Item], bool]:
        """Records that wait, once the disk has room for them, and whether they are the last."""
        with self._changed:
            if not self._queue and not self._closing:
                self._changed.wait(timeout_s)
            if self._file.pending > self._limit // 4 and not self._closing:
                return [], False
            if self._closing:
                self._record_lost(resumed=False)
            items, taken = list[Item](), 0
            while self._queue and taken < TAKE_BYTES:
                item, size = self._queue.popleft()
                items.append(item)
                taken += size
            self._queued -= taken
            self._behind_since_ns = self._behind_since_ns or (self._clock.now_ns() if items else None)
            self._changed.notify_all()
            return items, self._closing

    def _encode(self, item: Item) -> None:
        if isinstance(item, Session):
            self._encoder.start(item, self._clock.wall_offset_ns(), self._clock.now_ns())
        elif isinstance(item, Estimate):
            self._encoder.estimate(item)
        elif isinstance(item, Status):
            self._encoder.status(item)
        else:
            self._encoder.reading(item)
            self._encoded += len(item.counts) if isinstance(item, Block) else 0
            if not self._holds_data and (isinstance(item, Block) or (isinstance(item, Gap) and item.count)):
                self._holds_data = True
                if self._live:
                    self._keep()

    def _push(self, sync: bool) -> bool:
        """Write waiting bytes to the disk; True if none are left."""
        before = self._file.pending
        try:
            self._file.push()
            if sync:
                self._file.sync()
        except OSError as error:
            if not self._live:
                raise
            self._fault(f"{error.strerror or error}")
            if not self._closing:
                self._sleep(RETRY_NS)
            return False
        if before:
            self._progress += 1
            self._behind_since_ns = None
        if self._encoder.fresh:
            self._safe = self._encoded
        self._well()
        if self._file.cut and not self._reported_cut:
            self._reported_cut = True
            text = "another program cut or overwrote the log: what it held is lost; rotorscope recover reads the rest"
            self._report("error", "log_cut", f"{self.path}: {text}")
        return True

    def _look_after_file(self) -> None:
        if not self._file.in_place:
            self._look_for_file()
        if not self._file.removed:
            return
        try:
            path = self._file.restore()
        except OSError as error:
            self._fault(f"removed, and cannot be put back: {error.strerror or error}")
        else:
            self._report("warning", "log_restored", f"the log was removed; it is back, whole, as {path}")

    def _look_for_file(self) -> None:
        before = self._file.path
        if self._file.follow():
            self._report("warning", "log_moved", f"{before}: the log was moved; it goes on as {self._file.path}")
        elif not self._reported_hidden:
            self._reported_hidden = True
            text = (
                "the disk of the log was unmounted, or another mounted over it; the log goes on there, and is not to be"
            )
            self._report("error", "log_hidden", f"{before}: {text} found under this name until that disk is back")

    def _rescue(self) -> None:
        """Put a finished log that cannot have its own name into the nearest other folder."""
        before = self._file.path
        for folder in (*self._file.folder.parents, Path(tempfile.gettempdir())):
            try:
                path = self._file.restore(folder)
            except OSError:
                continue
            self._report("warning", "log_restored", f"{before} was removed and cannot be put back; the log is {path}")
            return
        self._safe = 0
        self._give_up()
        self._report("error", "log_incomplete", f"{before} was removed and cannot be put back anywhere; it is lost")

    def _fault(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            text = f"{self.path}: {problem}; acquisition goes on, make room or reconnect the disk"
            self._report("error", "log_fault", text)

    def _well(self) -> None:
        if self._problem and not self._file.removed:
            self._problem = ""
            self._report("info", "log_recovered", f"{self.path}: written again")

    def _sleep(self, ns: int) -> None:
        with self._changed:
            self._changed.wait_for(lambda: False, ns / 1e9)

    def _report(self, level: str, code: str, text: str) -> None:
        with self._changed:
            self._note(level, code, text)

    def _note(self, level: str, code: str, text: str) -> None:
        self._notices.append(Notice(self._clock.now_ns(), level, code, text))
