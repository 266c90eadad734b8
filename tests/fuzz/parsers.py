"""The libraries that read .mat and .mf4, in one child process that lives on for thousands of damaged files.

daq starts one for each file, which costs seconds. What crashes the child is no finding, since that is what it is for:
it is counted, and another forked from one that has all imported; so is what makes it parse without end. A file that
makes it write elsewhere or start something is a finding.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

ENDLESS_S = 3  # of CPU time: where daq.import_child has a longer patience
RESTART = 5_000  # files: what the libraries do not free must not add up to the bound on memory
CRASHED = 99
DIED, AGAIN = b"D", 7


class Parser:
    """crashes : of the child so far."""

    def __init__(self) -> None:
        self.crashes = 0
        self._suffix = ""
        self._child: subprocess.Popen[bytes] | None = None

    def parse(self, path: Path, out: Path) -> int:
        """The exit status that daq.import_child would have."""
        if self._child is not None and path.suffix != self._suffix:
            self.close()
        if self._child is None:
            command = [sys.executable, str(Path(__file__)), str(path.parent), path.suffix]
            self._child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
            self._suffix = path.suffix
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        try:
            self._child.stdin.write(f"{path}\t{out}\n".encode())
            status = self._child.stdout.read(1)
        except BrokenPipeError:
            status = b""
        except BaseException:  # a hang
            self._child.kill()
            self.close()
            raise
        if not status:
            self.close()
            raise AssertionError("the process that forks the others is gone")
        if status == DIED:
            self.crashes += 1
            return CRASHED
        if status == b"F":
            raise AssertionError("the library did what a reader has no business to do")
        return int(status)

    def close(self) -> None:
        if self._child is not None:
            self._child.communicate()
            self._child = None


def _serve(folder: Path, suffix: str) -> None:
    """Workers one after the other, each until it has had many files or one kills it."""
    from daq.memory import bounded_memory

    if suffix == ".mf4":
        import asammdf  # noqa: F401
    else:
        import scipy.io  # noqa: F401
    answers = os.dup(1)
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    status = AGAIN
    while status:
        worker = os.fork()
        if not worker:
            with bounded_memory(0):
                _work(folder, answers)
        status = os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1])
        if status not in (0, AGAIN):
            os.write(answers, DIED)


def _work(folder: Path, answers: int) -> NoReturn:
    from guard import Forbidden, guarded

    from daq.import_child import main

    for _ in range(RESTART):
        line = os.read(0, 4096).decode()  # the other side writes one line, and waits
        if not line:
            os._exit(0)
        path, out = line.rstrip("\n").split("\t")
        signal.setitimer(signal.ITIMER_PROF, ENDLESS_S)  # its signal kills
        try:
            with guarded(folder):
                status = str(main([path, out, "b1x", "b1y"]))
        except Forbidden:
            status = "F"
        os.write(answers, status.encode())
    os._exit(AGAIN)


if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[2])]
    _serve(Path(sys.argv[1]), sys.argv[2])
