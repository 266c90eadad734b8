"""Whatever lies at --out: a measurement is not overwritten, two do not write one log, and no half of a file stays."""

import contextlib
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from promises import PATIENCE_S, until
from sessions import feed, make_session, make_stream, write_log

from daq.base.console import unfinished
from daq.base.contract.errors import LogError
from daq.commands.cli.app import main
from daq.log.file import LogFile
from daq.log.place import being_written, emptied, free_name, made, opened
from daq.log.reader import read_log
from daq.log.recover import recover
from daq.log.writer import LogWriter
from daq.rig.rig import Rig
from daq.session.replay import replay_into

ROOT = Path(__file__).parents[3]
Row = Callable[[str, object], None]
MEASURED = {"command": "run", "link": "serial:/dev/ttyACM0", "link_kind": "serial"}
PROMISED = "a measurement stays"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return fill(tmp_path)


def fill(folder: Path) -> Path:
    """A rig file, and a measurement over a link."""
    text = (ROOT / "configs" / "tiwari_vyas_1997.toml").read_text()
    (folder / "rig.toml").write_text(text.replace('method = "spectral"  ', 'method = "score-matching"'))
    write_log(folder / "a.mcap", session=replace(make_session(), metadata=MEASURED))
    return folder


def rotorscope(folder: Path, *words: str) -> int:
    with contextlib.chdir(folder):
        return main([*words])


def logs(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != "rig.toml")


def test_a_link_that_is_not_there_costs_no_earlier_log(folder: Path, record_property: Row) -> None:
    before = (folder / "a.mcap").read_bytes()
    assert rotorscope(folder, "run", "rig.toml", "--link", "serial:/dev/ttyNONE", "--out", "a.mcap") == 3
    assert (folder / "a.mcap").read_bytes() == before
    assert rotorscope(folder, "run", "rig.toml", "--link", "serial:/dev/ttyNONE", "--out", "b.mcap") == 3
    assert logs(folder) == ["a.mcap"]
    row = "`run --out LOG` over a measurement | a link that cannot be opened | it is as it was, no empty log"
    record_property("reliability", f"{row} | held bit for bit")


