"""Sessions with threads: ends, failures, slow consumers, several devices at once."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from promises import until, within
from stand_ins import MomentEstimator, Recorder, ScriptedDriver, info_of, paper_rig, vibration

from daq.base.contract.errors import ConfigError
from daq.base.contract.sink import SinkHealth
from daq.log.reader import read_log
from daq.log.writer import LogWriter
from daq.session.acquire import ANSWER_S, Device, RunSummary, acquire_all, acquire_from
from daq.session.links import open_driver
from daq.session.replay import replay_into
from drivers.contract.errors import LinkOpenError
from drivers.contract.reading import Block, Gap, Notice, Reading

RIG = paper_rig()
Property = Callable[[str, object], None]
INFO = info_of(RIG)
RUN_SCHEMA = json.loads((Path(__file__).parents[2] / "data" / "schemas" / "run.json").read_text())


def endless(rows: int = 256, pause_s: float = 0.01) -> Iterator[list[Reading]]:
    yield [INFO]
    for k in range(10**9):
        time.sleep(pause_s)
        yield [vibration(rows * k, rows)]


def finite(rows: int, block: int = 256) -> Iterator[list[Reading]]:
    yield [INFO]
    for at in range(0, rows, block):
        yield [vibration(at, min(block, rows - at))]


class Thinker(Recorder):
    """A sink that was asked something and answers `after_s` after the session's last sample."""

    def __init__(self, after_s: float) -> None:
        super().__init__()
        self.after_s, self.last_s = after_s, 0.0

    def readings(self, batch: Sequence[Reading]) -> None:
        self.last_s = time.monotonic() if any(isinstance(r, Block) for r in batch) else self.last_s

    def health(self) -> SinkHealth:
        pending = time.monotonic() < self.last_s + self.after_s
        said = () if pending or not self.last_s else (Notice(1, "warning", "effect_named", "a clearance"),)
        return SinkHealth(0.0, 0, said, pending)


def test_a_diagnosis_under_way_at_the_end_is_waited_for_and_logged(tmp_path: Path) -> None:
    source = ScriptedDriver(finite(51_200), kind="can")
    acquire_from(RIG, source, [LogWriter(tmp_path / "a.mcap"), Thinker(0.3)], 2.0, make=MomentEstimator)
    assert "effect_named" in {notice.code for notice in read_log(tmp_path / "a.mcap").notices}


def test_a_stop_does_not_wait_for_a_diagnosis() -> None:
    stop = threading.Event()
    threading.Timer(0.3, stop.set).start()
    began_s = time.monotonic()
    acquire_from(RIG, ScriptedDriver(finite(51_200), kind="can"), [Thinker(1e6)], 2.0, stop, make=MomentEstimator)
    assert time.monotonic() - began_s < ANSWER_S


def test_a_finite_source_is_taken_whole_and_replays_bit_for_bit(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "a.mcap", live=False)
    summary = acquire_from(RIG, ScriptedDriver(finite(200_000), kind="capture"), [writer], make=MomentEstimator)
    assert summary.samples == 200_000
    assert summary.problems == ()
    jsonschema.validate(summary.to_json(), RUN_SCHEMA)
    log = read_log(tmp_path / "a.mcap")
    assert log.complete
    np.testing.assert_array_equal(log.counts(), vibration(0, 200_000).counts)
    assert log.rig_text == RIG.text
    assert {"rotorscope", "python", "numpy", "link_kind", "started"} <= set(log.metadata)
    again = replay_into(log, check=True, make=MomentEstimator)
    assert again.identical
    assert again.compared == len(log.estimates) == 200_000 // 12_288 + 1
    assert again.samples == 200_000
    jsonschema.validate(again.to_json(), RUN_SCHEMA)
    assert again.to_json()["estimates"].keys() == summary.to_json()["estimates"].keys()


