"""From a serial link to log, viewer and estimate: what it costs, beside doing it one sample at a time.

pytest -m bench tests/bench/test_bench_pipeline.py -s
"""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest
from device_process import frames, resonance
from mcap.reader import make_reader
from mcap.writer import Writer
from reference_rig import rig_record
from sessions import feed, make_session
from stand_ins import paper_rig

from daq.base.contract.sink import Session, Sink, Status
from daq.log.reader import read_log
from daq.log.writer import LogWriter
from daq.report.rerun.sink import RerunSink
from daq.session.acquire import RunSummary, acquire_from
from daq.session.estimators import ESTIMATOR_OF_METHOD, MakeEstimator, maker
from daq.session.layer_watch import LayerWatch
from daq.session.naming import Naming
from daq.session.replay import replay_into
from drivers.contract.reading import Block, Driver, Reading
from drivers.links.links import make_driver, parse_link
from estimator.results import Estimate

pytestmark = [pytest.mark.bench, pytest.mark.timeout(900)]
HERE = Path(__file__).parent
RIG = paper_rig()
ROWS = 64


def estimators() -> list[str]:
    """The methods that are there."""
    from importlib.util import find_spec

    return [method for method, (module, _) in ESTIMATOR_OF_METHOD.items() if find_spec(module)]


class Opened:
    """A driver that says when it is open."""

    def __init__(self, driver: Driver, process: subprocess.Popen[str]) -> None:
        self._driver, self._process = driver, process
        self.kind, self.stats = driver.kind, driver.stats

    def open(self) -> None:
        self._driver.open()
        assert self._process.stdin is not None
        self._process.stdin.write("go\n")
        self._process.stdin.flush()

    def close(self) -> None:
        self._driver.close()

    def read(self, timeout_s: float) -> list[Reading]:
        return self._driver.read(timeout_s)

    @property
    def exhausted(self) -> bool:
        return self._driver.exhausted


@dataclass
class Arrivals:
    """A sink behind the log: when each estimate had been handed to the log."""

    def __post_init__(self) -> None:
        self.times_ns: list[int] = []
        self.first_ns = self.last_ns = 0

    def start(self, session: Session) -> None: ...

    def readings(self, batch: Sequence[Reading]) -> None:
        if any(isinstance(r, Block) for r in batch):
            self.last_ns = time.monotonic_ns()
            self.first_ns = self.first_ns or self.last_ns

    def estimate(self, estimate: Estimate) -> None:
        self.times_ns.append(time.monotonic_ns())

    def status(self, status: Status) -> None: ...

    def close(self) -> None: ...