def test_a_taken_metrics_port_costs_no_earlier_log(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (folder / "a.mcap").read_bytes()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        done = rotorscope(folder, "run", "rig.toml", "--link", "virtual:", "--metrics", port, "--out", "a.mcap")
    assert done == 2
    assert capsys.readouterr().err == (
        f"rotorscope: metrics on 127.0.0.1:{port}: Address already in use; choose another port\n"
    )
    assert (folder / "a.mcap").read_bytes() == before
    assert logs(folder) == ["a.mcap"]


@pytest.mark.parametrize("command", ["run", "simulate", "replay", "import", "recover"])
def test_a_measurement_is_not_overwritten(
    folder: Path, command: str, capsys: pytest.CaptureFixture[str], record_property: Row
) -> None:
    before = (folder / "a.mcap").read_bytes()
    (folder / "copy.mcap").write_bytes(before)
    np.savez(folder / "x.npz", rate_hz=25600.0, **dict.fromkeys(("b1x", "b1y", "b2x", "b2y"), np.arange(5000.0)))
    words = {
        "run": ["rig.toml", "--link", "virtual:", "--seconds", "0.2"],
        "simulate": ["rig.toml", "--seconds", "0.2"],
        "replay": ["copy.mcap", "--rig", "rig.toml"],
        "import": ["x.npz", "--rig", "rig.toml"],
        "recover": ["copy.mcap"],
    }[command]
    for _ in range(2):  # the second time it is a made log that lies there, or, of recover, a mended measurement
        assert rotorscope(folder, command, *words, "--out", "a.mcap") == 0
        assert (folder / "a-1.mcap").read_bytes() == before
        assert read_log(folder / "a.mcap").complete
    kept = ["a-1.mcap", "a-2.mcap"] if command == "recover" else ["a-1.mcap"]
    assert logs(folder) == [*kept, "a.mcap", "copy.mcap", "x.npz"]
    said = [line for line in capsys.readouterr().err.splitlines() if "kept" in line]
    assert len(said) == len(kept)
    assert said[0].endswith("a.mcap: what lay there is kept as a-1.mcap")
    row = f"`{command} --out LOG` over a measurement | twice | {PROMISED}, made logs are overwritten"
    record_property("reliability", f"{row} | `a-1.mcap`, bit for bit, one line says so")


def test_a_rig_file_given_as_the_log_stays(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (folder / "rig.toml").read_text()
    assert rotorscope(folder, "simulate", "rig.toml", "--seconds", "0.1", "--out", "rig.toml") == 2
    assert (folder / "rig.toml").read_text() == before
    assert "choose a name that ends in .mcap" in capsys.readouterr().err


def test_behind_a_symbolic_link(folder: Path) -> None:
    (folder / "disk").mkdir()
    (folder / "a.mcap").rename(folder / "disk" / "a.mcap")
    (folder / "a.mcap").symlink_to("disk/a.mcap")
    for _ in range(2):
        assert rotorscope(folder, "simulate", "rig.toml", "--seconds", "0.1", "--out", "a.mcap") == 0
        assert rotorscope(folder, "run", "rig.toml", "--link", "virtual:", "--seconds", "0.1", "--out", "a.mcap") == 0
    assert (folder / "a.mcap").is_symlink()
    assert logs(folder / "disk") == ["a-1.mcap", "a.mcap"]
    assert not made(folder / "disk" / "a-1.mcap")
    assert made(folder / "disk" / "a.mcap")


def test_a_free_name_is_above_all_that_are_taken(tmp_path: Path) -> None:
    for name in ("a.mcap", "a-2.mcap", "a-x.mcap", "a-9.csv", "ab-11.mcap"):
        (tmp_path / name).touch()
    assert free_name(tmp_path / "a.mcap") == tmp_path / "a-3.mcap"


def test_what_is_no_measurement(folder: Path) -> None:
    raw = (folder / "a.mcap").read_bytes()
    for cut in range(0, 4000, 7):  # damaged: whatever it says, it is not overwritten
        (folder / "b.mcap").write_bytes(raw[:cut])
        assert not made(folder / "b.mcap")


# ---- two at once


def test_one_who_waits_for_a_lock_does_not_get_what_was_moved_aside(folder: Path) -> None:
    """Two begin at once, where a measurement lies: the slower one has the measurement open when it is moved."""
    path, measured = folder / "a.mcap", (folder / "a.mcap").read_bytes()
    first, refusals = opened(path, path), list[str]()

    def second() -> None:
        with pytest.raises(LogError) as refused:
            opened(path, path)
        refusals.append(str(refused.value))

    waiting = threading.Thread(target=second)
    waiting.start()
    time.sleep(0.05)
    fd, aside = emptied(path, first)
    waiting.join()
    assert "another rotorscope is writing this log" in refusals[0]
    assert aside is not None
    assert aside.read_bytes() == measured
    assert os.fstat(fd).st_ino == path.stat().st_ino
    os.close(fd)


def test_two_imports_at_once_do_not_empty_what_the_other_made(folder: Path) -> None:
    """Each writes a file of its own, and the second keeps what the first gave the name."""
    path = folder / "b.mcap"
    first, second = LogFile(path, whole=True), LogFile(path, whole=True)
    for file, text in ((first, b"a whole log"), (second, b"another")):
        file.write(text)
        file.push()
        file.keep()
        file.close()
        assert path.read_bytes() == text
    assert second.kept is not None
    assert second.kept.read_bytes() == b"a whole log"


def test_two_that_begin_at_once_over_a_measurement(folder: Path, record_property: Row) -> None:
    """Forty times: at most one of the two is refused, and nothing of the measurement or of theirs is lost."""
    measured, refused = (folder / "a.mcap").read_bytes(), 0
    for k in range(40):
        place = folder / f"at{k}"
        place.mkdir()
        (place / "a.mcap").write_bytes(measured)
        gate, written = threading.Barrier(2), list[str]()

        def one(place: Path = place, gate: threading.Barrier = gate, written: list[str] = written) -> None:
            gate.wait()
            try:
                file = LogFile(place / "a.mcap")
            except LogError:
                return
            text = f"by {threading.get_ident()}"
            file.write(text.encode())
            file.push()
            file.keep()
            written.append(text)
            file.close()

        both = [threading.Thread(target=one) for _ in range(2)]
        for thread in both:
            thread.start()
        for thread in both:
            thread.join()
        there = [path.read_bytes() for path in place.iterdir()]
        assert there.count(measured) == 1
        assert sorted(there) == sorted([measured, *(text.encode() for text in written)])
        refused += 2 - len(written)
    row = "two `run --out LOG` at once over a measurement | 40 times, threads let go together"
    record_property("reliability", f"{row} | nothing is overwritten, never two in one log | {refused} refused, held")


def test_a_log_that_holds_nothing_yet_is_not_called_another_file(folder: Path) -> None:
    writer = LogWriter(folder / "new.mcap")
    with pytest.raises(LogError, match="is being written, and holds nothing yet; try again when samples have come"):
        read_log(folder / "new.mcap")
    writer.close()


def test_a_log_out_of_a_pipe_is_refused_and_holds_no_stop(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """To open one waits for somebody who writes, and a stop's handler does not end that."""
    os.mkfifo(folder / "in.mcap")
    os.mkfifo(folder / "in.log")
    for words in (["info", "in.mcap"], ["replay", "in.mcap"]):
        assert rotorscope(folder, *words) == 4
        assert "in.mcap: is a pipe" in capsys.readouterr().err
    for link in ("replay:in.mcap", "capture:in.log"):
        assert rotorscope(folder, "run", "rig.toml", "--link", link, "--out", "out.mcap") in (3, 4)
    assert not (folder / "out.mcap").exists()


def test_a_log_into_a_pipe_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(folder / "pipe")
    assert rotorscope(folder, "run", "rig.toml", "--link", "virtual:", "--seconds", "0.1", "--out", "pipe") == 4
    assert "it is no file" in capsys.readouterr().err


# ---- half a file


def test_an_import_that_fails_leaves_nothing(folder: Path) -> None:
    writer = LogWriter(folder / "b.mcap", live=False, wanted=lambda: False)
    feed(writer, make_stream())
    half, whole = logs(folder)
    assert re.fullmatch(r"\.b\.mcap\.\w+\.part", half)  # a name that nobody can lay a link at
    assert whole == "a.mcap"
    writer.close()
    assert logs(folder) == ["a.mcap"]


def test_half_a_file_that_the_end_of_the_program_removes_is_not_missed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that writes asks whether its file was removed just as it is: it must not make it again."""
    file = LogFile(folder / "b.mcap", whole=True)
    monkeypatch.setattr(unfinished, "wanted", lambda path, wanted=unfinished.wanted: (wanted(path), remove_all())[0])
    monkeypatch.setattr(os, "fstat", lambda fd, fstat=os.fstat: (fstat(fd), remove_all())[0])
    remove_all = unfinished.remove_all
    assert not file.removed
    assert not file.removed
    monkeypatch.undo()
    file.close()
    assert logs(folder) == ["a.mcap"]


@pytest.fixture
def long(sources: Path) -> Iterator[Path]:
    """Files whose conversion takes a while, and afterwards nothing else, whatever a test has left there."""
    before = set(sources.iterdir())
    yield sources
    for path in set(sources.iterdir()) - before:
        path.unlink()


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("long")
    for name in ("tiwari_vyas_1997.toml", "canedge_imu.toml", "canmod-gps.dbc"):
        (folder / name).write_bytes((ROOT / "configs" / name).read_bytes())
    y = np.random.default_rng(1).standard_normal((4, 1_500_000))
    np.savez(folder / "x.npz", rate_hz=25600.0, **dict(zip(("b1x", "b1y", "b2x", "b2y"), y, strict=True)))
    words = ["import", str(folder / "x.npz"), "--rig", str(folder / "tiwari_vyas_1997.toml")]
    assert main([*words, "--out", str(folder / "l.mcap")]) == 0
    lines = [line.split(" ", 1) for line in (ROOT / "tests/data/canedge_imu/canedge_imu.log").read_text().splitlines()]
    start, span = float(lines[0][0][1:-1]), float(lines[-1][0][1:-1]) - float(lines[0][0][1:-1]) + 0.01
    with (folder / "x.log").open("w") as file:
        for k in range(200_000 // len(lines) + 1):
            file.writelines(f"({float(t[1:-1]) - start + k * span:.6f}) {rest}\n" for t, rest in lines)
    return folder


WORDS = {
    "import": ["import", "x.npz", "--rig", "tiwari_vyas_1997.toml", "--out", "o.mcap"],
    "capture": ["import", "x.log", "--rig", "canedge_imu.toml", "--out", "o.mcap"],
    "recover": ["recover", "l.mcap", "--out", "o.mcap"],
    "export": ["export", "l.mcap", "--to", "o.csv"],
}


@pytest.mark.parametrize(
    ("what", "number"),
    [*((what, signal.SIGTERM) for what in WORDS), ("import", signal.SIGHUP), ("import", signal.SIGINT)],
)
def test_a_stop_leaves_no_half_of_a_file(long: Path, what: str, number: signal.Signals, record_property: Row) -> None:
    before = logs(long)
    command = [sys.executable, "-m", "daq", *WORDS[what]]
    restore_default = lambda: signal.signal(number, signal.SIG_DFL)  # noqa: E731 - a shell's background jobs do not hear Ctrl-C
    with subprocess.Popen(
        command,
        cwd=long,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=restore_default,  # noqa: PLW1509
    ) as process:
        until(lambda: process.poll() is not None or logs(long) != before)
        assert [n for n in logs(long) if n not in before] == [n for n in logs(long) if n.startswith(".o.")]
        asked = time.monotonic()
        process.send_signal(number)
        _, said = process.communicate(timeout=PATIENCE_S)
        took = time.monotonic() - asked
    assert (process.returncode, said) == (130, "rotorscope: interrupted\n")
    assert logs(long) == before
    row = f"`{WORDS[what][0]}` stopped half-way | {number.name}, {WORDS[what][1]} | no half of a file, status 130"
    record_property("reliability", f"{row} | nothing left, {took:.2f} s")


@pytest.mark.slow
def test_nohup(folder: Path) -> None:
    """The terminal goes, a measurement with nohup stays."""
    command = [sys.executable, "-m", "daq", "run", "rig.toml", "--link", "virtual:", "--out", "b.mcap"]
    ignored = lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)  # noqa: E731 - as nohup does
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, preexec_fn=ignored) as run:  # noqa: PLW1509
        try:
            until(lambda: (folder / "b.mcap").exists() and (folder / "b.mcap").stat().st_size > 50_000)
            run.send_signal(signal.SIGHUP)
            size = (folder / "b.mcap").stat().st_size
            until(lambda: (folder / "b.mcap").stat().st_size > size + 60_000)
            run.send_signal(signal.SIGTERM)
            assert run.wait(PATIENCE_S) == 0
        finally:
            run.kill()
    assert read_log(folder / "b.mcap").complete


@pytest.mark.parametrize("what", ["import", "recover", "export", "capture", "simulate", "replay", "link"])
def test_a_full_disk_leaves_no_half_of_a_file(
    long: Path, what: str, capsys: pytest.CaptureFixture[str], record_property: Row
) -> None:
    more = {
        "simulate": ["simulate", "tiwari_vyas_1997.toml", "--seconds", "20", "--out", "o.mcap"],
        "replay": ["replay", "l.mcap", "--out", "o.mcap"],
        "link": ["run", "tiwari_vyas_1997.toml", "--link", "replay:l.mcap", "--out", "o.mcap"],
    }
    before, words = logs(long), (WORDS | more)[what]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        status = rotorscope(long, *words)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    *warnings, said = capsys.readouterr().err.splitlines()
    assert status == 4
    assert all("warning: " in line for line in warnings)
    assert "File too large; " in said
    assert logs(long) == before
    row = f"`{words[0]}` on a full disk | limit on the file's size, {words[1]} | one line, no half of a file"
    record_property("reliability", f"{row} | nothing left, status {status}")


def test_a_full_disk_is_no_mistake_of_the_users(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Status 4, not 2, of whatever is written; the folder that is not there stays a 2."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        assert rotorscope(tmp_path, "effects", "--quiet", "--json", "e.json") == 4
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert rotorscope(tmp_path, "effects", "--quiet", "--json", "nowhere/e.json") == 2
    full, nowhere = capsys.readouterr().err.splitlines()
    assert "File too large; make room" in full
    assert "folder nowhere does not exist; create it first" in nowhere
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("seconds", ["0", "-1", "inf", "nan", "1e-9"])
def test_no_length(folder: Path, seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["simulate", "rig.toml", f"--seconds={seconds}", "--out", "b.mcap"]
    assert rotorscope(folder, *words) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert logs(folder) == ["a.mcap"]


# ---- a log that grows: last, as the service takes a share of a core until the module ends


@pytest.fixture(scope="module")
def growing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A log that a service is writing, over a virtual link."""
    folder = fill(tmp_path_factory.mktemp("growing"))
    path = folder / "live.mcap"
    command = [sys.executable, "-m", "daq", "run", "rig.toml", "--link", "virtual:", "--out", path.name, "--quiet"]
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE) as service:
        try:
            until(lambda: path.exists() and path.stat().st_size > 300_000)
            yield path
        finally:
            service.send_signal(signal.SIGTERM)
            assert service.wait(PATIENCE_S) == 0


@pytest.mark.parametrize(
    "words", [["run", "rig.toml", "--link", "virtual:"], ["simulate", "rig.toml"], ["recover", "a.mcap"]], ids=" ".join
)
def test_two_do_not_write_one_log(
    growing: Path, words: list[str], capsys: pytest.CaptureFixture[str], record_property: Row
) -> None:
    there = logs(growing.parent)
    assert rotorscope(growing.parent, *words, "--out", growing.name) == 4
    assert capsys.readouterr().err.splitlines()[-1] == (
        "rotorscope: live.mcap: another rotorscope is writing this log; stop that one, or choose another --out"
    )
    before = read_log(growing)
    assert before.growing
    until(lambda: read_log(growing).stop > before.stop)  # the first goes on
    assert logs(growing.parent) == there
    row = f"`{words[0]} --out` to a log that a `run` is writing | for real | refused, the run not disturbed"
    record_property("reliability", f"{row} | status 4, the log grows on")


def test_what_is_said_of_a_growing_log(growing: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = growing.parent
    assert rotorscope(folder, "info", growing.name, "--json", "info.json") == 0
    said = json.loads((folder / "info.json").read_text())
    assert (said["complete"], said["being_written"]) == (False, True)
    assert "not yet: it is being written" in capsys.readouterr().out
    assert rotorscope(folder, "export", growing.name, "--to", "x.npz") == 0
    with np.load(folder / "x.npz") as file:
        last = len(file["b1x"]) - 1
    assert f"live.mcap: is being written; x.npz ends with sample {last}\n" in capsys.readouterr().err
    for words in (["replay", growing.name], ["run", "rig.toml", "--link", f"replay:{growing.name}?speed=max"]):
        assert rotorscope(folder, *words, "--out", "again.mcap") == 0
        assert capsys.readouterr().err.count("live.mcap: is being written; replayed up to sample") == 1, words
        assert rotorscope(folder, "replay", "again.mcap") == 0
        assert "is being written" not in capsys.readouterr().err  # that was then


@pytest.mark.slow
def test_readers_of_a_growing_log_agree_with_themselves(growing: Path, record_property: Row) -> None:
    assert being_written(growing)
    for _ in range(5):
        log = read_log(growing)
        time.sleep(0.45)  # a chunk further on
        assert growing.stat().st_size > (log.findings.size or 0)
        assert len(log.samples()) == len(log.counts()) == log.stop - log.first
        assert replay_into(log, Rig.parse(log.rig_text)).samples == log.n_samples
    saved = recover(growing, growing.with_name("b.mcap"))
    assert saved.lost.endswith("the log is still being written")
    mended = read_log(growing.with_name("b.mcap"))
    assert (mended.complete, mended.n_samples) == (True, saved.samples)
    row = "a log read while it is written | read, samples and replay with 0.45 s between | the same length each time"
    record_property("reliability", f"{row} | held; `info` and `recover` say that it is being written")