def test_a_replay_may_be_logged_again_and_is_the_same_log(tmp_path: Path) -> None:
    acquire_from(RIG, ScriptedDriver(finite(60_000), "capture"), [LogWriter(tmp_path / "a.mcap")], make=MomentEstimator)
    replay_into(read_log(tmp_path / "a.mcap"), None, [LogWriter(tmp_path / "b.mcap", live=False)], make=MomentEstimator)
    a, b = read_log(tmp_path / "a.mcap"), read_log(tmp_path / "b.mcap")
    np.testing.assert_array_equal(a.counts(), b.counts())
    assert [e.data for e in a.estimates] == [e.data for e in b.estimates]


@pytest.mark.parametrize("wrong", ["value", "one fewer", "one more"])
def test_the_check_notices_a_difference(tmp_path: Path, wrong: str) -> None:
    class Other(MomentEstimator):
        def update(self, block: np.ndarray) -> None:
            super().update(block)
            self._sum += 1e-9

    acquire_from(RIG, ScriptedDriver(finite(60_000), "capture"), [LogWriter(tmp_path / "a.mcap")], make=MomentEstimator)
    log = read_log(tmp_path / "a.mcap")
    if wrong == "value":
        assert replay_into(log, check=True, make=Other).identical is False
    if wrong == "one fewer":
        object.__setattr__(log, "estimates", log.estimates[:-1])
        assert replay_into(log, check=True, make=MomentEstimator).identical is False
    if wrong == "one more":
        object.__setattr__(log, "estimates", (*log.estimates, log.estimates[-1]))
        assert replay_into(log, check=True, make=MomentEstimator).identical is False


def test_seconds_are_of_data_and_exact(tmp_path: Path) -> None:
    summary = acquire_from(RIG, ScriptedDriver(finite(10**9), "capture"), [], seconds=2.5, make=MomentEstimator)
    assert (summary.samples, summary.seconds) == (64_000, 2.5)


def test_a_silent_device_does_not_hold_a_run_of_given_length() -> None:
    recorder = Recorder()
    begin = time.monotonic()
    summary = acquire_from(
        RIG, ScriptedDriver([[INFO]], ends=False), [recorder], seconds=0.3, make=MomentEstimator, grace_s=0.2
    )
    within(time.monotonic() - begin, 3.0)
    assert summary.samples == 0
    assert recorder.of("close") == [None]


def test_a_device_that_is_too_slow_for_a_run_of_given_length_is_reported() -> None:
    notices: list[Notice] = []
    slow = ScriptedDriver(endless(pause_s=0.04), ends=False)  # a quarter of its rate
    summary = acquire_from(RIG, slow, [], seconds=0.4, notify=notices.append, make=MomentEstimator, grace_s=0.2)
    assert 0.0 < summary.seconds < 0.4
    assert [n.code for n in notices] == ["short"]
    assert "s of data came in 0.6 s, where 0.4 s were asked for" in notices[0].text


def test_stop_ends_a_live_session_quickly_with_everything_that_was_read(tmp_path: Path) -> None:
    warm = [[INFO], [vibration(0, 5000)]]  # what is imported and compiled late takes long on a busy machine
    acquire_from(RIG, ScriptedDriver(warm), [LogWriter(tmp_path / "warm.mcap")], make=MomentEstimator)
    stop = threading.Event()
    threading.Timer(0.6, stop.set).start()
    begin = time.monotonic()
    writer = LogWriter(tmp_path / "a.mcap")
    summary = acquire_from(RIG, ScriptedDriver(endless()), [writer], stop=stop, make=MomentEstimator)
    within(time.monotonic() - begin, 3.0)
    log = read_log(tmp_path / "a.mcap")
    assert log.complete
    assert log.n_samples == summary.samples > 5_000
    assert replay_into(log, check=True, make=MomentEstimator).identical


