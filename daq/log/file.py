"""A growing file on a disk that may be full, stall, or have its folder removed."""

from __future__ import annotations

import contextlib
import os
import stat
import threading
from collections import deque
from pathlib import Path

from daq.base.console import unfinished
from daq.base.console.file_kinds import another_ending
from daq.base.console.stop import unbroken
from daq.base.contract.errors import ConfigError, LogError, no_folder

from .place import being_written, emptied, free_name, locked, made, moved_aside, no_file, opened, refused, unlock

COPY_BYTES = 1 << 20  # a call
WITNESS_BYTES = 64
SYNC_WAIT_S = 0.3


class LogFile:
    """A log file whose bytes wait in memory until `push` writes them; a failed push loses and damages nothing.

    An earlier file at `path` comes back if this one is discarded. An earlier measurement, or a file that is no log, is
    always kept: see `kept`. whole : the file gets its name only when it is complete, so that no half of it is found.
    For the MCAP writer it is a binary stream. One thread. Raises LogError if the place cannot be written, and
    ConfigError for a name of another kind of file.
    """

    def __init__(self, path: Path, whole: bool = False) -> None:
        if said := another_ending(path):
            raise ConfigError(f"{path}: {said}")
        if path.is_fifo() or path.is_socket():  # /dev/stdout, too: before what it points to gets another name
            raise no_file(path)
        try:
            path = unfinished.led_to(path)
        except OSError as error:
            raise _not_to_be_had(path, error) from error
        self.path = path
        self.folder = _here() / path.parent  # independent of the folder in which the program started
        self.kept: Path | None = None  # new place of an earlier file at `path` that cannot be made again
        self._waiting: deque[memoryview] = deque()
        self._stored = 0
        self.pending = 0
        self.restored = 0  # bytes, for the caller that waits
        self.cut = False  # another program cut the file: stored bytes are lost
        self._tail = self._witness = (0, b"")  # offset and bytes: the end of the last write, and of the one before
        self._syncing: threading.Thread | None = None
        self._hidden: Path | None = None
        self._aside: Path | None = None
        try:
            if not whole or (path.exists() and not path.is_file()):
                self._fd, self._aside = emptied(path, opened(path, path))
            elif being_written(path):
                raise refused(path)
            else:
                with unbroken():
                    self._fd, self._hidden = unfinished.private(path)
                    unfinished.begin(self._hidden)
                locked(self._fd)
        except OSError as error:
            raise _not_to_be_had(path, error) from error

    def write(self, data: bytes) -> int:
        if data:
            self._waiting.append(memoryview(data))
            self.pending += len(data)
        return len(data)

    def tell(self) -> int:
        return self._stored + self.pending

    def flush(self) -> None:
        """Nothing: the owner calls `push`."""

    def push(self) -> None:
        """Write all bytes that wait. Raises OSError; bytes that were not written still wait for the next call."""
        while self._waiting:
            head = self._waiting[0]
            self._look_for_cut()
            written = os.pwrite(self._fd, head, self._stored)
            end = bytes(head[max(0, written - WITNESS_BYTES) : written])
            self._stored += written
            self._witness, self._tail = self._tail, (self._stored - len(end), end)
            self.pending -= written
            if written == len(head):
                self._waiting.popleft()
            else:
                self._waiting[0] = head[written:]

    def _look_for_cut(self) -> None:
        """Detect a cut by another program. A cut just before a write leaves the size right, with a hole."""
        about = os.fstat(self._fd)
        if stat.S_ISREG(about.st_mode) and not self.cut:
            at, end = self._witness
            self.cut = about.st_size < self._stored or os.pread(self._fd, len(end), at) != end

    def sync(self) -> None:
        """Ask the operating system to put the written bytes on the disk, against a power cut; a crash needs no sync.

        A thread does it, because a busy disk takes seconds. A request while another is under way is dropped.
        """
        if self._syncing is not None and self._syncing.is_alive():
            return
        try:
            fd = os.dup(self._fd)
        except OSError:  # no more file descriptors: the system chooses when it writes
            return
        syncing = threading.Thread(target=_sync, args=(fd,), name="log sync", daemon=True)
        try:
            syncing.start()
        except RuntimeError:  # no more threads
            os.close(fd)
        else:
            self._syncing = syncing

    @property
    def removed(self) -> bool:
        """Whether the file or its folder was deleted. The bytes remain while the file is open."""
        if os.fstat(self._fd).st_nlink:
            return False
        return self._hidden is None or unfinished.wanted(self._hidden)  # at our exit: unwanted first, then gone

    @property
    def in_place(self) -> bool:
        """Whether this file lies at `path`; also True for a file that was removed or has no name yet."""
        return self._hidden is not None or self._aside is not None or self.removed or self._is(self.path)

    def follow(self) -> bool:
        """Set `path` to the new name of a moved file; False if it has none, or the system does not give it."""
        with contextlib.suppress(OSError):
            now = Path(os.readlink(f"/proc/self/fd/{self._fd}"))
            if self._is(now):
                self.path, self.folder = now, now.parent
                return True
        return False

    def _is(self, path: Path) -> bool:
        with contextlib.suppress(OSError):
            return os.path.samestat(os.stat(path), os.fstat(self._fd))
        return False

    def restore(self, folder: Path | None = None) -> Path:
        """Give a removed file its name back (or a free one beside it), with all its bytes. Raises OSError.

        folder : where to put the file instead.
        """
        wanted = (folder or self.folder) / (self._hidden or self.path).name
        wanted.parent.mkdir(parents=True, exist_ok=True)
        path = free_name(wanted) if wanted.exists() else wanted
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            if not locked(fd):
                raise OSError(f"{path} was taken while it was made")
            for at in range(0, self._stored, COPY_BYTES):
                piece = os.pread(self._fd, min(COPY_BYTES, self._stored - at), at)
                if os.pwrite(fd, piece, at) != len(piece):
                    raise OSError(f"disk full while restoring {path}")
                self.restored += len(piece)
        except OSError:
            os.close(fd)
            path.unlink(missing_ok=True)
            raise
        os.close(self._fd)
        self._fd = fd
        if self._hidden is None:
            self.path = path
        else:
            unfinished.finish(self._hidden)
            unfinished.begin(path)
            self._hidden = path
        return path

    def keep(self) -> None:
        """Keep this file. An earlier file at `path` is given up, or kept beside it. Raises OSError."""
        if self._hidden is not None:
            with unbroken():
                if self.path.exists() and not made(self.path):
                    self.kept = moved_aside(self.path)
                unfinished.named(self._hidden, self.path)
                unfinished.finish(self._hidden)
                self._hidden = None
        elif self._aside is not None and made(self._aside):
            with contextlib.suppress(OSError):
                self._aside.unlink()
        else:
            self.kept = self._aside
        self._aside = None

    def discard(self) -> None:
        """Discard this file as if it had never existed. Raises OSError."""
        if self._aside is not None:
            self._aside.replace(self.path)
            self._aside = None
        elif self._hidden is None and stat.S_ISREG(os.fstat(self._fd).st_mode):
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Wait a little for the disk; the operating system writes the rest. A file that never got its name is lost."""
        if self._hidden is not None:
            unfinished.remove(self._hidden)
        else:
            self.sync()
        if self._syncing is not None:
            self._syncing.join(SYNC_WAIT_S)
        unlock(self._fd)  # the sync thread may hold the file open for longer
        os.close(self._fd)


def _not_to_be_had(path: Path, error: OSError) -> LogError:
    if folder := no_folder(path):
        return LogError(f"cannot write the log {path}: {folder}")
    return LogError(f"cannot write the log {path}: {error.strerror}; choose another --out, or make the folder writable")


def _here() -> Path:
    try:
        return Path.cwd()
    except OSError:  # the folder was removed
        return Path()


def _sync(fd: int) -> None:
    try:
        os.fdatasync(fd)
    except OSError:
        pass  # the next write fails again, and is reported
    finally:
        os.close(fd)
