"""CAN traffic in .mf4 files, read in a separate process: python -m drivers.foreign.mf4_capture FILE

Compiled parts of asammdf crash on some damaged files. In a separate process a crash becomes a message and does not end
the service. The process writes parts to standard output: a letter, a length, a content. The first part is OPENED,
UNAVAILABLE or REFUSED; a BATCH for each batch and END follow.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import struct
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from drivers.can.can_frames import CanFrames
from drivers.contract.errors import LinkOpenError, LinkUnavailable

from .capture_batches import Batch, Collector, batches_of

OPENED_TAG, UNAVAILABLE_TAG, REFUSED_TAG, BATCH_TAG, END_TAG = (bytes((letter,)) for letter in b"OURBZ")
_PART_STRUCT = struct.Struct("<cI")  # tag, length
_COUNTS_STRUCT = struct.Struct("<III")  # frames, bytes of the names of the buses, bytes of the reason
LEAST_BYTES, FILE_SIZE_FACTOR = 2 << 30, 100  # memory that the process may take: this, and a multiple of the file
LEAST_S, BYTES_PER_S = 20, 100_000  # and CPU time: on some damaged files asammdf does not come to an end

Opened = TypeVar("Opened")


class Mf4Batches:
    """The batches of a file, as open_capture gives them. The constructor raises LinkOpenError | LinkUnavailable."""

    def __init__(self, file: Path) -> None:
        command = [sys.executable, "-P", "-m", "drivers.foreign.mf4_capture", str(file.resolve())]
        self._child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C reaches the parent only, which closes this process
        )  # fmt: skip
        self._out: Any = self._child.stdout
        kind, content = self._part()
        if kind == OPENED_TAG:
            return
        self.close()
        text = content.decode("utf-8", "replace") or _ended(self._child.returncode)
        if kind == UNAVAILABLE_TAG:
            raise LinkUnavailable(f"capture:{file}: {text}: install the missing library")
        raise LinkOpenError(f"capture:{file}: not a .mf4 file ({text}): check the file")

    def __iter__(self) -> Mf4Batches:
        return self

    def __next__(self) -> Batch:
        if self._out.closed:
            raise StopIteration
        kind, content = self._part()
        if kind == BATCH_TAG:
            return _unpacked(content)
        self.close()
        if kind == END_TAG:
            raise StopIteration
        crashed = Collector()
        crashed.damage(_ended(self._child.returncode))
        return crashed.take()

    def close(self) -> None:
        """End the process at any moment."""
        self._out.close()
        if self._child.poll() is None:
            try:
                self._child.wait(0.2)  # it has ended, or is about to
            except subprocess.TimeoutExpired:
                self._child.kill()
                self._child.wait()

    def _part(self) -> tuple[bytes, bytes]:
        """The next part; two empty ones if the process ended without END."""
        head = self._out.read(_PART_STRUCT.size)
        if len(head) < _PART_STRUCT.size:
            return b"", b""
        kind, size = _PART_STRUCT.unpack(head)
        content = self._out.read(size)
        return (kind, content) if len(content) == size else (b"", b"")


def _packed(batch: Batch) -> bytes:
    f, why, names = batch.frames, batch.why.encode(), json.dumps(batch.names).encode()
    arrays = (f.ids, f.lengths, f.t_ns, f.payload, batch.buses, batch.sent.view(np.uint8), batch.holes)
    head = _COUNTS_STRUCT.pack(len(f), len(names), len(why))
    return head + names + why + b"".join(array.tobytes() for array in arrays)


def _unpacked(content: bytes) -> Batch:
    n, size_names, size_why = _COUNTS_STRUCT.unpack_from(content)
    begin = _COUNTS_STRUCT.size
    at, arrays = begin + size_names + size_why, list[Any]()
    kinds = (
        (np.uint32, n),
        (np.uint8, n),
        (np.int64, n),
        (np.uint8, 64 * n),
        (np.int16, n),
        (np.uint8, n),
        (np.int64, n + 1),
    )
    for kind, count in kinds:
        arrays.append(np.frombuffer(content, kind, count, at))
        at += arrays[-1].nbytes
    ids, lengths, t_ns, payload, buses, sent, holes = arrays
    names = tuple(str(each) for each in json.loads(content[begin : begin + size_names]))
    why = content[begin + size_names : begin + size_names + size_why].decode("utf-8", "replace")
    frames = CanFrames(ids, lengths, payload.reshape(n, 64), t_ns)
    return Batch(frames=frames, buses=buses, names=names, sent=sent.view(np.bool_), holes=holes, why=why)


def _opened_quietly(make: Callable[[], Opened]) -> Opened:
    """Run `make` and discard what asammdf prints: its destructor complains of a damaged file."""
    try:
        return make()
    except ImportError:
        raise
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        traceback.clear_frames(error.__traceback__)
        del error
        gc.collect()
    raise ValueError(text)


def _ended(status: int) -> str:
    if status == -getattr(signal, "SIGXCPU", 0):
        return "the library that reads it comes to no end"
    return f"the library that reads it crashed, status {status}"


def _bounded(file_bytes: int) -> None:
    try:
        import resource
    except ImportError:  # not on this system
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    seconds = LEAST_S + file_bytes // BYTES_PER_S
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    wanted = LEAST_BYTES + FILE_SIZE_FACTOR * file_bytes
    resource.setrlimit(resource.RLIMIT_AS, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))


def _serve(out: BinaryIO, path: Path) -> None:
    def say(kind: bytes, content: bytes = b"") -> None:
        out.write(_PART_STRUCT.pack(kind, len(content)) + content)
        out.flush()

    try:
        import can

        _bounded(path.stat().st_size)
        reader = _opened_quietly(lambda: can.MF4Reader(path))
    except ImportError as error:
        say(UNAVAILABLE_TAG, str(error).encode())
    except Exception as error:  # a damaged file may raise anything in the library
        say(REFUSED_TAG, str(error).encode())
    else:
        say(OPENED_TAG)
        for batch in batches_of(reader, path):
            say(BATCH_TAG, _packed(batch))
        say(END_TAG)


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of a library must not mix with the parts
    try:
        _serve(answers, Path(sys.argv[1]))
    except BrokenPipeError:
        os._exit(0)  # nobody wants the rest