def test_samples_that_a_link_held_until_the_stop_are_logged(tmp_path: Path) -> None:
    class Holding(ScriptedDriver):
        """Holds its last block until it is closed, as a link does that waits for certainty about a gap."""

        held = True

        def read(self, timeout_s: float) -> list[Reading]:
            if self._closed.is_set() and self.held:
                self.held = False
                return [vibration(2000, 500)]
            if not (found := super().read(timeout_s)):
                stop.set()
            return found

    stop = threading.Event()
    driver = Holding([[INFO], [vibration(0, 2000)]], ends=False)
    summary = acquire_from(RIG, driver, [LogWriter(tmp_path / "a.mcap")], stop=stop, make=MomentEstimator)
    assert summary.samples == read_log(tmp_path / "a.mcap").n_samples == 2500


def test_a_link_that_cannot_be_opened_closes_the_sinks() -> None:
    class Shut(ScriptedDriver):
        def open(self) -> None:
            raise LinkOpenError("no such port")

    recorder = Recorder()
    with pytest.raises(LinkOpenError, match="no such port"):
        acquire_from(RIG, Shut([]), [recorder], make=MomentEstimator)
    assert [what for what, _ in recorder.calls] == ["start", "status", "close"]


@pytest.fixture
def mute_host() -> Iterator[str]:
    """A TCP port that neither answers nor refuses: its queue of connections is full."""
    with socket.socket() as listener, ExitStack() as others:
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        for _ in range(3):
            other = others.enter_context(socket.socket())
            other.setblocking(False)
            other.connect_ex(listener.getsockname())
        yield f"serial:socket://127.0.0.1:{listener.getsockname()[1]}"


def test_a_stop_does_not_wait_for_a_host_that_does_not_answer(mute_host: str, record_property: Property) -> None:
    stop, recorder = threading.Event(), Recorder()
    driver = open_driver(mute_host, RIG)
    threading.Timer(0.3, stop.set).start()
    begin = time.monotonic()
    summary = acquire_from(RIG, driver, [recorder], stop=stop, make=MomentEstimator)
    took = time.monotonic() - begin - 0.3
    record_property("reliability", f"stop while the link opens | TCP to a host that is mute | 2 s | {took:.2f} s")
    within(took, 1.0)
    assert summary.samples == 0
    assert recorder.of("close") == [None]
    with pytest.raises(LinkOpenError, match="timed out"):
        acquire_from(RIG, open_driver(mute_host, RIG), [], make=MomentEstimator)


def test_a_link_that_opens_after_the_stop_is_closed_again() -> None:
    class Slow(ScriptedDriver):
        def open(self) -> None:
            stop.set()
            time.sleep(0.4)
            events.append("open")

        def close(self) -> None:
            events.append("close")
            super().close()

    events, stop = list[str](), threading.Event()
    acquire_from(RIG, Slow([]), [], stop=stop, make=MomentEstimator)
    until(lambda: events[-2:] == ["open", "close"])


def test_a_driver_that_breaks_its_contract_is_not_silent_and_loses_nothing(tmp_path: Path) -> None:
    batches: list[list[Reading] | BaseException] = [[INFO], [vibration(0, 5000)], RuntimeError("defect in the driver")]
    with pytest.raises(RuntimeError, match="defect in the driver"):
        acquire_from(RIG, ScriptedDriver(batches), [LogWriter(tmp_path / "a.mcap")], make=MomentEstimator)
    log = read_log(tmp_path / "a.mcap")
    assert log.complete
    assert log.n_samples == 5000


def test_a_device_without_the_rigs_channels_is_refused(tmp_path: Path) -> None:
    from drivers.contract.reading import Info

    short = Info(INFO.signals[:2], 25600.0)
    with pytest.raises(ConfigError, match="not the rig's channel b2x, b2y"):
        acquire_from(RIG, ScriptedDriver([[short]]), [LogWriter(tmp_path / "a.mcap")], make=MomentEstimator)


class Slow(MomentEstimator):
    """An estimator that hangs for a second in the middle."""

    over = False

    def update(self, block: np.ndarray) -> None:
        super().update(block)
        if len(self.blocks) == 20:
            time.sleep(1.0)
            Slow.over = True


