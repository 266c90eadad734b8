"""The libraries that read .mat and .mf4, in one child process that lives on for thousands of damaged files; or for
many variables or small files in each request (mat_parts.py, mf4_parts.py), up to what the child would answer.

daq starts one for each file, which costs seconds. What crashes the child is no finding, since that is what it is for:
it is counted, and another forked from one that has all imported; so is what makes it parse without end. A file that
makes it write elsewhere or start something is a finding.
"""

from __future__ import annotations

import gc
import logging
import mmap
import os
import resource
import signal
import subprocess
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from guard import Forbidden, guarded

ENDLESS_S = 3  # of CPU time: where daq.exchange.child has a longer patience
PART_ENDLESS_S, PART_BYTES = 0.02, 64 << 20  # of a part of a kilobyte: a good one takes a hundredth of them
RESTART = 5_000  # files: what the libraries do not free must not add up to the bound on memory
CRASHED = 99
DIED, FOUND, AGAIN = b"D", b"F  ", 7
Reading = Callable[[Sequence[bytes]], Callable[[int], Any]]  # of the inputs of one stream; then of the k-th
PARTS = (".mats", ".mf4s")
WHY = "why"  # the file that says what was found


def members(data: bytes) -> Iterator[bytes]:
    """Each behind its length of two bytes."""
    at = 0
    while at + 2 <= len(data):
        stop = at + 2 + int.from_bytes(data[at : at + 2], "little")
        yield data[at + 2 : stop]
        at = stop


class Parser:
    """crashes : of the child so far."""

    def __init__(self) -> None:
        self.crashes = 0
        self._suffix = ""
        self._status = 0
        self._child: subprocess.Popen[bytes] | None = None

    def parse(self, path: Path, out: Path) -> int:
        """The exit status that daq.exchange.child would have."""
        return CRASHED if self._asked(path, str(out)) is not None else self._status

    def parse_parts(self, path: Path, parts: int) -> None:
        """A file of so many parts, each behind its length."""
        at: int | None = 0
        while at is not None and at < parts:
            died = self._asked(path, str(at))
            at = None if died is None else died + 1

    def _asked(self, path: Path, more: str) -> int | None:
        """Which part the child died of; None if it lives."""
        if self._child is not None and path.suffix != self._suffix:
            self.close()
        if self._child is None:
            command = [sys.executable, str(Path(__file__)), str(path.parent), path.suffix]
            self._child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
            self._suffix = path.suffix
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        try:
            self._child.stdin.write(f"{path}\t{more}\n".encode())
            status = self._child.stdout.read(3)
        except BrokenPipeError:
            status = b""
        except BaseException:  # a hang
            self._child.kill()
            self.close()
            raise
        if not status:
            self.close()
            raise AssertionError("the process that forks the others is gone")
        if status[:1] == DIED:
            self.crashes += 1
            return int.from_bytes(status[1:], "little")
        if status == FOUND:
            why = path.parent / WHY
            text = why.read_text() if why.exists() else ""
            raise AssertionError(
                f"the library did what a reader has no business to do, or we did not expect what it said\n{text}"
            )
        self._status = int(status)
        return None

    def close(self) -> None:
        if self._child is not None:
            self._child.communicate()
            self._child = None


def _serve(folder: Path, suffix: str) -> None:
    """Workers one after the other, each until it has had many files or one kills it."""
    from daq.base.console.memory import bounded_memory
    from daq.exchange.child import answer

    answers = os.dup(1)
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    logging.disable()
    warnings.simplefilter("ignore")
    if suffix in PARTS:
        if suffix == ".mats":
            from mat_parts import variables as reading
            from mat_variables import small_variables as good
        else:
            from mf4_files import small_mf4s as good
            from mf4_parts import files as reading
        pieces = good()
        for k in range(len(pieces)):
            answer(reading(pieces)(k))  # what is lazy is imported
    elif suffix == ".mf4":
        import asammdf  # noqa: F401
    else:
        import scipy.io  # noqa: F401
    at = mmap.mmap(-1, 2)  # which part a worker is at
    gc.collect()
    gc.freeze()
    status = AGAIN
    while status:
        worker = os.fork()
        if not worker:
            if suffix in PARTS:
                _work_parts(folder, answers, reading, at)
            with bounded_memory(0):
                _work(folder, answers)
        status = os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1])
        if status not in (0, AGAIN):
            os.write(answers, DIED + at[:])


def _request() -> tuple[str, str]:
    line = os.read(0, 4096).decode()  # the other side writes one line, and waits
    if not line:
        os._exit(0)
    path, more = line.rstrip("\n").split("\t")
    return path, more


def _work(folder: Path, answers: int) -> NoReturn:
    from daq.exchange.child import main

    for _ in range(RESTART):
        path, out = _request()
        signal.setitimer(signal.ITIMER_PROF, ENDLESS_S)  # its signal kills
        try:
            with guarded(folder):
                status = b"%3d" % main([path, out, "b1x", "b1y"])
        except Forbidden:
            status = FOUND
        os.write(answers, status)
    os._exit(AGAIN)


def _work_parts(folder: Path, answers: int, reading: Reading, at: mmap.mmap) -> NoReturn:
    from daq.exchange.child import answer, refusal

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + PART_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for _ in range(RESTART):
        path, first = _request()
        pieces = list(members(Path(path).read_bytes()))
        status = b"  0"
        at[:] = int(first).to_bytes(2, "little")
        try:
            with guarded(folder):
                read = reading(pieces)
                for k in range(int(first), len(pieces)):
                    at[:] = k.to_bytes(2, "little")
                    signal.setitimer(signal.ITIMER_PROF, PART_ENDLESS_S)
                    try:
                        answer(read(k))
                    except Exception as error:  # noqa: BLE001 - as import_child does
                        refusal(error)
        except BaseException as error:  # noqa: BLE001 - a Forbidden, too
            status = FOUND
            (folder / WHY).write_text("".join(traceback.format_exception(error))[-2000:], errors="replace")
        signal.setitimer(signal.ITIMER_PROF, 0)
        os.write(answers, status)
    os._exit(AGAIN)


if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]
    _serve(Path(sys.argv[1]), sys.argv[2])
