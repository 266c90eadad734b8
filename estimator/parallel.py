"""Work on two cores at once: in threads where the arrays are large, as numpy, scipy.fft and numba let go of the
interpreter; in two processes where it is many small steps, which hold it."""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from typing import Any, TypeVar

CORES = 2
PATIENCE = 100  # turns given to threads that have ended but are not gone
T = TypeVar("T")
R = TypeVar("R")


def map_threads(function: Callable[[T], R], items: Iterable[T], done: Callable[[int], None] | None = None) -> list[R]:
    """function of every item, in order, two at a time; `done` hears in this thread how many there are so far.

    The first exception is raised.
    """
    out: list[R] = []
    with ThreadPoolExecutor(CORES) as pool:
        for result in pool.map(function, items):
            out.append(result)
            if done is not None:
                done(len(out))
    return out


def map_processes(
    questions: Sequence[Callable[[], R]], kept: Sequence[object] = (), done: Callable[[int], None] | None = None
) -> list[R]:
    """The answers, in order, of two processes that take one question after the other; `done` hears about how far they
    are. In threads of one process where it has others already, or no fork.

    The second process is a copy of this one and ends with the call. What it finds comes back pickled, but for the
    objects `kept`: laws and the like, which cannot be. What it cannot answer is asked here, and raises here.
    """
    if len(questions) < 2 or not _alone():
        return map_threads(lambda question: question(), questions, done)
    todo, supply = os.pipe()
    os.write(supply, b"".join(k.to_bytes(2, "little") for k in range(len(questions))))
    os.close(supply)
    back, found = os.pipe()
    parent, copy = os.getpid(), _forked()
    if copy == 0:
        os.close(back)  # so that it cannot wait for ever for a reader that is gone
        _answer_in_copy(questions, kept, todo, found, parent)
    os.close(found)
    out, data, status = {}, b"", -1
    try:
        while (k := _next(todo)) is not None:
            out[k] = questions[k]()
            if done is not None:
                done(k + 1)
        with os.fdopen(back, "rb", closefd=False) as pipe:
            data = pipe.read()
    except BaseException:
        if copy:
            os.kill(copy, signal.SIGKILL)
        raise
    finally:
        os.close(todo)
        os.close(back)
        if copy:
            _, status = os.waitpid(copy, 0)
    if status == 0 and data:
        out |= _unpickled(data, kept)
    return [out[k] if k in out else question() for k, question in enumerate(questions)]


def _alone() -> bool:
    """Whether this process has one thread, so that a copy of it finds no lock that nobody will open."""
    if not hasattr(os, "fork") or not os.path.isdir("/proc/self/task"):
        return False
    for _ in range(PATIENCE):
        if len(os.listdir("/proc/self/task")) == 1:
            return True
        os.sched_yield()
    return False


def _forked() -> int | None:
    """As os.fork; None where the machine has no room for another process."""
    try:
        return os.fork()
    except OSError:
        return None


def _answer_in_copy(
    questions: Sequence[Callable[[], Any]], kept: Sequence[object], todo: int, found: int, parent: int
) -> None:
    """What the second process does; it never returns."""
    try:
        out = {}
        while os.getppid() == parent and (k := _next(todo)) is not None:
            out[k] = questions[k]()
        with os.fdopen(found, "wb") as pipe:
            pipe.write(_pickled(out, kept))
    except BaseException:  # asked again, and raised, where it is waited for
        os._exit(1)
    os._exit(0)


def _next(todo: int) -> int | None:
    """The number of the next question: whoever reads it first has it."""
    read = os.read(todo, 2)
    return int.from_bytes(read, "little") if read else None


def _pickled(found: Any, kept: Sequence[object]) -> bytes:
    at = {id(one): k for k, one in enumerate(kept)}
    stream = BytesIO()
    pickler = pickle.Pickler(stream, protocol=5)
    pickler.persistent_id = lambda one: at.get(id(one))  # type: ignore[method-assign]
    pickler.dump(found)
    return stream.getvalue()


def _unpickled(data: bytes, kept: Sequence[object]) -> dict[int, Any]:
    unpickler = pickle.Unpickler(BytesIO(data))
    unpickler.persistent_load = lambda k: kept[k]  # type: ignore[method-assign]
    return dict(unpickler.load())