STOP_AFTER_S = 2.5  # later than the estimator is warm


def flood(rows: int = 4096, count: int = 100) -> Iterator[list[Reading]]:
    yield [INFO]
    for k in range(count):
        time.sleep(0.01)
        yield [vibration(rows * k, rows)]


def test_a_stalled_estimator_costs_the_oldest_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_property: Property
) -> None:
    """The reader goes on; what the queue had to drop is a gap with its exact indices, in log, summary and status."""
    path = tmp_path / "a.mcap"
    monkeypatch.setattr(Slow, "over", False)
    over: list[bool] = []
    summary = acquire_from(
        RIG, ScriptedDriver(flood()), [LogWriter(path)], make=Slow,
        notify=lambda notice: over.append(Slow.over) if notice.code == "overflow" else None,
        queue_bytes=2 << 20, busy_blocks=8,
    )  # fmt: skip
    log = read_log(path)
    assert summary.samples + summary.lost_samples == 409_600
    assert summary.lost_samples > 0
    assert {g.reason for g in summary.gaps} == {"overflow"}
    assert log.gaps == summary.gaps
    assert log.lost_samples == summary.lost_samples
    assert log.last_status is not None
    assert log.last_status.dropped["reader"] == summary.lost_samples
    assert over[0] is False  # to the operator at once, while the estimator still stalls
    assert len(over) <= 2  # and what came since, at the end
    assert [n.code for n in log.notices].count("overflow") == len(over)
    counts = log.counts()
    there = counts[:, 0] != np.iinfo(np.int32).min
    np.testing.assert_array_equal(counts[there], vibration(0, 409_600).counts[: len(counts)][there])
    row = "estimator stalls for long | 1 s at 16 times the usual rate, queues of 2 MiB | reader goes on, oldest dropped"
    record_property("reliability", f"{row} by exact gap `overflow` | {summary.lost_samples} samples, all in gaps")
    assert replay_into(log, check=True, make=MomentEstimator).identical


def test_a_stalled_estimator_delays_neither_log_nor_viewer(record_property: Property) -> None:
    """It has a thread of its own and ten seconds of patience: raw readings reach the sinks meanwhile."""

    class Timed(Recorder):
        def readings(self, batch: Sequence[Reading]) -> None:
            self.calls.append(("at", time.monotonic()))
            super().readings(batch)

    sink = Timed()
    summary = acquire_from(RIG, ScriptedDriver(flood(rows=512)), [sink], make=Slow)
    assert (summary.samples, summary.lost_samples) == (51_200, 0)
    assert len(sink.of("estimate")) == 51_200 // 12_288 + 1
    longest = float(np.diff(sink.of("at")).max())  # type: ignore[arg-type]
    row = "estimator stalls | an update that takes 1 s | log and viewer are not delayed, nothing is lost"
    record_property("reliability", f"{row} | raw readings at most {1e3 * longest:.0f} ms apart")
    within(longest, 0.5)


def test_a_hanging_estimator_does_not_hold_the_stop(tmp_path: Path, record_property: Property) -> None:
    """At the stop the backlog is logged though there is no time to estimate from it, and the log says so."""

    class Crawl(MomentEstimator):
        def update(self, block: np.ndarray) -> None:
            super().update(block)
            time.sleep(0.05)

    stop = threading.Event()
    threading.Timer(STOP_AFTER_S, stop.set).start()
    begin = time.monotonic()
    path = tmp_path / "a.mcap"
    summary = acquire_from(RIG, ScriptedDriver(flood(count=10**6)), [LogWriter(path)], stop=stop, make=Crawl)
    took = time.monotonic() - begin - STOP_AFTER_S
    within(took, 2.0)
    row = "estimator far too slow at the stop | 50 ms for each 40 ms block | complete log within 2 s, rest logged"
    record_property("reliability", f"{row} and named | {took:.2f} s")
    log = read_log(path)
    assert log.complete
    assert log.n_samples == summary.samples > 100_000  # four times what was estimated from
    assert "stopped_behind" in [n.code for n in log.notices]
    assert replay_into(log, check=True, make=MomentEstimator).identical


