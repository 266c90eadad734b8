"""`rotorscope run` against devices and cables that fail: each loss has a gap, a counter and a line at the end."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from cable import Cable
from promises import PATIENCE_S, least_share, within
from ramp_device import PERIOD, ramp_device

from daq.commands.cli.app import main
from daq.log.reader import Recording, read_log
from drivers.contract.reading import Block
from drivers.protocol.faults import Fault
from drivers.serial import cobs
from drivers.simulated.simulated import SimulatedDevice, WireFrame

CONFIGS = Path(__file__).parents[3] / "configs"
# as a user has it: what cannot be written stays in the buffer
BUFFERED = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
Row = Callable[[str, object], None]


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    text = (CONFIGS / "tiwari_vyas_1997.toml").read_text()
    path = tmp_path / "rig.toml"
    path.write_text(text.replace('method = "spectral"', 'method = "score-matching"'))
    return path


def assert_ramp(log: Recording, pieces: int = 1) -> None:
    """Every sample that is there lies where it should; the rest is gaps."""
    assert log.complete, log.damage
    counts = log.counts().astype(np.int64)
    there = counts[:, 0] > np.iinfo(np.int32).min
    assert int((~there).sum()) == log.lost_samples == sum(g.count for g in log.gaps)
    shift = (counts[there][:, 0] + PERIOD // 2 - log.first - np.flatnonzero(there)) % PERIOD
    assert len(np.unique(shift)) <= pieces


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "said"), [("serial", "bytes came, but no samples"), ("slcan", "nothing came")])
def test_a_link_of_another_kind_than_the_devices_is_said(
    rig: Path, kind: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """slcan lines read as frames of ours; and a line on which nobody speaks."""
    with socket.create_server(("127.0.0.1", 0)) as listener, contextlib.ExitStack() as stack:

        def talk() -> None:
            client = stack.enter_context(listener.accept()[0])
            if kind == "serial":
                client.sendall(b"t30083132333435363738\r" * 500)

        threading.Thread(target=talk).start()
        url = f"{kind}:socket://127.0.0.1:{listener.getsockname()[1]}"
        assert main(["run", str(rig), "--link", url, "--seconds", "0.5"]) == 3
    assert f"rotorscope: {url}: " in (printed := capsys.readouterr().err)
    assert said in printed.splitlines()[-1]


# What a device or a link can do, when (in frames of 64 samples, 400 a second), and what the log then says.
FAULTS = {
    "sequence": Fault("drop", 200, 3),
    "device_lost": Fault("device_lost", 260, 4),
    "crc": Fault("flip", 320, 2),
    "version": Fault("version", 380, 5),
    "stuck": Fault("stuck", 440, 4),
    "duplicate": Fault("duplicate", 500, 2),
    "reordered": Fault("reorder", 560, 1),
    "restart": Fault("restart", 1160, 40),
}
QUIET_S = 1.55, 2.75  # and nothing at all on the line: frames 620 to 1099
CODES = {"crc", "other_version", "stuck_counter", "duplicate", "reordered", "silent", "device_restart"}


class Talker:
    """A device on TCP that begins when somebody connects."""

    def __init__(self, device: SimulatedDevice) -> None:
        self._device = device
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._talk)

    def __enter__(self) -> str:
        self._thread.start()
        return f"serial:socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()
        self._listener.close()

    def _talk(self) -> None:
        client, _ = self._listener.accept()
        begin, waiting = time.monotonic(), list[WireFrame]()
        with client, contextlib.suppress(OSError):  # the reader leaves first
            while not self._stop.wait(0.005):
                waiting = waiting or self._device.next(8)
                while waiting and waiting[0].due_s < time.monotonic() - begin:
                    frame = waiting.pop(0)
                    if not QUIET_S[0] <= frame.due_s < QUIET_S[1]:
                        client.sendall(_damage(cobs.encode(frame.data), frame.damaged))


def _damage(wire: bytes, how: str) -> bytes:
    return wire[:30] + bytes((wire[30] ^ 1,)) + wire[31:] if how else wire


def test_every_fault_of_a_device_is_in_log_status_and_summary(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], record_property: Row
) -> None:
    path, result = tmp_path / "a.mcap", tmp_path / "run.json"
    with Talker(ramp_device("serial16", seconds=None, faults=tuple(FAULTS.values()))) as url:
        command = ["run", str(rig), "--link", url, "--seconds", "3.4", "--out", str(path), "--json", str(result)]
        assert main(command) == 0
    said = capsys.readouterr().out
    log, summary = read_log(path), json.loads(result.read_text())
    assert_ramp(log, pieces=2)
    lost = {reason: sum(g.count for g in log.gaps if g.reason == reason) for reason in {g.reason for g in log.gaps}}
    wanted = {"device_lost": 256, "crc": 128, "version": 320, "stuck": 256}
    assert {reason: lost[reason] for reason in wanted} == wanted
    assert lost["sequence"] == (3 + 1) * 64  # dropped, and late
    assert lost["silent"] == 480 * 64
    assert 0 < lost["restart"] < 2 * 40 * 64  # only the host's clock can say, and this host may be busy
    assert {n.code for n in log.notices} >= CODES
    assert summary["lost_samples"] == log.lost_samples == sum(g["count"] for g in summary["gaps"])
    assert summary["link"]["crc_errors"] == 2
    assert summary["link"]["restarts"] == 1
    status = log.last_status
    assert status is not None
    assert status.link.lost_samples == log.lost_samples
    assert (status.link.crc_errors, status.link.restarts, status.link.duplicates) == (2, 1, 2)
    assert status.link.other["other_version"] == 5
    assert f"{log.lost_samples} lost in {len([g for g in log.gaps if g.count])} gaps: " in said
    for reason in lost:
        assert reason in said
    how = "frames dropped, damaged, doubled, swapped, of another version; a stuck counter, silence, a restart"
    promised = "each named in the log, a gap by reason, counted in status and summary"
    measured = f"{len(log.gaps)} gaps of {log.lost_samples} samples, the others at their places"
    record_property("reliability", f"faults of a device | {how} | {promised} | {measured}")


@pytest.fixture
def cable(tmp_path: Path) -> Iterator[Cable]:
    cable = Cable(tmp_path / "ttyUSB")
    yield cable
    cable.close()


def run(rig: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "daq", "run", str(rig), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(path: Path, done: Callable[[Recording], bool], seconds: float = PATIENCE_S) -> Recording:
    end = time.monotonic() + seconds
    while True:
        if path.exists() and path.stat().st_size > 20_000 and done(log := read_log(path)):
            return log
        assert time.monotonic() < end
        time.sleep(0.1)


def stop(process: subprocess.Popen[str], path: Path) -> tuple[float, str]:
    """SIGTERM; seconds until the log was closed, and what was said."""
    process.send_signal(signal.SIGTERM)
    asked, asked_s = time.monotonic(), time.time()
    out, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, error
    closed = max(0.0, path.stat().st_mtime - asked_s)  # the kernel stamps files with the last tick
    print(f"log closed after {closed:.2f} s, process gone after {time.monotonic() - asked:.2f} s")
    return closed, out


def test_a_pulled_cable_costs_next_to_no_cpu_and_comes_back(
    rig: Path, cable: Cable, tmp_path: Path, record_property: Row
) -> None:
    path = tmp_path / "a.mcap"
    process = run(rig, "--link", f"serial:{cable.name}", "--out", str(path))
    wait_for(path, lambda log: log.n_samples > 20_000)
    cable.pull()
    time.sleep(1.0)
    watched = psutil.Process(process.pid)
    share = least_share(lambda: sum(watched.cpu_times()[:2]), time.sleep, 0.02, window_s=3.0)
    cable.plug()
    back_ns = time.monotonic_ns()

    def again(log: Recording) -> list[Block]:
        return [r for r in log.readings(joined=False) if isinstance(r, Block) and r.t_host_ns > back_ns]

    wait_for(path, lambda log: len(again(log)) > 10)
    took, said = stop(process, path)
    log = read_log(path)
    returned = (again(log)[0].t_host_ns - back_ns) / 1e9
    row = "pulled cable | pty closed for 5 s under `rotorscope run` | data within 5 s, under 2 % of a core meanwhile"
    record_property("reliability", f"{row} | {returned:.2f} s, {100 * share:.2f} % of a core, closed in {took:.2f} s")
    assert_ramp(log)
    assert {"link_lost", "link_back"} <= {n.code for n in log.notices}
    assert "reconnect" in {g.reason for g in log.gaps if g.count > 64 * 400}
    assert "restart" not in {g.reason for g in log.gaps}
    assert "reconnect" in said
    assert share < 0.02
    within(returned, 5.0)
    within(took, 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["serial", "slcan"])
def test_a_port_that_another_session_holds_is_refused_and_costs_it_nothing(
    rig: Path, cable: Cable, tmp_path: Path, kind: str, record_property: Row
) -> None:
    path, cable.holds_bytes = tmp_path / "a.mcap", 1 << 24
    first = run(rig, "--link", f"serial:{cable.name}", "--out", str(path))
    wait_for(path, lambda log: log.n_samples > 20_000)
    second = run(rig, "--link", f"{kind}:{cable.name}", "--out", str(tmp_path / "b.mcap"))
    _, said = second.communicate(timeout=PATIENCE_S)
    assert said == f"rotorscope: {kind}:{cable.name}: another program holds the port: close it\n"
    assert second.returncode == 3
    there = read_log(path).n_samples
    wait_for(path, lambda log: log.n_samples > there + 20_000)
    stop(first, path)
    log = read_log(path)
    assert_ramp(log)
    assert log.lost_samples == 0
    assert not (tmp_path / "b.mcap").exists()
    row = f"two sessions on one port | `run --link {kind}:PORT` beside one that has it"
    measured = f"status 3, one line; the first: {log.n_samples} samples, {log.lost_samples} lost"
    record_property("reliability", f"{row} | the second is refused, the first loses nothing | {measured}")


@pytest.mark.slow
@pytest.mark.parametrize("ears", ["pipe", "terminal", "full disk"])
def test_nobody_left_to_listen_and_acquisition_goes_on(
    ears: str, rig: Path, cable: Cable, tmp_path: Path, record_property: Row
) -> None:
    """Standard output and error lead nowhere when there is something to say; `run` says it in the log and goes on."""
    path = tmp_path / "a.mcap"
    ours, theirs = pty.openpty() if ears == "terminal" else os.pipe()
    if ears == "full disk":
        os.close(theirs)
        theirs = os.open("/dev/full", os.O_WRONLY)
    command = [sys.executable, "-m", "daq", "run", str(rig), "--link", f"serial:{cable.name}", "--out", str(path)]
    with subprocess.Popen(command, stdout=theirs, stderr=theirs, env=BUFFERED | {"TERM": "xterm"}) as process:
        os.close(theirs)
        before = wait_for(path, lambda log: log.n_samples > 10_000).n_samples
        os.close(ours)
        cable.pull()
        time.sleep(0.5)
        cable.plug()
        wait_for(path, lambda log: log.n_samples > before + 20_000)
        process.send_signal(signal.SIGTERM)
        status = process.wait(PATIENCE_S)
    log = read_log(path)
    assert_ramp(log)
    assert {"link_lost", "link_back"} <= {n.code for n in log.notices}
    assert status == (1 if ears == "full disk" else 0)  # the summary that was asked for could not be written
    row = f"nobody to tell: {ears} | what `run` writes its notices to is gone, cable pulled | acquisition goes on, told"
    record_property("reliability", f"{row} in the log | {log.n_samples} samples, complete, status {status}")


@pytest.mark.slow
def test_a_closed_pipe_does_not_change_the_exit_status(rig: Path) -> None:
    """`run ... | head -0`: a check that failed has failed."""
    ours, theirs = os.pipe()
    os.close(ours)
    command = [sys.executable, "-m", "daq", "run", str(rig), "--link", "serial:/dev/ttyNONE"]
    said = {"stdout": theirs, "stderr": theirs, "env": BUFFERED}
    assert subprocess.run(command, **said, timeout=PATIENCE_S, check=False).returncode == 3
    command = [sys.executable, "-m", "daq", "run", str(rig), "--link", "virtual:", "--seconds", "0.5", "--json", "-"]
    assert subprocess.run(command, **said, timeout=PATIENCE_S, check=False).returncode == 0
    os.close(theirs)


@pytest.mark.slow
def test_no_viewer_a_log_that_vanishes_and_acquisition_goes_on(
    rig: Path, cable: Cable, tmp_path: Path, record_property: Row
) -> None:
    """Where the viewer should be nobody listens; the log's folder is removed while it is written."""
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    folder = tmp_path / "logs"
    folder.mkdir()
    path = folder / "a.mcap"
    viewer = f"rerun+http://127.0.0.1:{port}/proxy"
    process = run(rig, "--link", f"serial:{cable.name}", "--out", str(path), "--rerun", viewer)
    before = wait_for(path, lambda log: log.n_samples > 20_000).n_samples
    path.unlink()
    folder.rmdir()
    wait_for(path, lambda log: log.n_samples > before + 40_000)
    took, _ = stop(process, path)
    log = read_log(path)
    assert_ramp(log)
    assert "log_restored" in {n.code for n in log.notices}
    assert not log.gaps
    row = "no viewer, log folder removed | at once, under `rotorscope run`"
    measured = f"{log.n_samples} samples, 0 lost; closed in {took:.2f} s"
    record_property("reliability", f"{row} | both told, no sample lost, quick end | {measured}")
    within(took, 2.0)


