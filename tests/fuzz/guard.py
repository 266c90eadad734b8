"""While a guard is on, this thread may write only below one folder, start, connect and unpickle nothing."""

from __future__ import annotations

import os
import sys
import tempfile
import threading

_FORBIDDEN = (
    "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pty.spawn", "socket.connect",
    "socket.bind", "pickle.find_class", "ctypes.dlopen", "webbrowser.open",
)  # fmt: skip
_OURS = ("daq.exchange.child", "drivers.foreign.mf4_capture", "fuzz/parsers.py")  # in these a crash does no harm
_CHANGES = (
    "os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate", "os.chmod",
    "shutil.rmtree",
)  # fmt: skip
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_state = threading.local()
_installed = False


class Forbidden(BaseException):
    """No handler of the code under test catches it."""


class guarded:  # noqa: N801 - used as open() is
    """Raise Forbidden in this thread for everything that reading a file has no business to do."""

    __slots__ = ("_before", "_folder")  # where memory is short Python loses attributes kept in a dictionary

    def __init__(self, folder: os.PathLike[str] | str) -> None:
        self._folder = folder

    def __enter__(self) -> None:
        global _installed
        if not _installed:
            sys.addaudithook(_hook)
            _installed = True
        self._before, tempfile.tempdir = tempfile.tempdir, os.fspath(self._folder)  # libraries may have temporary files
        _state.folder, _state.broken = os.path.realpath(self._folder), ""

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        _state.folder, tempfile.tempdir = None, self._before
        if _state.broken and kind is None:  # somebody swallowed it
            raise Forbidden(_state.broken)


def _hook(event: str, arguments: tuple[object, ...]) -> None:
    folder = getattr(_state, "folder", None)
    if folder is None:
        return
    if event in _FORBIDDEN and not (event == "subprocess.Popen" and any(one in str(arguments[1]) for one in _OURS)):
        _refuse(f"{event} {arguments!r}")
    writing = event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITING
    if writing or event in _CHANGES:
        path, beside = arguments[0], arguments[1] if event in ("os.remove", "os.rmdir") else None
        if isinstance(path, str) and isinstance(beside, int) and beside >= 0:  # relative to an open folder
            path = os.path.join(os.readlink(f"/proc/self/fd/{beside}"), path)
        _check(event, path, folder)


def _check(event: str, path: object, folder: str) -> None:
    if path == os.devnull:
        return
    if isinstance(path, str) and path[: len(folder) + 1] == folder + os.sep:
        name = path[len(folder) + 1 :]
        if name not in ("", ".", "..") and os.sep not in name and not os.path.islink(path):
            return  # straight in it: no need to resolve anything
    if isinstance(path, (str, bytes)):
        real = os.path.realpath(os.fsdecode(path))
        if not (real + os.sep).startswith(folder + os.sep):
            _refuse(f"{event} {path!r}")


def _refuse(text: str) -> None:
    _state.broken = text
    raise Forbidden(text)
