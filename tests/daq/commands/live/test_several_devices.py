"""`rotorscope run` with several rigs: real ptys, one process; what happens to one device does not happen to another."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import signal
import socket
import struct
import subprocess
import sys
import termios
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from cable import Cable
from promises import PATIENCE_S, Late, until, within
from ramp_device import PERIOD

from daq.base.contract.errors import LogError
from daq.commands.cli.app import main
from daq.log.reader import read_log

ROOT = Path(__file__).parents[4]
SCHEMA = json.loads((ROOT / "tests" / "data" / "schemas" / "run.json").read_text())


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    text = (ROOT / "configs" / "tiwari_vyas_1997.toml").read_text()
    path = tmp_path / "press.toml"
    path.write_text(text.replace('method = "spectral"', 'method = "score-matching"'))
    return path


@pytest.fixture
def cables(tmp_path: Path) -> Iterator[list[Cable]]:
    both = [Cable(tmp_path / name) for name in ("ttyA", "ttyB")]
    yield both
    for cable in both:
        cable.close()


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "daq", "run", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def rows(path: Path) -> int:
    """0 as long as nothing is to be read: a new log may just have taken the place of the old one."""
    try:
        return read_log(path).n_samples
    except LogError:
        return 0


@pytest.mark.slow
def test_one_is_pulled_one_comes_late_one_never(
    rig: Path, cables: list[Cable], tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """Two devices of one rig file and a third that is not there; the second is plugged in late, and pulled."""
    logs, result = tmp_path / "logs", tmp_path / "run.json"
    cables[1].pull()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    devices = [f"{rig}=serial:{cables[0].name}", f"{rig}=serial:{cables[1].name}", f"{rig}=serial:{tmp_path}/ttyC"]
    session = start(*devices, "--out", logs, "--json", result, "--metrics", str(port))
    first, second = logs / "press.mcap", logs / "press-2.mcap"
    until(lambda: rows(first) > 20_000)
    cables[1].plug()
    until(lambda: rows(second) > 20_000)
    served = urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S).read().decode()
    cables[1].pull()
    before = rows(first)
    until(lambda: rows(first) > before + 40_000)
    asked = time.time()
    session.send_signal(signal.SIGTERM)
    out, said = session.communicate(timeout=PATIENCE_S)
    took = max(path.stat().st_mtime for path in (first, second)) - asked
    assert session.returncode == 3, said
    assert 'rotorscope_samples_total{device="press"}' in served
    assert 'rotorscope_samples_total{device="press-2"}' in served
    for path, name in ((first, "press"), (second, "press-2")):
        log = read_log(path)
        assert log.complete, log.damage
        assert log.head.device == name
        counts = log.counts()[:, 0].astype(np.int64)
        there = counts > np.iinfo(np.int32).min
        assert len(np.unique((counts[there] + PERIOD // 2 - log.first - np.flatnonzero(there)) % PERIOD)) == 1
    assert not read_log(first).gaps
    assert "link_lost" in {n.code for n in read_log(second).notices}
    assert sorted(os.listdir(logs)) == ["press-2.mcap", "press.mcap"]
    value = json.loads(result.read_text())
    assert [d["exit_status"] for d in value["devices"]] == [0, 0, 3]
    for one in value["devices"]:
        jsonschema.validate(one, SCHEMA)
    assert [d["device"] for d in value["devices"]] == ["press", "press-2", "press-3"]
    lines = said.splitlines()
    assert sum(line.startswith("rotorscope: press-3: error: ") for line in lines) == 1
    assert lines[-1].startswith("rotorscope: press-3: ")
    assert "press-2 (serial:" in " ".join(out.split())  # a long path wraps
    row = "several devices | `rotorscope run` with three: one comes late and is pulled, one never comes"
    promised = "the first has no gap, each its own log, exit status of the worst"
    record_property("reliability", f"{row} | {promised} | no gap; all closed in {took:.2f} s; status 3")
    within(took, 2.0)


def test_all_well_and_ctrl_c(rig: Path, cables: list[Cable], tmp_path: Path) -> None:
    fan = tmp_path / "fan.toml"
    fan.write_text(re.sub(r"(?m)^url = .*$", f'url = "serial:{cables[1].name}"', rig.read_text()))
    devices = (f"{rig}=serial:{cables[0].name}", fan)
    session = start(*devices, "--out", tmp_path / "logs", "--seconds", "1", "--json", "-")
    out, said = session.communicate(timeout=PATIENCE_S)
    assert session.returncode == 0, said
    assert [(d["device"], d["samples"]) for d in json.loads(out)["devices"]] == [("press", 25_600), ("fan", 25_600)]
    session = start(*devices, "--out", tmp_path / "logs")
    until(lambda: rows(tmp_path / "logs" / "fan.mcap") > 40_000)
    session.send_signal(signal.SIGINT)
    _, said = session.communicate(timeout=PATIENCE_S)
    assert session.returncode == 130
    assert all(read_log(tmp_path / "logs" / f"{name}.mcap").complete for name in ("press", "fan"))


FLOOD = """
import socket
from ramp_device import ramp_device
from drivers.serial import cobs
device, listener = ramp_device("serial16", seconds=None), socket.create_server(("127.0.0.1", 0))
print(listener.getsockname()[1], flush=True)
reader, _ = listener.accept()
try:
    while True:
        reader.sendall(b"".join(cobs.encode(frame.data) for frame in device.next(400)))
