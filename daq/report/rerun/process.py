"""The parent's end of the process that draws (child.py): every step has a time-out."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import pickle
import select
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from daq.base.console.output import check_place
from daq.base.contract.errors import ConfigError

from .view import ViewSession

START_S, ANSWER_S = 60.0, 6.0  # a busy machine takes long to import it
VIEWER_PORT = 9876


class ViewerGone(OSError):
    """The viewer or the process that feeds it ended, stalled, or refused."""


def viewer_target(text: str) -> str:
    """A .rrd path, "spawn" or a rerun URL, in full form; ConfigError if it is none of these."""
    if text == "spawn":
        return text
    if "://" in text:
        url = urlsplit(text)
        if url.scheme in ("rerun", "rerun+http", "rerun+https") and url.hostname:
            return text if url.path.strip("/") else f"{url.scheme}://{url.netloc}/proxy"
    elif text.endswith(".rrd"):
        check_place("--rerun", Path(text))
        return text
    raise ConfigError(f"--rerun {text}: give a file ending in .rrd, spawn, or rerun+http://HOST:{VIEWER_PORT}/proxy")


def answers(url: str, timeout_s: float = 0.5) -> bool:
    """True if something accepts connections at the URL's host and port."""
    parts = urlsplit(url)
    port = parts.port or (443 if parts.scheme != "rerun+http" else VIEWER_PORT)
    with contextlib.suppress(OSError), socket.create_connection((parts.hostname or "", port), timeout_s):
        return True
    return False


def start_viewer(port: int = VIEWER_PORT) -> subprocess.Popen[bytes]:
    """Rerun's viewer, listening on 127.0.0.1 only; it outlives us, as a window of the user's.

    Not rr.spawn(): that listens on every interface. Not the `rerun` script: its child outlives a kill.
    """
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise ViewerGone("no rerun viewer beside rerun-sdk: install rerun-sdk again, or give a URL")
    binary = Path(package.origin).with_name("rerun")
    command = [str(binary), "--bind", "127.0.0.1", "--port", str(port), "--memory-limit", "2GB", "--expect-data-soon"]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)


class ViewerProcess:
    """One run of the drawing process. Any failure raises ViewerGone. One thread owns it; any may `kill` it."""

    def __init__(self, target: str) -> None:
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "RUST_LOG": "off"}
        self._child = subprocess.Popen(
            [sys.executable, "-P", "-m", "daq.report.rerun.child", target],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        if self._child.stdin is None or self._child.stdout is None:  # never, with PIPE
            raise ViewerGone("no pipe to the drawing process")
        self._in, self._out = self._child.stdin.fileno(), self._child.stdout.fileno()
        os.set_blocking(self._in, False)
        os.set_blocking(self._out, False)
        self._unread = b""

    def start(self, session: ViewSession) -> None:
        """Connect or create the file, and send the layout."""
        self._exchange(session, START_S)

    @property
    def pid(self) -> int:
        return self._child.pid

    def send(self, batch: Sequence[Any]) -> None:
        """Draw the batch; returns when the viewer has taken it."""
        self._exchange(list(batch), ANSWER_S)

    def finish(self, timeout_s: float) -> None:
        """End of the session: the recording is closed and complete."""
        if self._child.stdin is not None:
            self._child.stdin.close()
        try:
            self._answer(time.monotonic() + timeout_s)
            self._child.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise ViewerGone("the drawing process does not end") from None

    def kill(self) -> None:
        """End the process at once, even if it hangs; the owner's call then fails."""
        self._child.kill()

    def close(self) -> None:
        """Leave nothing behind. Idempotent; the owner's."""
        self._child.kill()
        self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()

    def _exchange(self, message: object, timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        data = memoryview(pickle.dumps(message, protocol=5))
        while data:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([], [self._in], [], left)[1]:
                raise ViewerGone(f"no progress for {timeout_s:g} s")
            try:
                data = data[os.write(self._in, data[:65536]) :]
            except BlockingIOError:
                continue
            except OSError:
                break  # the child has ended: its last words follow
        self._answer(deadline)

    def _answer(self, deadline: float) -> None:
        while b"\n" not in self._unread:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([self._out], [], [], left)[0]:
                raise ViewerGone("it does not answer")
            more = os.read(self._out, 4096)
            if not more:
                raise ViewerGone("the drawing process ended")
            self._unread += more
        line, self._unread = self._unread.split(b"\n", 1)
        if line != b"+":
            raise ViewerGone(line[2:].decode(errors="replace"))
