"""The Rerun sink: a bounded queue, and a thread that feeds a drawing process, also when the viewer fails.

The core loop only appends to the queue (microseconds). Overflow policy: the oldest goes first, and is counted. The
thread starts the drawing process (child.py) when the viewer can be reached, and again when it comes back.
"""

from __future__ import annotations

import subprocess
import threading
import time
import uuid
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from daq.base.contract.sink import Session, SinkHealth, Status
from drivers.contract import Block, Notice, Reading
from estimator.results import Estimate

from .process import VIEWER_PORT, ViewerGone, ViewerProcess, answers, start_viewer, viewer_target
from .view import ViewSession

Item = Reading | Estimate | Status
OVERHEAD_BYTES = 256  # bytes charged for whatever is not samples
BATCH_BYTES = 1 << 20  # bytes of samples in one message
RETRY_S = (0.5, 5.0)  # first and longest pause between attempts to reach a viewer
LIVE_BYTES, FILE_BYTES = 8 << 20, 64 << 20  # 20 s of four channels at 25.6 kHz; and room for a fast replay
FINISH_S = 10.0  # to complete a file
CLOSE_S = 1.0  # without progress while closing


class RerunSink:
    """Shows a session in `target`: FILE.rrd, "spawn", or rerun+http://HOST:PORT/proxy.

    wall_offset_ns : Unix time minus the monotonic time of the readings; None: this host's, now.
    live : False for a replay or a capture, which waits for the viewer rather than lose anything (while there is one).
    viewer_port : of the viewer that "spawn" starts.
    dropped : samples that the viewer will never show. `health` reports when a viewer is lost and when it is back.
    Raises ConfigError for a target that is none of these.
    """

    def __init__(
        self,
        target: str,
        *,
        capacity_bytes: int | None = None,
        wall_offset_ns: int | None = None,
        live: bool = True,
        viewer_port: int = VIEWER_PORT,
    ) -> None:
        self._target = viewer_target(target)
        self._file = self._target.endswith(".rrd")
        self._capacity = capacity_bytes or (FILE_BYTES if self._file else LIVE_BYTES)
        self._live = live
        self._viewer_port = viewer_port
        self._wall_ns = time.time_ns() - time.monotonic_ns() if wall_offset_ns is None else wall_offset_ns
        self._queue: deque[tuple[int, Item, int]] = deque()  # bytes, item, monotonic ns
        self._bytes = 0
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._problem: str | None = None
        self._notices: list[Notice] = []
        self._process: ViewerProcess | None = None
        self._window: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None
        self.dropped = 0

    # ---- called by the core loop

    def start(self, session: Session) -> None:
        self._session = view_session(session, self._wall_ns)
        self._thread = threading.Thread(target=self._run, name="rerun", daemon=True)
        self._thread.start()

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            self._put(reading, reading.counts.nbytes if isinstance(reading, Block) else 0)

    def estimate(self, estimate: Estimate) -> None:
        extra = dict(estimate.extra) if estimate.extra else None
        self._put(replace(estimate, parameters=dict(estimate.parameters), extra=extra), 64 * len(estimate.parameters))

    def status(self, status: Status) -> None:
        link = replace(status.link, other=dict(status.link.other))
        self._put(replace(status, link=link, lag_s=dict(status.lag_s), dropped=dict(status.dropped)), 0)

    def health(self) -> SinkHealth:
        with self._lock:
            notices, self._notices = tuple(self._notices), []
            oldest = self._queue[0][2] if self._queue else None
        return SinkHealth((time.monotonic_ns() - oldest) / 1e9 if oldest is not None else 0.0, self.dropped, notices)

    def close(self) -> None:
        """Hand over the queue as long as the viewer takes it, then end. Idempotent."""
        if self._thread is None:
            return
        self._closing.set()
        self._wake.set()
        left = len(self._queue)
        while True:
            self._thread.join(CLOSE_S)
            if not self._thread.is_alive():
                break
            if len(self._queue) == left and self._process is not None and not self._file:
                self._process.kill()
            left = len(self._queue)
        self._thread = None
        self.dropped += sum(samples(item) for _, item, _ in self._queue)
        self._queue.clear()

    # ---- the queue

    def _put(self, item: Item, size: int) -> None:
        size += OVERHEAD_BYTES
        while not self._live and self._bytes + size > self._capacity and self._process is not None:
            time.sleep(0.002)
        with self._lock:
            self._queue.append((size, item, time.monotonic_ns()))
            self._bytes += size
            while self._bytes > self._capacity:
                less, oldest, _ = self._queue.popleft()
                self._bytes -= less
                self.dropped += samples(oldest)
        self._wake.set()

    def _batch(self) -> list[Item]:
        taken: list[Item] = []
        size = 0
        with self._lock:
            while self._queue and size < BATCH_BYTES:
                more, item, _ = self._queue.popleft()
                size += more
                taken.append(item)
            self._bytes -= size
        return taken

    # ---- the thread

    def _run(self) -> None:
        pause, longest = RETRY_S
        while True:
            try:
                self._process = ViewerProcess(self._reach())
                self._process.start(self._session)
                self._report(None)
                pause = RETRY_S[0]
                self._feed(self._process)
                return
            except OSError as problem:
                self._report(str(problem))
            finally:
                if self._process is not None:
                    self._process.close()
                    self._process = None
            if self._file:  # starting again would overwrite what is there
                self._capacity = 0
                return
            if self._closing.wait(pause):
                return
            pause = min(2 * pause, longest)

    def _report(self, problem: str | None) -> None:
        """Add a notice when the viewer is lost and when it is back, not for every attempt between."""
        known, self._problem = self._problem, problem
        if (known is None) == (problem is None):
            return
        level, code, text = "info", "viewer_back", "it is shown again"
        if problem is not None:
            level, code, text = "warning", "viewer_lost", f"{problem}; acquisition goes on without it"
            text += "" if self._file else "; it is tried again"
        with self._lock:
            self._notices.append(Notice(time.monotonic_ns(), level, code, f"viewer {self._target}: {text}"))

    def _reach(self) -> str:
        """The target to give the drawing process, once it can be reached."""
        if self._file:
            return self._target
        url = self._target
        if url == "spawn":
            url = f"rerun+http://127.0.0.1:{self._viewer_port}/proxy"
            if self._window is None and not answers(url):
                self._window = start_viewer(self._viewer_port)
                for _ in range(100):
                    if answers(url) or self._closing.wait(0.1) or self._window.poll() is not None:
                        break
            if self._window is not None and self._window.poll() not in (None, 0):
                raise ViewerGone(f"it ended with status {self._window.poll()} (is there a display?)")
        if not answers(url):
            raise ViewerGone("nothing listens there")
        return url

    def _feed(self, process: ViewerProcess) -> None:
        while True:
            batch = self._batch()
            if batch:
                try:
                    process.send(batch)
                except OSError:
                    self.dropped += sum(samples(item) for item in batch)
                    raise
            elif self._closing.is_set():
                process.finish(FINISH_S if self._file else CLOSE_S)
                return
            else:
                self._wake.clear()
                if not self._queue and not self._closing.is_set():
                    self._wake.wait(1.0)
                time.sleep(0.05)  # gather: one message of many blocks costs less than many of one


def samples(item: Item) -> int:
    return len(item.counts) if isinstance(item, Block) else 0


def view_session(session: Session, wall_ns: int) -> ViewSession:
    """Facts of the session for the drawing process, as plain data."""
    model, names = session.model, [s.name for s in session.info.signals]
    channels = {c.name: (c.place, c.kind) for c in model.channels}
    if len(names) == len(channels) and not set(channels) <= set(names):  # the device's own names: taken in order
        channels = dict(zip(names, channels.values(), strict=True))
    rig = next((text for name, text in session.attachments.items() if name.endswith(".toml")), b"")
    return ViewSession(
        name=" ".join(part for part in (model.name or "rotorscope", session.device) if part),
        recording_id=str(uuid.uuid4()),
        info=session.info,
        places=channels,
        band=model.band,
        wall_ns=wall_ns,
        rig=rig.decode(errors="replace"),
        facts=dict(session.metadata),
    )
