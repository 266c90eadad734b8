"""What every sink must satisfy; a new one goes into SINKS and cannot avoid it."""

from __future__ import annotations

import io
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from promises import PATIENCE_S, within
from sessions import RATE_HZ, counts_at, feed, make_block, make_estimate, make_session, make_status, make_stream

from daq.base.contract.sink import Reporting, Sink
from daq.commands.live.devices_table import DeviceRow
from daq.log.reader import read_log
from daq.log.writer import LogWriter
from daq.report.metrics import MetricsServer
from daq.report.rerun.sink import RerunSink
from daq.session.replay import EstimateCheck
from drivers.contract.reading import Block, Gap, Info, Notice, Reading, Signal


def estimate_check(folder: Path) -> Sink:
    writer = LogWriter(folder / "reference.mcap", live=False)
    feed(writer, make_stream())
    writer.close()
    return EstimateCheck(read_log(folder / "reference.mcap"))


def live_table(folder: Path) -> Sink:
    from rich.console import Console

    from daq.report.live_table import LiveTable

    return LiveTable(Console(file=io.StringIO(), force_terminal=True))


SINKS: dict[str, Callable[[Path], Sink]] = {
    "log": lambda folder: LogWriter(folder / "a.mcap"),
    "log, waiting": lambda folder: LogWriter(folder / "a.mcap", live=False),
    "rerun": lambda folder: RerunSink(str(folder / "a.rrd")),
    "metrics": lambda folder: MetricsServer(0).sink(),
    "check": estimate_check,
    "table": live_table,
    "row of a table": lambda folder: DeviceRow("press"),
}
LIVE = [name for name in SINKS if name != "log, waiting"]


@pytest.fixture(params=SINKS)
def sink(request: pytest.FixtureRequest, tmp_path: Path) -> Sink:
    return SINKS[request.param](tmp_path)


def assert_healthy(sink: Sink) -> None:
    if isinstance(sink, Reporting):
        assert [n.text for n in sink.health().notices if n.level == "error"] == []


def test_a_session_with_everything(sink: Sink) -> None:
    feed(sink, make_stream())
    sink.close()
    assert_healthy(sink)


def test_what_it_is_given_is_not_changed_or_kept(sink: Sink) -> None:
    """The core loop may reuse nothing, and a sink may change nothing: counts are the same afterwards."""
    stream = make_stream()
    before = [r.counts.copy() for r in stream if isinstance(r, Block)]
    feed(sink, stream)
    sink.close()
    after = [r.counts for r in stream if isinstance(r, Block)]
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_nothing_but_start_and_close(sink: Sink) -> None:
    sink.start(make_session())
    sink.close()
    assert_healthy(sink)


def test_closed_without_ever_being_started(sink: Sink) -> None:
    sink.close()
    assert_healthy(sink)


def test_closing_twice_is_harmless(sink: Sink) -> None:
    feed(sink, make_stream(5))
    sink.close()
    sink.close()


def test_odd_readings(sink: Sink) -> None:
    """Empty batches and blocks, one row, a gap of ages, huge counts, odd texts, a new range, a new rate."""
    signals = make_session().info.signals
    odd: list[Reading] = [
        Block(0, np.empty((0, 4), np.int32), 10**12),
        make_block(0, 1),
        Gap(1, 10**11, "silent"),
        Block(10**11 + 1, np.full((3, 4), np.iinfo(np.int32).min, np.int32), 10**12),
        Notice(0, "info", "code", "Grüße\x00 \N{SNOWMAN} 'quoted' {braces}"),
        Notice(0, "unheard of", "", ""),
        Info(tuple(Signal(s.name, s.unit, 2 * s.scale, 1.0) for s in signals), RATE_HZ, "", 24),
        make_block(10**11 + 4, 700),
        Info(signals, 1000.0),
        make_block(10**11 + 704, 700, device=False),
    ]
    sink.start(make_session())
    sink.readings([])
    sink.readings(odd)
    sink.close()
    assert_healthy(sink)


def test_estimates_without_readings_and_of_every_kind(sink: Sink) -> None:
    sink.start(make_session())
    for index in range(6):
        sink.estimate(make_estimate(index))
        sink.status(make_status(index))
    sink.close()
    assert_healthy(sink)


@pytest.mark.parametrize("name", LIVE)
def test_no_call_makes_the_core_loop_wait(name: str, tmp_path: Path) -> None:
    """20 s of four channels as fast as they can be made: no call takes 0.25 s."""
    sink = SINKS[name](tmp_path)
    sink.start(make_session())
    slowest = 0.0
    counts = counts_at(0, 512)
    for k in range(1000):
        begin = time.perf_counter()
        sink.readings([Block(512 * k, counts, 10**12 + k * 20_000_000, None)])
        if k % 25 == 0:
            sink.estimate(make_estimate(512 * k))
            sink.status(make_status(512 * k))
        slowest = max(slowest, time.perf_counter() - begin)
    begin = time.perf_counter()
    sink.close()
    took = time.perf_counter() - begin
    within(slowest, 0.25)
    within(took, 5.0)


def test_no_thread_and_no_handle_stays(tmp_path: Path) -> None:
    for make in SINKS.values():  # what is made once and stays, such as the viewer's library
        warm = make(tmp_path)
        feed(warm, make_stream(5))
        warm.close()
    for name, make in SINKS.items():
        threads, handles = set(threading.enumerate()), len(os.listdir("/proc/self/fd"))
        for _ in range(2):
            sink = make(tmp_path)
            feed(sink, make_stream(5))
            sink.close()
        end = time.monotonic() + PATIENCE_S  # a thread that was told to end may need a moment
        while (left := set(threading.enumerate()) - threads) and time.monotonic() < end:
            time.sleep(0.05)
        assert left == set(), name
        assert len(os.listdir("/proc/self/fd")) <= handles + 1, name
