"""The Rerun sink with real files, ports, black holes and viewers that are killed."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import psutil
import pytest
from promises import PATIENCE_S, Late, within
from recordings import entities

from daq.base.contract.errors import ConfigError
from daq.base.contract.sink import ClockState, Session, Status
from daq.report.rerun.sink import RerunSink
from drivers.contract.reading import Block, Gap, Info, LinkStats, Notice, Signal
from estimator.model.rig import Channel, Model
from estimator.results import Estimate, Parameter

RATE = 25600.0
NAMES = ("b1x", "b1y", "b2x", "b2y")
SCALE = 0.015


def session() -> Session:
    channels = tuple(Channel(n, f"bearing{n[1]}", n[2]) for n in NAMES)
    info = Info(tuple(Signal(n, "m/s^2", SCALE) for n in NAMES), RATE, "SN 1")
    model = Model(channels, (150.0, 8000.0), name="rig")
    return Session(
        model=model, info=info, device="", attachments={"rig.toml": b"schema = 1\n"}, metadata={"rotorscope": "test"}
    )


def feed(sink: RerunSink, seconds: float, start: float = 0.0, pace: float = 0.0) -> float:
    """Blocks, estimates and statuses as of a core loop; the longest call in seconds. pace : s of sleep per block."""
    rng = np.random.default_rng(1)
    counts = np.round(rng.normal(size=(256, 4)) * 300).astype(np.int32)
    t0 = time.monotonic_ns()
    longest = 0.0
    for k in range(round(start * RATE / 256), round((start + seconds) * RATE / 256)):
        index = 256 * k
        before = time.perf_counter()
        sink.readings([Block(index, counts, t0 + int(index / RATE * 1e9))])
        longest = max(longest, time.perf_counter() - before)
        if k % 10 == 0:
            known = {f"bearing1.{d}.kL": Parameter(1e7, 1e5, "N/m") for d in "xy"}
            known["bearing1.x.cubic.kNL"] = Parameter(
                value=None, sd=None, unit="N/m^3", identifiable=False, reason="too little motion"
            )
            sink.estimate(Estimate(index, known, 1000.0, extra={"missing_force_percent": 1.5}))
        if k % 100 == 0:
            clock = ClockState(t0, RATE, 20.0, 15_000)
            sink.status(
                Status(
                    t_host_ns=t0 + int(index / RATE * 1e9),
                    index=index,
                    rate_hz=RATE,
                    link=LinkStats(),
                    clock=clock,
                    lag_s={"estimator": 0.01},
                )
            )
        if pace:
            time.sleep(pace)
    return longest


def wait(condition: Callable[[], object], seconds: float = PATIENCE_S) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


def binary() -> str:
    package = find_spec("rerun_cli")
    assert package is not None
    assert package.origin is not None
    return str(Path(package.origin).with_name("rerun"))


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@contextlib.contextmanager
def viewer(port: int, save: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A real gRPC receiver of Rerun that writes what it gets into a file."""
    command = [binary(), "--save", str(save), "--bind", "127.0.0.1", "--port", str(port)]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def listening() -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.2):
            return True
        return False

    assert wait(listening, 20)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_file_has_everything(tmp_path: Path) -> None:
    out = tmp_path / "session.rrd"
    sink = RerunSink(str(out))
    sink.start(session())
    feed(sink, 1.5)
    sink.readings([Gap(38400, 2560, "sequence"), Notice(time.monotonic_ns(), "warning", "gap", "lost")])
    feed(sink, 1.0, start=1.6)
    sink.close()
    sink.close()
    assert sink.dropped == 0
    rows = entities(out)
    for name in NAMES:
        assert rows[f"waveform/0/{name}"] > 500 * 2.4
    for path in (
        "spectrum/0/curves", "spectrum/0/grid", "scope/0/curves", "orbit/bearing1/curves", "orbit/bearing2/curves",
        "estimate/kL/bearing1.x", "missing_force/all candidates", "state/link", "state/sensors",
        "state/estimator", "state/model", "log", "rig", "health/clock/drift, ppm", "health/lag/estimator",
    ):  # fmt: skip
        assert any(path == p.replace("\\", "") for p in rows), path
    assert "estimate/cubic.kNL/bearing1.x" not in rows


def test_targets() -> None:
    assert RerunSink("rerun+http://127.0.0.1:9876")._target.endswith("/proxy")
    for bad in ("a.txt", "http://x", "rerun+http:///proxy", "/no/such/folder/a.rrd"):
        with pytest.raises(ConfigError, match="--rerun"):
            RerunSink(bad)


