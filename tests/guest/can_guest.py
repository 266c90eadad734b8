"""Interfaces, devices and sessions for the tests on real SocketCAN. Processes are forked: importing is slow there."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import psutil
from ramp_device import PERIOD, ramp_device

from daq.base.contract.errors import LogError
from daq.commands.cli.app import main
from daq.log.reader import Recording, read_log
from drivers.contract.reading import Block
from drivers.served.serve import serve

RATE_HZ = 700.0  # 100 frames a second of fd16
CONFIGS = Path(__file__).parents[2] / "configs"
_FORK = multiprocessing.get_context("fork")


def sh(command: str) -> None:
    subprocess.run(command, shell=True, check=True)


def up(*names: str, options: str = "bitrate 1000000") -> None:
    for name in names:
        sh(f"ip link set {name} down; ip link set {name} type can {options}; ip link set {name} txqueuelen 1000 up")


def up_fd(*names: str, restart_ms: int = 0) -> None:
    up(*names, options=f"bitrate 1000000 dbitrate 5000000 fd on restart-ms {restart_ms}")


def inject(name: str, what: str) -> None:
    """Make the driver core of a real interface go through an error."""
    Path("/sys/module/canerr/parameters/inject").write_text(f"{name} {what}\n")


def write_rig(folder: Path) -> Path:
    """The paper's rig, slow enough for the emulation."""
    text = (CONFIGS / "tiwari_vyas_1997.toml").read_text()
    for old, new in (
        ("rate_hz = 25600.0", f"rate_hz = {RATE_HZ}"), ("low = 150.0", "low = 20.0"), ("high = 8000.0", "high = 200.0"),
        ('method = "spectral"', 'method = "score-matching"'),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    path = folder / "rig.toml"
    path.write_text(text)
    return path


class Child:
    """A forked process that runs a function; its output goes to a file."""

    def __init__(self, work: Callable[[], int | None], output: Path) -> None:
        self.output = output
        self._process = _FORK.Process(target=_run, args=(work, output), daemon=True)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid
        self._ps = psutil.Process(self.pid)

    def cpu_s(self) -> float:
        times = self._ps.cpu_times()
        return float(times.user + times.system)

    def wait(self, seconds: float) -> int:
        self._process.join(seconds)
        assert self._process.exitcode is not None, f"still running after {seconds} s: {self.output.read_text()}"
        return self._process.exitcode

    def stop(self, number: int = signal.SIGTERM) -> None:
        if self._process.is_alive():
            os.kill(self.pid, number)


def _run(work: Callable[[], int | None], output: Path) -> None:
    fd = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(fd, 1)
    os.dup2(fd, 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")  # instead of those that pytest listens to
    status = 99
    try:
        status = work() or 0
    except BaseException:  # noqa: BLE001 - the parent reads it in the output
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


class Device:
    """The ramp device in a process of its own, at its own pace, until the end of the test."""

    def __init__(self, folder: Path, interface: str, layout: str = "fd16", rate_hz: float = RATE_HZ) -> None:
        fd = "" if layout != "classic" else "?fd=0"
        device = ramp_device(layout, rate_hz, seconds=None)

        def work() -> None:
            stop = threading.Event()
            signal.signal(signal.SIGTERM, lambda *_: stop.set())
            serve(f"can:socketcan:{interface}{fd}", device, 1.0, stop)

        self._child = Child(work, folder / f"device-{interface}.txt")

    def __enter__(self) -> Device:
        return self

    def __exit__(self, *error: object) -> None:
        self._child.stop()
        status = self._child.wait(30)
        assert status == 0, self._child.output.read_text()


class Session:
    """`rotorscope run --link LINK --out LOG` in a process of its own; `log()` reads what it has written so far."""

    def __init__(self, folder: Path, link: str, *arguments: str) -> None:
        self.path = folder / "a.mcap"
        command = ["run", str(write_rig(folder)), "--link", link, "--out", str(self.path), *arguments]
        self.child = Child(lambda: main(command), folder / "run.txt")

    def log(self) -> Recording | None:
        try:
            return read_log(self.path)
        except LogError:
            return None

    def until(self, what: str, done: Callable[[Recording], bool], seconds: float = 60.0) -> Recording:
        end = time.monotonic() + seconds
        while True:
            log = self.log()
            if log is not None and done(log):
                return log
            assert time.monotonic() < end, f"waited {seconds} s for: {what}; {self.said()}; {_tell(log)}"
            time.sleep(0.3)

    def codes(self) -> set[str]:
        log = self.log()
        return {n.code for n in log.notices} if log else set()

    def said(self) -> str:
        return self.child.output.read_text()

    def share(self, seconds: float) -> float:
        """CPU used during the next seconds, as a share of a core."""
        begin, used = time.monotonic(), self.child.cpu_s()
        time.sleep(seconds)
        return (self.child.cpu_s() - used) / (time.monotonic() - begin)

    def finish(self) -> Recording:
        """SIGTERM, and the whole log: every sample right, every missing one in a gap."""
        asked = time.monotonic()
        self.child.stop()
        status = self.child.wait(60)
        print(f"SIGTERM: ended after {time.monotonic() - asked:.2f} s")
        assert status == 0, self.said()
        log = read_log(self.path)
        assert log.complete, log.damage
        assert_ramp(log)
        assert ("lost" in self.said()) or not log.lost_samples
        return log


def assert_ramp(log: Recording, restarted: bool = False) -> None:
    """Each count is that of its index."""
    blocks = [r for r in log.readings() if isinstance(r, Block)]
    assert blocks
    start = int(blocks[0].counts[0, 0]) - blocks[0].index
    for block in blocks:
        index = np.arange(block.index, block.index + len(block.counts))[:, None] + 100 * np.arange(4)
        np.testing.assert_array_equal((block.counts - start - index) % PERIOD, 0)


def blocks_after(log: Recording, t_ns: int) -> list[Block]:
    return [r for r in log.readings(joined=False) if isinstance(r, Block) and r.t_host_ns > t_ns]


def recovered_after(log: Recording, back_ns: int) -> float:
    """Seconds from the return of the link to the first samples."""
    return (blocks_after(log, back_ns)[0].t_host_ns - back_ns) / 1e9


def loop_s() -> float:
    """CPU time of some plain Python, for comparing processors."""
    taken = []
    for _ in range(9):
        begin = time.process_time()
        total = 0
        for k in range(100_000):
            total += k % 7
        taken.append(time.process_time() - begin)
    return min(taken)


@cache
def slowdown() -> float:
    """How many times slower the emulated core is than the machine's, which run.sh has timed."""
    return max(1.0, loop_s() / float(os.environ["HOST_LOOP_S"]))


def reasons(log: Recording) -> set[str]:
    return {gap.reason for gap in log.gaps if gap.count}


def _tell(log: Recording | None) -> str:
    return "no log" if log is None else f"{log.n_samples} samples, {log.gaps}, {[n.code for n in log.notices]}"


__all__: Sequence[str] = ("Device", "Session", "inject", "up", "up_fd")
