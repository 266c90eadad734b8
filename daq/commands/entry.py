"""Where the program begins: an interrupt while Python still imports ends it quietly."""

from __future__ import annotations

import atexit
import gc
import io
import os
import signal
import sys
import threading
import warnings
from typing import NoReturn

from daq.base.console.stop import interrupt

INTERRUPTED_STATUS = 130  # 128 + SIGINT
AGAIN_S = 0.05  # by then a callback of Python's has ended
GARBAGE_OBJECTS = 100_000  # new ones between two searches for garbage: what is imported is none (saves 0.2 s)


def main() -> NoReturn:
    """Run the command line, and end with its status."""
    _fill_closed()
    _say_anything()
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # a background job ignores it
    if handled:
        signal.signal(signal.SIGINT, _leave)
    if sys.argv[1:2] == ["run"] and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _stopped)  # until the session sets its handler
    gc.set_threshold(GARBAGE_OBJECTS)
    # a fit that leaves the rotor overflows before it says so in one line
    warnings.filterwarnings("ignore", ".* encountered in ", RuntimeWarning, "estimator")
    from . import cache_place

    cache_place.choose()
    cache_place.clean()
    from daq.commands.cli.app import main as run

    sys.unraisablehook = _unless_interrupted
    try:
        if handled:
            signal.signal(signal.SIGINT, interrupt)
        status = run()
        _drop_unsaid()
        if handled:
            signal.signal(signal.SIGINT, _leave)
        _end(status)
    except KeyboardInterrupt:
        _leave()


def _unless_interrupted(what: sys.UnraisableHookArgs) -> None:
    """Repeat an interrupt that Python could not raise within a callback, once the callback has ended."""
    if what.exc_type is KeyboardInterrupt:
        threading.Timer(AGAIN_S, _again).start()
    else:
        sys.__unraisablehook__(what)


def _again() -> None:
    if signal.getsignal(signal.SIGINT) is interrupt:  # else the handler of a command has seen it
        os.kill(os.getpid(), signal.SIGINT)  # the main thread's, also where it waits


def _say_anything() -> None:
    """Let the streams print any text, also names of files that are no text and letters that a terminal lacks."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _fill_closed() -> None:
    """Open closed standard streams to nowhere: else the next file, a log, would get their number."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8", closefd=False))  # noqa: SIM115


def _drop_unsaid() -> None:
    """Discard unwritten output, which stays in the buffer and would make Python end with status 120."""
    from daq.base.console.output import to_nowhere

    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            to_nowhere(stream)


def _end(status: int) -> NoReturn:
    """End at once, after all output. Threads that still compute, and the release of imported modules, would delay the
    end of a stopped session by seconds on a busy machine.
    """
    atexit._run_exitfuncs()
    os._exit(status)


def _stopped(*_: object) -> NoReturn:
    """Handle SIGTERM before or after a session: end with the status of a stopped session."""
    os._exit(0)


def _leave(*_: object) -> NoReturn:
    """Handle SIGINT before a command has started or after it has ended: remove unfinished files, and end."""
    remove_all = getattr(
        sys.modules.get("daq.base.console.unfinished"), "remove_all", None
    )  # none while that is imported
    if remove_all is not None:
        remove_all()
    os.write(2, b"rotorscope: interrupted\n")
    os._exit(INTERRUPTED_STATUS)