def test_spawn_without_a_display_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    sink = RerunSink("spawn", viewer_port=free_port())
    sink.start(session())
    assert wait(lambda: "is there a display" in str(sink._problem))
    sink.close()


def test_closed_port_is_said_once_and_costs_nothing() -> None:
    sink = RerunSink(f"rerun+http://127.0.0.1:{free_port()}/proxy", capacity_bytes=100_000)
    sink.start(session())
    assert wait(lambda: sink._problem)
    time.sleep(1.0)
    (notice,) = sink.health().notices
    assert (notice.code, sink.health().notices) == ("viewer_lost", ())
    assert "nothing listens there; acquisition goes on without it" in notice.text
    within(feed(sink, 5.0), 0.02)
    assert sink.dropped > 4 * RATE
    assert sink.health().dropped == sink.dropped
    before = time.monotonic()
    sink.close()
    within(time.monotonic() - before, 1.5)


@pytest.mark.slow
def test_black_hole_never_blocks() -> None:
    """A port that accepts and then says nothing."""
    with socket.create_server(("127.0.0.1", 0), backlog=16) as hole:
        sink = RerunSink(f"rerun+http://127.0.0.1:{hole.getsockname()[1]}/proxy")
        sink.start(session())
        within(feed(sink, 3.0, pace=0.01), 0.05)
        child = sink._process
        before = time.monotonic()
        sink.close()
        within(time.monotonic() - before, 2.5)
        assert child is None or not psutil.pid_exists(child.pid)
        assert sink.dropped > 0


def test_viewer_dies_and_returns(tmp_path: Path) -> None:
    port = free_port()
    sink = RerunSink(f"rerun+http://127.0.0.1:{port}/proxy")
    with viewer(port, tmp_path / "first.rrd"):
        sink.start(session())
        assert wait(lambda: sink._process and not sink._queue)
        feed(sink, 1.0, pace=0.01)
        assert wait(lambda: not sink._queue)
    longest = feed(sink, 1.0, start=1.0, pace=0.01)
    assert wait(lambda: sink._problem), "a dead viewer must be noticed"
    with viewer(port, tmp_path / "second.rrd") as receiver:
        assert wait(lambda: sink._problem is None and not sink._queue)
        codes = [n.code for n in sink.health().notices]
        assert codes[:2] == ["viewer_lost", "viewer_back"]
        if codes[2:]:
            raise Late(f"a viewer that took too long: {codes}")
        longest = max(longest, feed(sink, 2.0, start=2.0, pace=0.01))
        sink.close()
        time.sleep(0.5)
        receiver.terminate()
        receiver.wait(PATIENCE_S)
    within(longest, 0.05)
    assert entities(tmp_path / "second.rrd")["waveform/0/b1x"] > 500


def test_drawing_process_killed_loses_only_a_counted_batch(tmp_path: Path) -> None:
    sink = RerunSink(str(tmp_path / "a.rrd"))
    sink.start(session())
    assert wait(lambda: sink._process)
    assert sink._process is not None
    sink._process.kill()
    assert wait(lambda: sink._problem)
    feed(sink, 0.5)
    assert sink.dropped > 0.4 * RATE, "all that comes after is counted"
    sink.close()


@pytest.mark.slow
def test_a_replay_waits_rather_than_drop(tmp_path: Path) -> None:
    sink = RerunSink(str(tmp_path / "a.rrd"), capacity_bytes=200_000, live=False)
    sink.start(session())
    assert wait(lambda: sink._process)
    feed(sink, 10.0)
    sink.close()
    assert sink.dropped == 0
    assert entities(tmp_path / "a.rrd")["waveform/0/b1x"] > 500 * 9.9


def test_core_loop_calls_take_microseconds(tmp_path: Path) -> None:
    sink = RerunSink(str(tmp_path / "a.rrd"))
    sink.start(session())
    counts = np.zeros((256, 4), np.int32)
    took = []
    for k in range(2000):
        before = time.thread_time()  # where the core goes meanwhile is not the sink's
        sink.readings([Block(256 * k, counts, k)])
        took.append(time.thread_time() - before)
    sink.close()
    assert np.median(took) < 1e-4
    assert np.quantile(took, 0.99) < 1e-3
    assert sink.dropped == 0
