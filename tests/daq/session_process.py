"""A process that acquires without end into a log, for tests that kill it: python session_process.py LOG RATE_FACTOR.

Prints "started" once data flow, and at the end, if it is let, "stopped" and the summary.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from collections.abc import Iterator

from stand_ins import MomentEstimator, ScriptedDriver, info_of, paper_rig, vibration

from daq.log.writer import LogWriter
from daq.session.acquire import acquire_from
from drivers.contract.reading import Reading

BATCH_S = 0.01


def stream(announce: bool = True) -> Iterator[list[Reading]]:
    """256 rows each 10 ms, in real time, stamped by the host."""
    rig = paper_rig()
    yield [info_of(rig)]
    start = time.monotonic_ns()
    for k in range(10**9):
        due = start + k * 10_000_000
        time.sleep(max(0, due - time.monotonic_ns()) / 1e9)
        block = vibration(256 * k, 256)
        yield [type(block)(block.index, block.counts, time.monotonic_ns())]
        if k == 0 and announce:
            print("started", flush=True)


def main() -> None:
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    writer = LogWriter(sys.argv[1])
    seconds = float(sys.argv[2]) if len(sys.argv) > 2 else None
    said: list[str] = []
    summary = acquire_from(
        paper_rig(), ScriptedDriver(stream()), [writer], seconds, stop, make=MomentEstimator,
        notify=lambda n: said.append(n.text),
    )  # fmt: skip
    print("stopped", json.dumps(summary.to_json() | {"said": said}), flush=True)


if __name__ == "__main__":
    main()
