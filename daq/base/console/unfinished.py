"""Files that are not whole yet: whatever ends the program, but kill -9, leaves none of them behind."""

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
    """It is being made; call it `unbroken` together with what makes it."""
    _names.add(path)
    go_on()


def finish(path: Path) -> None:
    """It is whole, or has got its name."""
    _names.discard(path)


def wanted(path: Path) -> bool:
    """Whether it is still being made."""
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
    """At the end of the program: of what was interrupted where nobody could clear it away."""
    with unbroken():
        while _names:
            remove(_names.pop())


@contextmanager
def half(path: Path) -> Iterator[Path]:
    """A place for what is to get the name `path`, in a folder of ours beside it; gone afterwards with what is in it.

    No other user can lay a link there that would have us write elsewhere. Raises OSError.
    """
    with unbroken():
        folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
        begin(folder)
    try:
        yield folder / path.name
    finally:
        remove(folder)


def private(path: Path) -> tuple[int, Path]:
    """A new file of ours beside `path`, open, that is to get its name: no link is followed. Raises OSError."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    return handle, Path(name)


def named(temporary: Path, path: Path) -> None:
    """Give a file made by `private` its name, and let others read it, as a new file. Raises OSError."""
    umask = os.umask(0)
    os.umask(umask)
    os.chmod(temporary, 0o666 & ~umask)
    os.replace(temporary, path)


def led_to(path: Path) -> Path:
    """Where a file of this name goes: a symbolic link stays, and leads there. Raises OSError for one in a circle."""
    if not path.is_symlink():
        return path
    with suppress(FileNotFoundError):  # it leads to nothing yet
        path.stat()
    return Path(os.path.realpath(path))


def write(path: Path, data: bytes) -> None:
    """Write a file so that nobody ever sees half of it. Raises OSError."""
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
