"""Removes incomplete files when the program ends, however it ends but by kill -9."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .stop import go_on, unbroken

_names: set[Path] = set()


def begin(path: Path) -> None:
    """Mark a file as being written; call this `unbroken` together with its creation."""
    _names.add(path)
    go_on()


def finish(path: Path) -> None:
    """Mark a file as complete."""
    _names.discard(path)


def wanted(path: Path) -> bool:
    """Whether a file is still being written."""
    return path in _names


def remove(path: Path) -> None:
    with unbroken():
        _names.discard(path)
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


@atexit.register
def remove_all() -> None:
    """Remove all incomplete files at the end of the program."""
    with unbroken():
        while _names:
            remove(_names.pop())


@contextmanager
def half(path: Path) -> Iterator[Path]:
    """A temporary path for a file that is to become `path`, in a private folder beside it that is removed afterwards.

    No other user can place a link there that would redirect the writing. Raises OSError.
    """
    with unbroken():
        folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
        begin(folder)
    try:
        yield folder / path.name
    finally:
        remove(folder)


def private(path: Path) -> tuple[int, Path]:
    """A new private file beside `path`, open, that is to get its name; no link is followed. Raises OSError."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    return handle, Path(name)


def named(temporary: Path, path: Path) -> None:
    """Give a file made by `private` its name, and let others read it, as a new file. Raises OSError."""
    umask = os.umask(0)
    os.umask(umask)
    os.chmod(temporary, 0o666 & ~umask)
    os.replace(temporary, path)


def led_to(path: Path) -> Path:
    """The path that is written for this name: a symbolic link is followed. Raises OSError for a circle of links."""
    if not path.is_symlink():
        return path
    with suppress(FileNotFoundError):  # it leads to nothing yet
        path.stat()
    return Path(os.path.realpath(path))


def write(path: Path, data: bytes) -> None:
    """Write a file so that no reader ever sees half of it. Raises OSError."""
    if path.exists() and not path.is_file():  # /dev/stdout, a named pipe
        path.write_bytes(data)
        return
    path = led_to(path)
    with unbroken():
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
            named(Path(name), path)
        except BaseException:
            os.unlink(name)
            raise