def test_a_slow_or_broken_sink_is_reported_and_the_others_have_all(tmp_path: Path) -> None:
    notices: list[Notice] = []
    broken = Recorder(fail={"readings": RuntimeError("viewer gone")})
    path = tmp_path / "a.mcap"
    driver = ScriptedDriver(finite(50_000), "capture")
    summary = acquire_from(RIG, driver, [broken, LogWriter(path)], make=MomentEstimator, notify=notices.append)
    assert read_log(path).n_samples == 50_000
    assert [n.code for n in notices] == ["sink_failed"]
    assert "viewer gone" in summary.problems[0]


def test_five_devices_at_once_and_two_of_them_fail(tmp_path: Path, record_property: Property) -> None:
    def batches(name: str) -> Iterator[list[Reading] | BaseException]:
        first = 1000 * int(name)
        yield [INFO]
        for k in range(100):
            time.sleep(0.01)
            if name == "3" and k == 30:
                yield RuntimeError("this device is broken")
            if name == "4" and k == 30:
                yield [Gap(first + 256 * k, 100, "crc")]
            yield [vibration(first + 256 * k + (100 if name == "4" and k >= 30 else 0), 256)]

    class Shut(ScriptedDriver):
        def open(self) -> None:
            raise LinkOpenError("no such port")

    devices = [
        Device(n, RIG, (Shut if n == "5" else ScriptedDriver)(batches(n)), [LogWriter(tmp_path / f"{n}.mcap")])
        for n in "12345"
    ]
    codes: list[tuple[str, str]] = []
    outcome = acquire_all(devices, make=MomentEstimator, notify=lambda name, notice: codes.append((name, notice.code)))
    assert isinstance(outcome["3"], RuntimeError)
    assert isinstance(outcome["5"], LinkOpenError)
    for name in "124":
        summary = outcome[name]
        assert isinstance(summary, RunSummary)
        assert summary.device == name
        assert summary.samples == 25_600
        assert summary.lost_samples == (100 if name == "4" else 0)
        log = read_log(tmp_path / f"{name}.mcap")
        assert log.complete
        assert log.head.device == name
        assert log.first == 1000 * int(name)
        assert replay_into(log, check=True, make=MomentEstimator).identical
    assert read_log(tmp_path / "3.mcap").n_samples == 30 * 256
    row = "one device of five fails | a driver that raises, another that cannot open | the others are not disturbed"
    record_property("reliability", f"{row} | 3 complete logs without loss")


def test_replay_in_real_time_and_stopped(tmp_path: Path) -> None:
    acquire_from(RIG, ScriptedDriver(finite(25_600), "capture"), [LogWriter(tmp_path / "a.mcap")], make=MomentEstimator)
    log = read_log(tmp_path / "a.mcap")
    begin = time.monotonic()
    summary = replay_into(log, speed=2.0, make=MomentEstimator)
    took = time.monotonic() - begin
    assert took > 0.45
    within(took, 1.5)
    assert summary.samples == 25_600
    stop = threading.Event()
    threading.Timer(0.3, stop.set).start()
    part = replay_into(log, speed=0.5, stop=stop, make=MomentEstimator)
    assert 0 < part.samples < 12_800


def test_blocks_keep_their_host_times_in_a_replay(tmp_path: Path) -> None:
    acquire_from(RIG, ScriptedDriver(finite(25_600), "capture"), [LogWriter(tmp_path / "a.mcap")], make=MomentEstimator)
    recorder = Recorder()
    replay_into(read_log(tmp_path / "a.mcap"), None, [recorder], make=MomentEstimator)
    last = [r for r in recorder.delivered if isinstance(r, Block)][-1]
    assert last.t_host_ns == vibration(25_600 - 256, 256).t_host_ns
