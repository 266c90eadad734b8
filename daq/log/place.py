"""The place of a log: no other writer uses it, and no earlier measurement there is overwritten."""

from __future__ import annotations

import contextlib
import os
import stat
import struct
import time
from pathlib import Path

from daq.base.console.file_kinds import LOG_MAGIC
from daq.base.contract.errors import LogError

from .scan import RECORD_STRUCT

try:
    import fcntl
except ImportError:  # not on Windows, which itself lets nobody write to, or rename, what is open
    fcntl = None  # type: ignore[assignment]

METADATA_OPCODE = 0x0C  # of an MCAP record
HEAD_BYTES = 1 << 16  # the session's metadata record stands within these
REPEATABLE_KINDS = ("simulated", "virtual", "replay", "capture")  # kinds of link that give the same samples again
OPEN_FLAGS = os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0)
READER_S = 0.2  # `being_written` holds a lock for a moment


def locked(fd: int) -> bool:
    """Lock an open log for this writer; False if another process or writer holds it."""
    deadline = time.monotonic() + READER_S
    while fcntl is not None:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                return False
            time.sleep(READER_S / 10)
        except OSError:  # a file system without locks
            break
        else:
            break
    return True


def unlock(fd: int) -> None:
    if fcntl is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(fd, fcntl.LOCK_UN)


def being_written(path: Path) -> bool:
    """Whether another writer is writing this log now."""
    if fcntl is None or path.is_fifo():  # to open a pipe would wait
        return False
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass
    return False


def refused(path: Path) -> LogError:
    return LogError(f"{path}: another rotorscope is writing this log; stop that one, or choose another --out")


def no_file(path: Path) -> LogError:
    return LogError(f"cannot write the log {path}: it is no file, and a log cannot go into a pipe; choose another")


def opened(path: Path, shown: Path) -> int:
    """Descriptor of the file at `path`, created if need be and locked. Raises OSError, or LogError (of `shown`)."""
    if path.is_fifo() or path.is_socket():
        raise no_file(shown)
    while True:
        fd = os.open(path, OPEN_FLAGS, 0o644)
        if not locked(fd):
            os.close(fd)
            raise refused(shown)
        if _lies_at(fd, path):
            return fd
        os.close(fd)  # another writer has just moved or renamed the file, which belongs to it


def _lies_at(fd: int, path: Path) -> bool:
    """Whether an open file is still the one at `path`."""
    try:
        return os.path.samestat(os.fstat(fd), path.stat())
    except (FileNotFoundError, NotADirectoryError):
        return False


def emptied(path: Path, fd: int) -> tuple[int, Path | None]:
    """An empty file at `path`, locked, and the new place of its content; None if there was none, or it stays.

    Raises OSError, and LogError if the content can neither be moved nor made again.
    """
    about = os.fstat(fd)
    if not stat.S_ISREG(about.st_mode) or not about.st_size:
        return fd, None
    try:
        aside = moved_aside(path)
        if aside is None:
            os.ftruncate(fd, 0)
            return fd, None
        new = os.open(path, OPEN_FLAGS | os.O_EXCL, 0o644)
    except BaseException:
        os.close(fd)
        raise
    os.close(fd)
    if (
        not locked(new) or os.fstat(new).st_size or not _lies_at(new, path)
    ):  # another writer took the file before it was locked
        os.close(new)
        raise refused(path)
    return new, aside


def moved_aside(path: Path) -> Path | None:
    """New path of the file at `path` after it was renamed; None if this is impossible and not needed."""
    try:
        return path.rename(free_name(path))
    except OSError as error:
        if made(path):
            return None
        text = f"a file is there, and cannot be kept under another name: {error.strerror or error}"
        raise LogError(f"cannot write the log {path}: {text}; choose another --out") from error


def free_name(path: Path) -> Path:
    """The first free path of NAME-1.mcap, NAME-2.mcap ... above all that are taken."""
    numbers = [0]
    for other in path.parent.iterdir():
        tail = other.stem.removeprefix(f"{path.stem}-")
        if other.suffix == path.suffix and tail != other.stem and tail.isdecimal():
            numbers.append(int(tail))
    return path.with_stem(f"{path.stem}-{max(numbers) + 1}")


def made(path: Path) -> bool:
    """Whether the same command would make this log again: a log of a simulation, a replay or an import.

    A log of a live link cannot be made again, nor a file that is no log.
    """
    try:
        with path.open("rb") as file:
            about = _session(file.read(HEAD_BYTES))
    except OSError:
        return False
    return about.get("link_kind") in REPEATABLE_KINDS or about.get("command") == "import"


def _session(head: bytes) -> dict[str, str]:
    """The metadata of a log, from its first bytes."""
    at = len(LOG_MAGIC)
    while head.startswith(LOG_MAGIC) and at + RECORD_STRUCT.size <= len(head):
        op, length = RECORD_STRUCT.unpack_from(head, at)
        if op == METADATA_OPCODE:
            texts = list(_texts(head[at + RECORD_STRUCT.size : at + RECORD_STRUCT.size + length]))
            return dict(zip(texts[::2], texts[1::2], strict=False))
        at += RECORD_STRUCT.size + length
    return {}


def _texts(content: bytes) -> list[str]:
    """name, then the bytes of all pairs, then key, value ..."""
    (skipped,) = struct.unpack_from("<I", content) if len(content) >= 4 else (0,)
    at, out = 8 + skipped, []
    while at + 4 <= len(content):
        (length,) = struct.unpack_from("<I", content, at)
        out.append(content[at + 4 : at + 4 + length].decode("utf-8", "replace"))
        at += 4 + length
    return out