@contextmanager
def device(rate_hz: float, seconds: float, stamps: Path) -> Iterator[Opened]:
    command = [sys.executable, str(HERE / "device_process.py"), str(rate_hz), str(seconds), str(stamps)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = process.stdout.readline().strip()
        try:
            yield Opened(make_driver(parse_link(f"serial:{port}")), process)
        finally:
            process.kill()


def run(folder: Path, rate_hz: float, seconds: float, make: MakeEstimator) -> tuple[RunSummary, float, Arrivals]:
    """A session of `seconds` with log, viewer file and estimator; its CPU use (cores) while data came."""
    arrivals = Arrivals()
    sinks: list[Sink] = [LogWriter(folder / "a.mcap"), RerunSink(str(folder / "a.rrd")), arrivals]
    with device(rate_hz, seconds + 0.5, folder / "stamps") as driver:
        begin = {}
        read = driver.read

        def first(timeout_s: float) -> list[Reading]:
            out = read(timeout_s)
            if any(isinstance(r, Block) for r in out) and not begin:
                begin["cpu"], begin["wall"] = time.process_time(), time.monotonic()
            return out

        driver.read = first  # type: ignore[method-assign]
        summary = acquire_from(RIG, driver, sinks, seconds, make=make)
    cpu = (time.process_time() - begin["cpu"]) / (time.monotonic() - begin["wall"])
    return summary, cpu, arrivals


def naive(rate_hz: float, seconds: float, folder: Path) -> float:
    """One frame, one sample, one message at a time: samples per second of CPU."""
    _, made = frames(rate_hz, seconds)
    begin = time.process_time()
    writer = Writer(str(folder / "naive.mcap"))
    writer.start()
    channel = writer.register_channel("/raw", "x", writer.register_schema("x", "", b""))
    rows = 0
    for frame in made:
        body, at = bytearray(), 0
        while at < len(frame) - 1:
            code = frame[at]
            body += frame[at + 1 : at + code]
            at += code
            if code < 255 and at < len(frame) - 1:
                body.append(0)
        assert zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little")
        for sample in struct.iter_unpack("<4h", body[24:-4]):
            values = [c * 0.015 for c in sample]
            writer.add_message(channel, rows, struct.pack("<4d", *values), rows)
            rows += 1
    writer.finish()
    return rows / (time.process_time() - begin)


@pytest.mark.parametrize("method", estimators())
def test_400_thousand_samples_a_second_without_a_gap(tmp_path: Path, method: str) -> None:
    rate_hz, seconds = 400e3, 8.0
    summary, cpu, _ = run(tmp_path, rate_hz, seconds, maker(method, 10.0))
    peer = naive(rate_hz, 0.5, tmp_path)
    print(
        f"\nserial pty -> MCAP + Rerun + {method} at {rate_hz / 1e3:.0f} kS/s of 4 channels: "
        f"{summary.lost_samples} lost of {summary.samples}, {100 * cpu:.0f} % of a core "
        f"({rate_hz / cpu / 1e3:.0f} kS/s per core); "
        f"one sample at a time to MCAP alone: {peer / 1e3:.0f} kS/s per core"
    )
    assert summary.lost_samples == 0
    assert summary.samples == rate_hz * seconds
    log = read_log(tmp_path / "a.mcap")
    assert log.complete
    assert log.n_samples == summary.samples
    assert (
        rate_hz / cpu > {"score-matching": 2, "spectral": 1}[method] * peer
    )  # the spectral one is several times the work


@pytest.mark.parametrize("method", estimators())
def test_60_thousand_samples_a_second_on_less_than_a_fifth_of_a_core(tmp_path: Path, method: str) -> None:
    """Half a minute from the start of the session, the first fit included: that takes a second."""
    summary, cpu, _ = run(tmp_path, 60e3, 30.0, maker(method, 10.0))
    print(f"\n60 kS/s of 4 channels, {method}: {summary.lost_samples} lost, {100 * cpu:.1f} % of a core (asked: 20)")
    assert summary.lost_samples == 0
    assert cpu < 0.20 * 1.5  # budget with room for a busy machine


@pytest.mark.parametrize("method", estimators())
def test_last_byte_to_logged_estimate(tmp_path: Path, method: str) -> None:
    """A minute from the start of the session, the estimator's first solution included."""
    seconds = 60.0
    summary, _, arrivals = run(tmp_path, 25_600.0, seconds, maker(method, 10.0))
    stamps = np.fromfile(tmp_path / "stamps", np.int64)
    assert summary.lost_samples == 0
    due = 12 * 1024  # an estimate at each multiple of it
    latency_ms = [
        (t_ns - stamps[(k + 1) * due // ROWS - 1]) / 1e6
        for k, t_ns in enumerate(arrivals.times_ns[: int(seconds * 25_600) // due])
    ]
    p50, p99 = np.percentile(latency_ms, [50, 99])
    print(
        f"\nlast byte sent to estimate logged, {method}: p50 {p50:.1f} ms, p99 {p99:.1f} ms (asked: 50), "
        f"worst {max(latency_ms):.0f} ms of {len(latency_ms)}; load {os.getloadavg()[0]:.0f}"
    )
    assert p99 < 50 * 2  # where the machine is busy, the first fit holds up two estimates


def noise_through_a_resonance(number: int) -> np.ndarray:
    """(1 << 20, 4) counts."""
    return resonance(1 << 20, seed=number)


def of_the_rig(number: int) -> np.ndarray:
    """(1 << 20, 4) counts of a rig that the model describes."""
    y = rig_record((1 << 20) / 25_600.0, seed=number)
    return np.round(y / (490.5 / 32767)).astype(np.int32)


def write_long(path: Path, seconds: float, make: Callable[[int], np.ndarray] = noise_through_a_resonance) -> None:
    """A log of parts (1 << 20, 4) counts, one behind the other. make : a part by its number."""
    writer, rate_hz = LogWriter(path, live=False), 25_600.0
    session = make_session(rate_hz=rate_hz)
    writer.start(Session(RIG.model, session.info, "", RIG.attachments(), metadata={}))
    for at in range(0, int(seconds * rate_hz), 4096):
        if at % (1 << 20) == 0:
            part = make(at >> 20)
        block = part[at % (1 << 20) :][:4096]
        writer.readings([Block(at, block, 10**12 + round((at + 4096) * 1e9 / rate_hz))])
    writer.close()


@pytest.mark.parametrize("method", estimators())
def test_replay_at_full_speed(tmp_path: Path, method: str) -> None:
    write_long(tmp_path / "a.mcap", 300.0)
    log = read_log(tmp_path / "a.mcap")
    begin, cpu = time.monotonic(), time.process_time()
    summary = replay_into(log, RIG, make=maker(method, 10.0))
    took, cpu = time.monotonic() - begin, time.process_time() - cpu
    assert summary.problems == ()
    bare = time.process_time()
    replay_into(log, RIG, make=Nothing)
    bare = time.process_time() - bare
    print(
        f"\nreplay of {summary.seconds:.0f} s with {method}: {summary.seconds / took:.0f} times real time (asked: 100),"
        f" {summary.seconds / cpu:.0f} per core; without an estimator {summary.seconds / bare:.0f} per core; "
        f"load {os.getloadavg()[0]:.0f}"
    )
    assert summary.seconds / cpu > {"score-matching": 60, "spectral": 12}[method]  # of its own core, however busy


def test_what_a_replay_spends_its_time_on(tmp_path: Path) -> None:
    """Each part by itself, and all at once as `rotorscope replay` has it."""
    seconds = 200.0
    write_long(tmp_path / "a.mcap", seconds, of_the_rig)
    log, spectral, logs = read_log(tmp_path / "a.mcap"), maker("spectral", 10.0), iter(range(9))
    parts: dict[str, tuple[MakeEstimator, list[Callable[[], Sink]]]] = {
        "reading the log, scaling": (Nothing, []),
        "estimator": (spectral, []),
        "layer watch": (Nothing, [lambda: LayerWatch(RIG.model, False, RIG.si_units)]),
        "naming": (Nothing, [lambda: Naming(RIG, False)]),
        "new log": (Nothing, [lambda: LogWriter(tmp_path / f"{next(logs)}.mcap", live=False)]),
        "viewer file": (Nothing, [lambda: RerunSink(str(tmp_path / f"{next(logs)}.rrd"), live=False)]),
    }
    parts["all at once"] = spectral, [make for _, sinks in parts.values() for make in sinks]
    replay_into(log, RIG, [make() for make in parts["all at once"][1]], make=spectral)  # compiles and imports
    base = 0.0
    print(f"\nreplay of {seconds:.0f} s, seconds of a core (load {os.getloadavg()[0]:.0f}):", end="")
    for name, (estimator, sinks) in parts.items():
        begin = time.process_time()
        replay_into(log, RIG, [make() for make in sinks], make=estimator)
        took = time.process_time() - begin
        base = base or took
        alone = took if name in ("reading the log, scaling", "all at once") else took - base
        print(f" {name} {alone:.1f};", end="")
    print(f" {seconds / took:.0f} times real time of one core")


class Nothing:
    """An estimator that costs nothing."""

    def __init__(self, *_: object) -> None: ...

    def update(self, block: np.ndarray) -> None: ...

    def snapshot(self) -> Estimate:
        return Estimate(0, {}, 0.0)


class Memory:
    """A sink that notes the resident memory each 15 s of data."""

    def __init__(self) -> None:
        self.bytes: list[int] = []
        self._next = 0
        self._process = psutil.Process()

    def start(self, session: Session) -> None: ...

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Block) and reading.index >= self._next:
                self.bytes.append(self._process.memory_info().rss)
                self._next += 15 * 25_600

    def estimate(self, estimate: Estimate) -> None: ...

    def status(self, status: Status) -> None: ...

    def close(self) -> None: ...


@pytest.mark.parametrize("method", estimators())
def test_memory_is_flat_over_ten_minutes(tmp_path: Path, method: str) -> None:
    """The last ten minutes of 25: what the viewer keeps has its size after ten minutes of data."""
    write_long(tmp_path / "a.mcap", 1500.0)
    memory = Memory()
    sinks: list[Sink] = [
        LogWriter(tmp_path / "b.mcap", live=False), RerunSink(str(tmp_path / "b.rrd"), live=False), memory,
    ]  # fmt: skip
    handles = len(os.listdir("/proc/self/fd"))
    replay_into(read_log(tmp_path / "a.mcap"), RIG, sinks, make=maker(method, 10.0))
    mb = np.array(memory.bytes) / 1e6
    growth = float(np.median(mb[-8:]) - np.median(mb[58:66]))
    print(
        f"\nMCAP + Rerun + {method}: resident memory {mb[0]:.0f} MB at first, {mb[60]:.0f} after 15 minutes of data, "
        f"{mb[-1]:.0f} after 25; growth over ten minutes {growth:+.1f} MB (asked: below 5)"
    )
    assert growth < 5
    assert len(os.listdir("/proc/self/fd")) <= handles + 1


def test_mcap_beside_one_message_per_sample(tmp_path: Path) -> None:
    rows = 4_000_000
    rng = np.random.default_rng(0)
    counts = np.round(rng.standard_normal((rows, 4)) * 3000).astype(np.int32)
    blocks = [Block(at, counts[at : at + 256], 10**12 + at) for at in range(0, rows, 256)]
    begin = time.monotonic()
    writer = LogWriter(tmp_path / "a.mcap", live=False)
    feed(writer, list(blocks))
    writer.close()
    write = rows / (time.monotonic() - begin)
    begin = time.monotonic()
    samples = read_log(tmp_path / "a.mcap").samples()
    read = rows / (time.monotonic() - begin)
    assert len(samples) == rows

    few = 100_000
    begin = time.monotonic()
    peer = Writer(str(tmp_path / "peer.mcap"))
    peer.start()
    channel = peer.register_channel("/raw", "x", peer.register_schema("x", "", b""))
    for i in range(few):
        peer.add_message(channel, i, counts[i].tobytes(), i)
    peer.finish()
    peer_write = few / (time.monotonic() - begin)
    begin = time.monotonic()
    with (tmp_path / "peer.mcap").open("rb") as file:
        back = [np.frombuffer(m.data, np.int32) for _, _, m in make_reader(file).iter_messages()]
    peer_read = few / (time.monotonic() - begin)
    assert len(back) == few
    ours, theirs = (tmp_path / "a.mcap").stat().st_size / rows, (tmp_path / "peer.mcap").stat().st_size / few
    print(
        f"\nMCAP write {write / 1e6:.1f} M rows/s, read to SI {read / 1e6:.1f} M rows/s, {ours:.1f} B/row; one message "
        f"per sample: {peer_write / 1e6:.2f}, {peer_read / 1e6:.2f} M rows/s, {theirs:.0f} B/row "
        f"(ratios {write / peer_write:.0f} and {read / peer_read:.0f})"
    )
    assert write > 20 * peer_write
    assert read > 50 * peer_read


def test_status_costs_little() -> None:
    from daq.base.contract.clock import DeviceClock

    clock = DeviceClock(25_600.0)
    for k in range(1, 60 * 400):
        clock.feed(64 * k, 10**12 + k * 2_500_000 + (k * 7919) % 100_000, 64)
    begin = time.perf_counter()
    for _ in range(20):
        assert clock.state() is not None
    print(f"\nclock fit over a minute: {(time.perf_counter() - begin) / 20 * 1e3:.2f} ms, once a second")