@pytest.mark.slow
def test_all_at_once_and_all_comes_back(rig: Path, cable: Cable, tmp_path: Path, record_property: Row) -> None:
    """No viewer, the disk full, then the cable pulled, then the program suspended; then all of it back."""
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    path = tmp_path / "a.mcap"
    viewer = f"rerun+http://127.0.0.1:{port}/proxy"
    process = run(rig, "--link", f"serial:{cable.name}", "--out", str(path), "--rerun", viewer)
    wait_for(path, lambda log: log.n_samples > 20_000)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (path.stat().st_size + 10_000, resource.RLIM_INFINITY))
    time.sleep(2.0)
    cable.pull()
    time.sleep(1.0)
    process.send_signal(signal.SIGSTOP)
    time.sleep(2.0)
    process.send_signal(signal.SIGCONT)
    full = read_log(path)
    time.sleep(1.0)
    cable.plug()
    time.sleep(2.0)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    wait_for(path, lambda log: log.n_samples > full.n_samples + 60_000)
    took, said = stop(process, path)
    log = read_log(path)
    assert_ramp(log)
    assert {g.reason for g in log.gaps if g.count > 64 * 400} == {"reconnect"}
    assert "reconnect" in said
    assert {"viewer_lost", "log_fault", "log_recovered", "link_lost", "link_back"} <= {n.code for n in log.notices}
    row = "all at once | no viewer, the disk full (EFBIG), the cable pulled, the program suspended, then all back"
    measured = (
        f"{log.n_samples} samples, the {log.lost_samples} of the pulled cable lost by name; closed in {took:.2f} s"
    )
    record_property("reliability", f"{row} | each told, only what the cable cost is lost | {measured}")
    within(took, 2.0)