except OSError:
    pass
"""


@pytest.mark.slow
def test_one_that_floods_does_not_disturb_another(
    rig: Path, cables: list[Cable], tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """A device that sends as fast as TCP takes it, tens of times what was agreed, beside one that keeps its pace."""
    logs = tmp_path / "logs"
    path = os.pathsep.join([str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", ""), str(ROOT)])
    with subprocess.Popen(
        [sys.executable, "-c", FLOOD], stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": path}
    ) as flood:
        assert flood.stdout is not None
        port = int(flood.stdout.readline())
        session = start(f"{rig}=serial:{cables[0].name}", f"{rig}=serial:socket://127.0.0.1:{port}", "--out", logs)
        until(lambda: rows(logs / "press.mcap") > 100_000)
        session.send_signal(signal.SIGTERM)
        asked = time.monotonic()
        session.communicate(timeout=PATIENCE_S)
        took = time.monotonic() - asked
        flood.kill()
    pressed, flooded = read_log(logs / "press.mcap"), read_log(logs / "press-2.mcap")
    assert session.returncode == 0
    assert pressed.complete
    assert flooded.complete
    assert not pressed.gaps
    assert {gap.reason for gap in flooded.gaps} <= {"overflow"}
    times = (flooded.n_samples + flooded.lost_samples) / pressed.n_samples
    row = "a device that floods | TCP, as fast as it goes, beside one that keeps its pace | the other has no gap,"
    measured = f"{times:.0f} times its rate, {flooded.lost_samples} samples lost by name; closed in {took:.2f} s"
    record_property("reliability", f"{row} its own loss is a gap `overflow`, both closed within 2 s | {measured}")
    within(took, 2.0)


def test_mistakes_are_reported_before_anything_begins(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = [f"{rig}=virtual:", str(rig)]
    for arguments, text in (
        ([*two, "--link", "virtual:"], "RIG=LINK for each"),
        ([*two, "--out", str(tmp_path / "a.mcap")], "give a folder"),
        ([f"{rig}=virtual:", f"{rig}=nonsense:x", "--out", str(tmp_path / "logs")], "nonsense"),
        ([f"{rig}=virtual:", f"{tmp_path}/no.toml"], "no.toml"),
        ([f"{rig}="], "no link after"),
        ([str(rig), "--link", ""], "the link is empty"),
        ([str(rig), "--link", "serial:/dev/ttyNOPE"], "serial:/dev/ttyNOPE: No such file or directory: check the name"),
        ([f"{rig}=virtual:", "--link", "virtual:"], "RIG=LINK"),
    ):
        assert main(["run", *arguments]) in (2, 3)
        said = capsys.readouterr().err
        assert text in said, said
        assert len(said.splitlines()) == 1
    assert not list((tmp_path / "logs").glob("*"))


@pytest.mark.slow
def test_a_terminal_shows_a_row_for_each(rig: Path, tmp_path: Path) -> None:
    """Standard error is a real terminal, 160 columns wide; a worker of the test run says that it has 80."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 160, 0, 0))
    devices = [f"{rig}=virtual:", f"{rig}=virtual:", f"{rig}=serial:{tmp_path}/ttyC"]
    command = [sys.executable, "-m", "daq", "run", *devices, "--seconds", "3"]
    environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES")} | {"TERM": "xterm"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=theirs, env=environment) as session:
        os.close(theirs)
        shown = b""
        while True:
            try:
                piece = os.read(ours, 65536)
            except OSError:  # the other end is closed
                break
            if not piece:
                break
            shown += piece
    os.close(ours)
    assert session.returncode == 3
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.decode())
    assert re.search(r"device +seconds +samples/s +gaps +lost +CRC errors +lag +estimate", text)
    drawn = {name: re.findall(rf"(?m)^{name} +(\S+) +(\S+) +\d+ +(\d+) ", text) for name in ("press", "press-2")}
    for rows_of_one in drawn.values():
        assert max(float(seconds) for seconds, _, _ in rows_of_one if seconds != "-") > 1.0
        if not any(rate != "-" and abs(float(rate) - 25_600) < 3_000 for _, rate, _ in rows_of_one):
            raise Late(f"never near 25600 samples a second: {rows_of_one}")
        assert {lost for _, _, lost in rows_of_one} == {"0"}
    assert re.search(r"press-3 .*waits for its link", text)
