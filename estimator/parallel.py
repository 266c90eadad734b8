"""Work on two cores at once.

Threads suit large arrays: numpy, scipy.fft and numba release the interpreter. Two processes suit many small steps,
which hold the interpreter.
"""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from io import BytesIO
from typing import Any, TypeVar

MAX_THREADS = 2
MAX_YIELDS = 100  # scheduler turns given to threads that have ended but are still listed
T = TypeVar("T")
R = TypeVar("R")
_ONE_CORE = ContextVar("one core", default=False)


@contextmanager
def one_core() -> Iterator[None]:
    """Context in which this thread computes everything itself: for callers that have other work for the other cores.

    Results are the same.
    """
    token = _ONE_CORE.set(True)
    try:
        yield
    finally:
        _ONE_CORE.reset(token)


def _map_here(function: Callable[[T], R], items: Iterable[T], done: Callable[[int], None] | None) -> list[R]:
    """The results of a function for every item, computed one after another."""
    out: list[R] = []
    for item in items:
        out.append(function(item))
        if done is not None:
            done(len(out))
    return out


def map_threads(function: Callable[[T], R], items: Iterable[T], done: Callable[[int], None] | None = None) -> list[R]:
    """The results of a function for every item, in order, computed in two threads.

    Parameters
    ----------
    function : callable
        Applied to each item.
    items : iterable
        Its arguments.
    done : callable or None
        Called in this thread with the number of results so far; None: no report.

    Raises
    ------
    Exception
        The first exception of `function`.
    """
    if _ONE_CORE.get():
        return _map_here(function, items, done)
    out: list[R] = []
    with ThreadPoolExecutor(MAX_THREADS) as pool:
        for result in pool.map(function, items):
            out.append(result)
            if done is not None:
                done(len(out))
    return out


def map_processes(
    questions: Sequence[Callable[[], R]], kept: Sequence[object] = (), done: Callable[[int], None] | None = None
) -> list[R]:
    """The results of functions without arguments, in order, computed by two processes.

    The second process is a fork of this one and ends with the call. It runs in threads instead where this process has
    other threads already, or where there is no fork. A function that fails in the second process is called again here,
    and raises here.

    Parameters
    ----------
    questions : sequence of callable
        The functions. Each process takes the next one when it is free.
    kept : sequence of object
        Objects that results of the second process may hold but that cannot be pickled, such as laws: references to
        them are sent.
    done : callable or None
        Called with the approximate number of results so far; None: no report.
    """
    if len(questions) < 2 or _ONE_CORE.get() or not _alone():
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


def map_single_core(questions: Sequence[Callable[[], R]]) -> list[R]:
    """The results of functions, as of `map_processes`, where each of several has one core.

    None of them starts threads or processes of its own.
    """
    if len(questions) == 1:
        return [questions[0]()]

    def on_one_core(question: Callable[[], R]) -> R:
        with one_core():
            return question()

    return map_processes([partial(on_one_core, question) for question in questions])


def _alone() -> bool:
    """Whether this process has one thread. A fork of several threads may inherit a lock that nobody opens."""
    if not hasattr(os, "fork") or not os.path.isdir("/proc/self/task"):
        return False
    for _ in range(MAX_YIELDS):
        if len(os.listdir("/proc/self/task")) == 1:
            return True
        os.sched_yield()
    return False


def _forked() -> int | None:
    """The process id that os.fork returns; None where the machine has no room for another process."""
    try:
        return os.fork()
    except OSError:
        return None


def _answer_in_copy(
    questions: Sequence[Callable[[], Any]], kept: Sequence[object], todo: int, found: int, parent: int
) -> None:
    """Run the second process. It never returns."""
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
    """The number of the next function, from a pipe that both processes read; None at its end."""
    read = os.read(todo, 2)
    return int.from_bytes(read, "little") if read else None


def _pickled(found: Any, kept: Sequence[object]) -> bytes:
    """The results as bytes, objects of `kept` by their number."""
    at = {id(one): k for k, one in enumerate(kept)}
    stream = BytesIO()
    pickler = pickle.Pickler(stream, protocol=5)
    pickler.persistent_id = lambda one: at.get(id(one))  # type: ignore[method-assign]
    pickler.dump(found)
    return stream.getvalue()


def _unpickled(data: bytes, kept: Sequence[object]) -> dict[int, Any]:
    """The results of `_pickled`."""
    unpickler = pickle.Unpickler(BytesIO(data))
    unpickler.persistent_load = lambda k: kept[k]  # type: ignore[method-assign]
    return dict(unpickler.load())