@pytest.mark.slow
def test_a_program_that_was_suspended_says_so_and_what_it_cost(rig: Path, tmp_path: Path, record_property: Row) -> None:
    """A device that cannot keep what nobody reads; the reason of a gap alone would blame the link."""
    path = tmp_path / "a.mcap"
    serving = [sys.executable, "-m", "daq", "simulate", str(rig), "--serve", "slcan:pty"]
    with subprocess.Popen(serving, stdout=subprocess.PIPE, text=True) as device:
        assert device.stdout is not None
        session = run(rig, "--link", device.stdout.readline().split()[-1], "--out", str(path))
        before = wait_for(path, lambda log: log.n_samples > 20_000).n_samples
        session.send_signal(signal.SIGSTOP)
        time.sleep(8.0)
        session.send_signal(signal.SIGCONT)
        wait_for(path, lambda log: log.n_samples > before + 20_000)
        session.send_signal(signal.SIGTERM)
        out, error = session.communicate(timeout=PATIENCE_S)
        device.send_signal(signal.SIGTERM)
    log = read_log(path)
    assert session.returncode == 0
    assert log.lost_samples > 4 * 25_600
    assert f"{log.lost_samples} lost in" in out
    assert {"stood_still", "samples_lost"} <= {n.code for n in log.notices}
    assert "warning: this program did not run for 8." in error
    assert "warning: samples lost: " in error
    row = "program suspended | SIGSTOP for 8 s under `rotorscope run`, a device that keeps nothing"
    record_property("reliability", f"{row} | told at once, and what it cost | {log.lost_samples} samples lost by name")


