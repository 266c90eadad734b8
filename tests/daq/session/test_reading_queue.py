"""The queue's one sentence: when full, the oldest blocks go, and gaps say exactly which."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from promises import within

from daq.session.reading_queue import ReadingQueue
from drivers.contract.reading import Block, Gap, Notice, Reading


def block(index: int, n: int) -> Block:
    return Block(index, np.full((n, 2), index, np.int32), index)


@settings(deadline=None)
@given(lengths=st.lists(st.integers(1, 400), min_size=1, max_size=60), data=st.data())
def test_every_sample_is_delivered_or_named(lengths: list[int], data: st.DataObject) -> None:
    queue = ReadingQueue(limit_bytes=8192)
    index, out, notices = 0, [], 0
    for n in lengths:
        batch: list[Reading] = [block(index, n)]
        if data.draw(st.booleans()):
            batch.append(Notice(0, "info", "x", "y"))
            notices += 1
        queue.put(batch)
        index += n
        if data.draw(st.integers(0, 9)) == 0:
            out += queue.take(0.0)
    while queue.waiting_bytes:
        out += queue.take(0.0)
    assert queue.waiting_bytes == 0
    at = 0
    for reading in out:
        if isinstance(reading, Notice):
            notices -= 1
            continue
        assert reading.index == at
        at += reading.count if isinstance(reading, Gap) else len(reading.counts)
    assert (at, notices) == (index, 0)
    assert queue.dropped == sum(r.count for r in out if isinstance(r, Gap))


def test_memory_is_bounded_and_put_never_waits() -> None:
    queue = ReadingQueue(limit_bytes=100_000)
    start = time.monotonic()
    for k in range(5000):
        queue.put([block(k * 100, 100)])
        assert queue.waiting_bytes <= 100_000
    within(time.monotonic() - start, 2.0)
    first = queue.take(0.0)[0]
    assert isinstance(first, Gap)
    assert (first.index, first.count) == (0, queue.dropped)


def test_a_file_waits_instead() -> None:
    queue = ReadingQueue(limit_bytes=2000, live=False)
    done = threading.Event()

    def produce() -> None:
        for k in range(100):
            queue.put([block(k * 100, 100)])
        queue.end()
        done.set()

    threading.Thread(target=produce).start()
    assert not done.wait(0.05)
    got = 0
    while not queue.ended:
        got += sum(len(r.counts) for r in queue.take(1.0) if isinstance(r, Block))
    assert got == 10_000
    assert queue.dropped == 0


def test_a_failure_of_the_reader_reaches_the_core_loop_after_the_data() -> None:
    queue = ReadingQueue()
    queue.put([block(0, 10)])
    queue.end(RuntimeError("reader died"))
    assert not queue.ended
    assert len(queue.take(0.0)) == 1
    with pytest.raises(RuntimeError, match="reader died"):
        queue.take(0.0)
    assert queue.ended
