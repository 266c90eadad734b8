"""A growing file on a disk that may be full, stall, or have its folder removed."""

from __future__ import annotations

import os
import threading
from collections import deque
from pathlib import Path

from .errors import LogError

COPY = 1 << 20
SYNC_WAIT_S = 0.3


class LogFile:
    """Bytes written here wait in memory until `push` has them on the disk; a failed push loses and damages nothing.

    Looks like a binary stream to the MCAP writer. One thread.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: deque[memoryview] = deque()
        self._stored = 0
        self.pending = 0
        self._syncing: threading.Thread | None = None
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise LogError(
                f"cannot write the log {path}: {error.strerror}; choose another --out, or make the folder writable"
            ) from error

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
        """Write all that waits. Raises OSError; what was not written still waits, and may be pushed again."""
        while self._waiting:
            head = self._waiting[0]
            written = os.pwrite(self._fd, head, self._stored)
            self._stored += written
            self.pending -= written
            if written == len(head):
                self._waiting.popleft()
            else:
                self._waiting[0] = head[written:]

    def sync(self) -> None:
        """Ask for what was pushed to go from the operating system to the disk: for a power cut, a crash needs none.

        Done by a thread, since a busy disk takes seconds; a request while one is under way is not needed and not kept.
        """
        if self._syncing is None or not self._syncing.is_alive():
            self._syncing = threading.Thread(target=_sync, args=(os.dup(self._fd),), name="log sync", daemon=True)
            self._syncing.start()

    @property
    def removed(self) -> bool:
        """Somebody deleted the file or its folder. The bytes live as long as we hold it open."""
        return os.fstat(self._fd).st_nlink == 0

    def restore(self) -> Path:
        """Give a removed file its name back (or one beside it, if that is taken), whole. Raises OSError."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fd, path = self._free_name()
        try:
            for at in range(0, self._stored, COPY):
                piece = os.pread(self._fd, min(COPY, self._stored - at), at)
                if os.pwrite(fd, piece, at) != len(piece):
                    raise OSError(f"disk full while restoring {path}")
        except OSError:
            os.close(fd)
            path.unlink(missing_ok=True)
            raise
        os.close(self._fd)
        self._fd, self.path = fd, path
        return path

    def _free_name(self) -> tuple[int, Path]:
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        for number in range(1, 1000):
            path = self.path if number == 1 else self.path.with_stem(f"{self.path.stem}-{number}")
            try:
                return os.open(path, flags, 0o644), path
            except FileExistsError:
                continue
        raise OSError(f"no free name beside {self.path}")

    def close(self) -> None:
        """Wait a little for the disk; the operating system finishes the rest."""
        self.sync()
        if self._syncing is not None:
            self._syncing.join(SYNC_WAIT_S)
        os.close(self._fd)


def _sync(fd: int) -> None:
    try:
        os.fdatasync(fd)
    except OSError:
        pass  # the next write says it again, and is reported
    finally:
        os.close(fd)