def test_what_listens_does_so_on_loopback_and_says_where(rig: Path, tmp_path: Path) -> None:
    """A served device and the metrics, each in a separate process, neither given an address."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    serving = [sys.executable, "-m", "daq", "simulate", str(rig), "--serve", "serial:socket://:0"]
    with subprocess.Popen(serving, stdout=subprocess.PIPE, text=True) as device:
        assert device.stdout is not None
        url = device.stdout.readline().split()[-1]
        session = run(rig, "--link", url, "--out", str(tmp_path / "a.mcap"), "--metrics", str(port))
        wait_for(tmp_path / "a.mcap", lambda log: log.n_samples > 10_000)
        open_at = [
            (c.laddr.ip, f"socket://127.0.0.1:{c.laddr.port}" in url or c.laddr.port == port)
            for process in (device, session)
            for c in psutil.Process(process.pid).net_connections()
            if c.status == psutil.CONN_LISTEN
        ]
        session.send_signal(signal.SIGTERM)
        _, said = session.communicate(timeout=PATIENCE_S)
        device.send_signal(signal.SIGTERM)
        device.communicate(timeout=PATIENCE_S)
    assert open_at == [("127.0.0.1", True)] * 2
    assert f"127.0.0.1:{port}" in said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("kind", ["serial", "slcan"])
def test_a_stop_before_the_first_sample_has_the_promised_status(
    rig: Path, tmp_path: Path, kind: str, number: signal.Signals, record_property: Row
) -> None:
    """Of a device that says nothing; it was "nothing came", status 3, whoever had asked for the stop."""
    master, slave = pty.openpty()
    os.set_blocking(master, True)
    log = tmp_path / "a.mcap"
    process = run(rig, "--link", f"{kind}:{os.ttyname(slave)}", "--out", str(log))
    try:
        while b"nothing from" not in (line := process.stderr.readline().encode()):  # type: ignore[union-attr]
            assert line, "ended by itself"
        process.send_signal(number)
        asked = time.monotonic()
        _, said = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        os.close(master)
        os.close(slave)
    took = time.monotonic() - asked
    row = f"{number.name} before the first sample, {kind} | a device that says nothing | 2 s, the promised status"
    record_property("reliability", f"{row} | {took:.2f} s, status {process.returncode}")
    assert process.returncode == (130 if number == signal.SIGINT else 0), said
    assert not log.exists()
    within(took, 2.0)
