"""A session in segments: where they are cut, that they replay as one, what stays of them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from promises import PATIENCE_S, until, within
from stand_ins import MomentEstimator, ScriptedDriver, info_of, paper_rig, vibration

from daq.base.contract.errors import ConfigError, LogError
from daq.base.contract.sink import ClockState, Session, Status
from daq.commands.cli.app import main
from daq.log.reader import read_log
from daq.session.acquire import RunSummary, acquire_from
from daq.session.estimation import block_rows
from daq.session.estimators import MakeEstimator
from daq.session.replay import replay_into
from daq.trend.folder import LoggedSession, sessions
from daq.trend.names import ALARM_CODE, Segment, segment_name, segment_of, segments
from daq.trend.retention import remove_old
from daq.trend.segments import SegmentedLog
from daq.trend.sizes import Cut, Keep, asked_cut, asked_keep
from drivers.contract.reading import Block, Gap, LinkStats, Notice, Reading
from estimator import Model

RIG = paper_rig()
RATE_HZ = 25600.0
ROWS = block_rows(RATE_HZ)
INFO = info_of(RIG)
S_NS = 10**9
T0_NS = 1_700_000_000 * S_NS


def record(
    folder: Path, stream: Iterable[Reading], cut: Cut, keep: Keep | None = None, kind: str = "scripted",
    make: MakeEstimator = MomentEstimator,
) -> RunSummary:  # fmt: skip
    """A session of these readings, one a batch."""
    log = SegmentedLog(folder, "press", cut, keep or Keep(), block_rows=block_rows, live=kind == "scripted")
    batches = chain([[INFO]], ([reading] for reading in stream))
    return acquire_from(RIG, ScriptedDriver(batches, kind), [log], make=make, metadata={"command": "run"})


def blocks(first: int, stop: int, step: int = 700) -> list[Reading]:
    return [vibration(i, min(step, stop - i)) for i in range(first, stop, step)]


def only(folder: Path) -> LoggedSession:
    (session,) = sessions(folder)
    return session


def test_segments_are_cut_on_blocks_complete_and_replay_as_one(tmp_path: Path) -> None:
    stream = [*blocks(300, 30_000), Gap(30_000, 25_000, "sequence"), *blocks(55_000, 90_000)]
    summary = record(tmp_path, stream, Cut(seconds=1.0))
    logs = [read_log(s.path) for s in segments(tmp_path)]
    assert [log.complete for log in logs] == [True] * 4
    assert [log.first // ROWS for log in logs] == [0, 26, 54, 79]
    assert [log.first % ROWS for log in logs[1:]] == [0] * 3
    assert [log.stop for log in logs] == [log.first for log in logs[1:]] + [90_000]
    assert all(log.rig_text == RIG.text and log.info == INFO for log in logs)
    assert [log.metadata["segment"] for log in logs] == ["1", "2", "3", "4"]
    assert sum(log.n_samples for log in logs) == summary.samples
    again = replay_into(only(tmp_path), check=True, make=MomentEstimator)
    assert again.identical
    assert again.compared > 4
    assert (again.samples, again.lost_samples) == (summary.samples, summary.lost_samples)


def test_a_last_segment_of_which_nothing_can_be_read_leaves_the_others_checkable(tmp_path: Path) -> None:
    """As a full disk leaves it: the estimate of the last block came after the start of the next segment."""
    made: list[MomentEstimator] = []

    def make(model: Model, rate_hz: float) -> MomentEstimator:
        made.append(MomentEstimator(model, rate_hz))
        return made[-1]

    def stream() -> Iterable[Reading]:
        """The samples of the last segment come after the estimates of the first: an estimator may be slow."""
        yield from blocks(0, 40 * ROWS)
        until(lambda: len(made[-1].blocks) >= 30)  # the first was made to warm up
        yield from blocks(40 * ROWS, 90 * ROWS)

    record(tmp_path, stream(), Cut(seconds=1.0), make=make)
    last = segments(tmp_path)[-1].path
    last.write_bytes(last.read_bytes()[:2000])
    session = only(tmp_path)
    assert session.lost_end == last.name
    assert replay_into(session, check=True, make=MomentEstimator).identical


def test_a_segment_knows_the_clock_from_its_beginning(tmp_path: Path) -> None:
    log = SegmentedLog(tmp_path, "press", Cut(seconds=1.0), Keep(), block_rows=block_rows, live=False)
    log.start(Session(model=RIG.model, info=INFO, device="", attachments=RIG.attachments(), metadata={}))
    clock = ClockState(offset_ns=5, rate_hz=RATE_HZ, drift_ppm=1.0, bound_ns=7)
    log.readings(blocks(0, 20_000))
    log.status(Status(t_host_ns=10**12, index=20_000, rate_hz=RATE_HZ, link=LinkStats(), clock=clock))
    log.readings(blocks(20_000, 30_000))
    log.close()
    assert [read_log(s.path).clocks for s in segments(tmp_path)] == [((20_000, clock),)] * 2


def test_a_changed_estimate_is_seen_and_what_cannot_be_checked_is_said(tmp_path: Path) -> None:
    record(tmp_path, blocks(0, 80_000), Cut(seconds=1.0))

    class Other(MomentEstimator):
        def update(self, block: np.ndarray) -> None:  # type: ignore[type-arg]
            super().update(block * 1.0000001)

    assert not replay_into(only(tmp_path), check=True, make=Other).identical
    assert only(tmp_path).unlike == ""
    segments(tmp_path)[1].path.unlink()
    assert only(tmp_path).unlike == "lacks segment 2 of its session"
    gaps = [r for r in only(tmp_path).readings() if isinstance(r, Gap)]
    assert [(g.index, g.reason) for g in gaps] == [(25_600, "log")]
    segments(tmp_path)[0].path.unlink()
    assert "begins with segment 3" in only(tmp_path).unlike


def test_size_limits_a_segment(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    stream = [Block(i, rng.integers(-30_000, 30_000, (5000, 4), dtype=np.int32), (i + 5000) * 39_062)
              for i in range(0, 300_000, 5000)]  # fmt: skip
    record(tmp_path, stream, Cut(size_bytes=10**6), kind="capture")
    sizes = [s.path.stat().st_size for s in segments(tmp_path)]
    assert len(sizes) >= 2
    assert max(sizes) < 2.0e6
    assert all(read_log(s.path).first % ROWS == 0 for s in segments(tmp_path))


def test_a_schedule_stores_windows_and_an_alarm_one_more(tmp_path: Path) -> None:
    stream = blocks(0, 200_000)
    at = next(k for k, r in enumerate(stream) if isinstance(r, Block) and r.index > 90_000)
    stream.insert(at, Notice(0, "warning", ALARM_CODE, "kL has changed"))
    record(tmp_path, stream, Cut(every_s=3.0, for_s=1.0))
    logs = [read_log(s.path) for s in segments(tmp_path)]
    assert [(log.first // 1000, log.stop // 1000) for log in logs] == [(0, 25), (76, 116), (153, 179)]
    assert [s.alarm for s in segments(tmp_path)] == [True, True, False]  # and the one before it
    assert "3 s" in only(tmp_path).unlike
    assert {r.reason for r in only(tmp_path).readings() if isinstance(r, Gap)} == {"schedule"}


def make_folder(folder: Path, minutes: Iterable[int], alarms: Iterable[int] = ()) -> list[Path]:
    out = []
    for minute in minutes:
        path = folder / segment_name("press", T0_NS + minute * 60 * S_NS)
        path = path.with_stem(path.stem + "_alarm") if minute in alarms else path
        path.write_bytes(bytes(1000))
        out.append(path)
    return out


def left(folder: Path) -> list[int]:
    return [(s.start_ns - T0_NS) // (60 * S_NS) for s in segments(folder)]


def test_retention_takes_the_oldest_and_spares_alarms(tmp_path: Path) -> None:
    paths = make_folder(tmp_path, range(6), alarms=[1])
    now = T0_NS + 6 * 60 * S_NS
    removed = remove_old(tmp_path, Keep(age_s=200.0), now, [], paths[-1:])
    assert left(tmp_path) == [1, 2, 3, 4, 5]  # the end of a segment counts
    assert len(removed.paths) == 1
    assert remove_old(tmp_path, Keep(size_bytes=2500), now, [], paths[-1:]).kept_alarms == 0
    assert left(tmp_path) == [1, 5]
    assert remove_old(tmp_path, Keep(size_bytes=500), now, [], paths[-1:]).kept_alarms == 1
    assert left(tmp_path) == [1, 5]
    remove_old(tmp_path, Keep(free_bytes=10**18, alarms_too=True), now, [], paths[-1:])
    assert left(tmp_path) == [1, 5]  # somebody else fills the disk: the newest stays, and the one that is written
    remove_old(tmp_path, Keep(size_bytes=500, alarms_too=True), now, [], paths[-1:])
    assert left(tmp_path) == [5]


def test_a_clock_that_was_wrong_does_not_make_the_newest_the_oldest(tmp_path: Path) -> None:
    paths = make_folder(tmp_path, [-10_000_000, 0, 1, 2])  # this session began with a clock of decades ago
    remove_old(tmp_path, Keep(size_bytes=2000), T0_NS, paths[:1], [])
    assert left(tmp_path) == [-10_000_000, 2]


def test_a_run_removes_and_says_what(tmp_path: Path) -> None:
    notices: list[Notice] = []
    log = SegmentedLog(tmp_path, "press", Cut(seconds=1.0), Keep(age_s=0.5), block_rows=block_rows, live=False)
    batches = [[INFO], *([reading] for reading in blocks(0, 150_000))]
    acquire_from(RIG, ScriptedDriver(batches, "capture"), [log], make=MomentEstimator, notify=notices.append)
    assert len(segments(tmp_path)) <= 3
    assert [n.text for n in notices if n.code == "log_removed"]


def test_a_folder_that_is_gone_stops_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "press"
    log = SegmentedLog(folder, "press", Cut(seconds=1.0), Keep(), block_rows=block_rows)

    def batches() -> Iterable[list[Reading]]:
        yield [INFO]
        for k, reading in enumerate(blocks(0, 120_000)):
            if k == 20:
                until(lambda: any(s.path.stat().st_size for s in segments(folder)), PATIENCE_S)  # it has started
                folder.rename(tmp_path / "moved")
                folder.write_text("in the way")
            yield [reading]

    summary = acquire_from(RIG, ScriptedDriver(batches()), [log], make=MomentEstimator)
    assert summary.samples == 120_000
    assert read_log(segments(tmp_path / "moved")[0].path).n_samples == 120_000  # it goes on where it is
    assert any("it is tried again" in text for text in summary.problems)


def test_options() -> None:
    assert asked_cut("10min", None, None) == Cut(seconds=600.0)
    assert asked_cut("500MB", "1h", "30s") == Cut(size_bytes=500 * 10**6, every_s=3600.0, for_s=30.0)
    assert asked_cut(None, None, None) is None
    assert asked_keep(["30d", "200GB"], None, False) == Keep(
        age_s=30 * 86400.0, size_bytes=200 * 10**9, free_bytes=10**9
    )
    for wrong in ("10", "min", "0s", "-1h", "5parsec", "0.1s", "2kB"):
        with pytest.raises(ConfigError, match="--segment"):
            asked_cut(wrong, None, None)
    with pytest.raises(ConfigError, match="go together"):
        asked_cut("10min", "1h", None)
    with pytest.raises(ConfigError, match="below --every"):
        asked_cut(None, "1min", "2min")


def test_names() -> None:
    name = segment_name("press 3/ü", T0_NS + 123 * 10**6)
    assert name == "press-3-ü_20231114T221320.123Z.mcap"
    assert segment_of(Path(name)) == Segment(Path(name), T0_NS + 123 * 10**6, False)
    assert segment_of(Path("press.mcap")) is None


def test_a_folder_without_segments_says_so(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="holds no segments"):
        sessions(tmp_path)


@pytest.mark.slow
def test_the_command_and_kill_9(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], record_property: Callable[[str, object], None]
) -> None:
    rig, out = tmp_path / "rig.toml", tmp_path / "press"
    rig.write_text(RIG.text.replace('method = "spectral"', 'method = "score-matching"'))
    command = [sys.executable, "-m", "daq", "run", str(rig), "--link", "virtual:", "--out", str(out), "--segment", "1s"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until(lambda: out.exists() and len(segments(out)) > 1, PATIENCE_S)
    time.sleep(0.7)
    process.send_signal(signal.SIGKILL)
    killed_ns = time.time_ns()
    process.wait(PATIENCE_S)
    last = read_log(segments(out)[-1].path)
    assert last.started_ns is not None
    lost_s = (killed_ns - last.started_ns) / 1e9 - last.seconds
    row = "crash | kill -9 of a run in segments | at most 1 s lost, the folder replays to the logged estimates"
    record_property("reliability", f"{row} | {lost_s:.2f} s lost")
    within(lost_s, 1.0)
    assert main(["replay", str(out), "--check"]) == 0
    assert "bit for bit" in capsys.readouterr().out
    assert main(["replay", str(segments(out)[0].path), "--check"]) == 2
    assert "check the folder" in capsys.readouterr().err
    assert only(out).parts[0].head.metadata["command"] == "run"


ALARM = '[[alarm]]\nwhat = "bearing1.x.kL"\nlimit = 9e6\nhold_s = 0\n'


@pytest.mark.slow
def test_an_alarm_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig, out, result = tmp_path / "rig.toml", tmp_path / "press", tmp_path / "r.json"
    rig.write_text(RIG.text.replace('method = "spectral"', 'method = "score-matching"') + ALARM)
    run = ["run", str(rig), "--link", "virtual:", "--out", str(out), "--segment", "2s", "--seconds", "5"]
    assert main([*run, "--strict", "--json", str(result)]) == 1
    said = capsys.readouterr()
    assert "alarm: bearing1.x.kL" in said.out
    assert "--strict asks for none" in said.err
    (alarm,) = json.loads(result.read_text())["alarms"]
    assert (alarm["what"], alarm["state"], alarm["unit"]) == ("bearing1.x.kL", "alarm", "N/m")
    assert any(s.alarm for s in segments(out))
    assert main(["trend", str(out), "--json", "-", "--quiet"]) == 0
    (event,) = [e for e in json.loads(capsys.readouterr().out)["events"] if e["kind"] == "alarm_raised"]
    assert event["text"] == alarm["text"]
    assert main(["replay", str(out), "--check", "--quiet"]) == 0
