"""A separate process for Rerun, so that a viewer that hangs or dies stops nothing else.

Started by process.py as `python -m daq.report.rerun.child TARGET`. Takes pickled batches from its parent on standard
input, answers each with a line: "+" (shown, and the viewer took it) or "! why". A RecordingStream connected to a
viewer that stalls blocks for ever inside native code; the watchdog then ends the process.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import pickle
import signal
import sys
from collections.abc import Iterator
from typing import BinaryIO

WATCHDOG_S = 15.0
FLUSH_S = 4.0


def main(target: str, source: BinaryIO, answers: BinaryIO) -> int:
    """Draw what comes until the end of the input; 0 if everything reached the target."""
    import rerun as rr

    from .view import RerunView

    session = pickle.load(source)
    recording = rr.RecordingStream("rotorscope", recording_id=session.recording_id)
    rr.set_log_time_enabled(False, recording=recording)
    rr.set_log_tick_enabled(False, recording=recording)
    with watchdog():
        if target.startswith("rerun"):
            recording.connect_grpc(target)
        else:
            # The footer is an index of all chunks, kept in memory until the end: 4 MB a minute. Viewers do without it.
            recording.save(target, write_footer=False)
        view = RerunView(recording, session)
        recording.flush(timeout_sec=FLUSH_S)
    answer(answers, "+")
    while True:
        try:
            batch = pickle.load(source)
        except EOFError:
            break
        with watchdog():
            for item in batch:
                view.take(item)
            recording.flush(timeout_sec=FLUSH_S)  # raises when the viewer has gone; nothing else shows it
        answer(answers, "+")
    with watchdog():
        view.close()
        recording.flush(timeout_sec=FLUSH_S)
        recording.disconnect()
    answer(answers, "+")
    return 0


@contextlib.contextmanager
def watchdog() -> Iterator[None]:
    """End this process, whatever holds the interpreter lock, if the body takes too long."""
    faulthandler.dump_traceback_later(WATCHDOG_S, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


def answer(answers: BinaryIO, line: str) -> None:
    answers.write(line.replace("\n", " ").encode() + b"\n")
    answers.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's; it closes the input
    with contextlib.suppress(OSError):
        os.nice(5)
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what native code prints is not an answer
    try:
        sys.exit(main(sys.argv[1], sys.stdin.buffer, replies))
    except Exception as problem:  # the parent gets the text, counts and tries again
        with contextlib.suppress(OSError):
            answer(replies, f"! {type(problem).__name__}: {problem}")
        sys.exit(1)
