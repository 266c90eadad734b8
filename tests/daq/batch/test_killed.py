"""Processes over TCP: a worker, the scheduler and the command are killed, and the tables are as undisturbed."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from made_up_archive import table
from promises import PATIENCE_S

from daq.commands.cli.app import main

REPOSITORY_FOLDER = Path(__file__).parents[3]
RIG_FILE = REPOSITORY_FOLDER / "tests" / "data" / "one_cap.toml"
TABLE_NAMES = ("runs", "parameters", "verdicts", "severity")
LOG_COUNT = 16
ONE_THREAD_ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY_FOLDER)}
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


def started(*arguments: str, folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", *arguments]
    return subprocess.Popen(
        command, cwd=folder, env=ONE_THREAD_ENVIRONMENT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )


def batch(
    folder: Path, out: str, *more: str, do: str = "severity,fit", logs: str = "*"
) -> subprocess.Popen[str]:  # fmt: skip
    common = ("--rig", str(RIG_FILE), "--do", do, "--out", out)
    return started("daq", "batch", f"logs/{logs}.mcap", *common, *more, folder=folder)


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    said, _ = process.communicate(timeout=5 * PATIENCE_S)  # a minute's work, on a machine that others use
    return process.returncode, said


def wait_for(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def under_way(folder: Path, out: str) -> None:
    """Until something of a batch is stored."""
    wait_for(lambda: list((folder / out / "pieces").glob("*.parquet")))


@contextmanager
def cluster(folder: Path, *options: str) -> Iterator[tuple[str, subprocess.Popen[str], list[subprocess.Popen[str]]]]:
    """Address, process of the scheduler, and two nannies with a worker each."""
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    common = ("--no-dashboard", "--scheduler-file", str(file))
    own = started("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", *common, folder=folder)
    processes = [own]
    try:
        wait_for(lambda: file.exists() and "address" in file.read_text())
        found = re.search(r"tcp://127.0.0.1:\d+", file.read_text())
        assert found is not None
        worker = ("distributed.cli.dask_worker", found[0], "--nthreads", "1", "--no-dashboard", *options)
        nannies = [started(*worker, "--local-directory", str(folder / "scratch"), folder=folder) for _ in range(2)]
        processes += nannies
        yield found[0], own, nannies
    finally:
        for process in processes[::-1]:
            for child in psutil.Process(process.pid).children(recursive=True) if process.poll() is None else ():
                child.kill()
            process.kill()
            process.communicate()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive, and in `whole` the tables of a batch that nothing disturbed."""
    folder = tmp_path_factory.mktemp("archive")
    (folder / "logs").mkdir()
    first = folder / "logs" / "log00.mcap"
    assert main(["simulate", str(RIG_FILE), "--out", str(first), "--seconds", "60", "--speed", "max", "--quiet"]) == 0
    for k in range(1, LOG_COUNT):
        shutil.copy(first, folder / "logs" / f"log{k:02d}.mcap")
    (folder / "logs" / "log99.mcap").write_bytes(first.read_bytes()[:100])
    status, said = ended(batch(folder, "whole"))
    assert status == 0, said
    assert [r["status"] for r in table(folder / "whole", "runs")].count("done") == 2 * LOG_COUNT
    return folder


def same(folder: Path, out: str) -> None:
    for name in TABLE_NAMES:
        assert table(folder / out, name) == table(folder / "whole", name), name


def test_a_worker_is_killed(folder: Path) -> None:
    with cluster(folder) as (address, _, nannies):
        process = batch(folder, "worker", "--scheduler", address)
        under_way(folder, "worker")
        for nanny in nannies:
            psutil.Process(nanny.pid).children()[-1].kill()  # the other one is multiprocessing's own
        status, said = ended(process)
    assert status == 0, said
    same(folder, "worker")


def test_the_scheduler_is_killed(folder: Path) -> None:
    with cluster(folder) as (address, scheduler, _):
        process = batch(folder, "scheduler", "--scheduler", address)
        under_way(folder, "scheduler")
        scheduler.kill()
        status, said = ended(process)
    assert status == 3, said
    assert "the scheduler is gone" in said
    assert said.count("\n") == 1
    kept = len(table(folder / "scheduler", "runs"))
    assert 0 < kept < 2 * LOG_COUNT
    with cluster(folder) as (address, _, _):
        status, said = ended(batch(folder, "scheduler", "--scheduler", address))
    assert status == 0, said
    assert f"{kept} there already" in said
    same(folder, "scheduler")


def test_the_command_is_killed_and_takes_its_workers_along(folder: Path) -> None:
    process = batch(folder, "command", "--scheduler", "local:2")
    under_way(folder, "command")
    workers = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    wait_for(lambda: not any(worker.is_running() for worker in workers))
    assert not (folder / "command" / "runs.parquet").exists() or len(table(folder / "command", "runs")) < 2 * LOG_COUNT
    status, said = ended(batch(folder, "command", "--scheduler", "local:2"))
    assert status == 0, said
    assert " 0 there already" not in said
    same(folder, "command")


def test_ctrl_c_keeps_what_is_done(folder: Path) -> None:
    process = batch(folder, "interrupted", "--scheduler", "local:2")
    under_way(folder, "interrupted")
    for each in (psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)):  # as a terminal
        each.send_signal(signal.SIGINT)
    status, said = ended(process)
    assert status == 130, said
    assert "what is done is kept" in said
    assert said.count("\n") == 2, said
    kept = len(table(folder / "interrupted", "runs"))
    status, said = ended(batch(folder, "interrupted", "--scheduler", "local:2"))
    assert f"{kept} there already" in said
    same(folder, "interrupted")


def test_ctrl_c_while_the_workers_start_is_handled(folder: Path) -> None:
    process = batch(folder, "early", "--scheduler", "local:2")
    wait_for(lambda: psutil.Process(process.pid).children(recursive=True))
    for each in (psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)):
        each.send_signal(signal.SIGINT)
    status, said = ended(process)
    assert status == 130, said
    assert said.count("\n") <= 2, said
    assert len(table(folder / "early", "runs")) < 2 * LOG_COUNT


def test_what_takes_too_long_or_too_much_memory_is_a_row(folder: Path) -> None:
    with cluster(folder, "--memory-limit", "1GB") as (address, _, _):
        common = ("--scheduler", address)
        status, said = ended(batch(folder, "small", *common, do="diagnose", logs="log0[0-2]"))
        assert status == 4, said
        reasons = [r["reason"] for r in table(folder / "small", "runs") if r["code"] == "memory"]
        assert len(reasons) == 3
        assert "diagnose may take 1.1 GB of memory, and the worker has 1 GB: give --window" in reasons[0]
        windows = ("--window", "30s", "--every", "10min")
        status, said = ended(batch(folder, "small", *common, *windows, do="fit", logs="log0[0-2]"))
        assert status == 0, said
    with cluster(folder) as (address, _, _):
        common = ("--scheduler", address)
        status, said = ended(batch(folder, "slow", *common, "--timeout", "1", do="diagnose", logs="log0[0-2]"))
        codes = [r["code"] for r in table(folder / "slow", "runs")]
        assert codes.count("time") > 0, said
        status, said = ended(batch(folder, "slow", *common, "--only-failed", do="diagnose", logs="log0[0-2]"))
        assert status == 0, said
        assert [r["code"] for r in table(folder / "slow", "runs")] == [""] * 3


def test_a_task_that_ends_its_worker_is_a_row(folder: Path, tmp_path: Path) -> None:
    """A law of the user's that ends every process that a process has started."""
    (tmp_path / "law.py").write_text(
        "import multiprocessing, os\nfrom estimator import CATALOGUE\n"
        "LAW = CATALOGUE['cubic']\nif multiprocessing.parent_process() is not None:\n    os._exit(9)\n"
    )
    text = RIG_FILE.read_text("utf-8") + '[[model.custom]]\nname = "law"\nmodule = "law.py:LAW"\nat = ["bearing1"]\n'
    (tmp_path / "rig.toml").write_text(text)
    command = ("logs/log00.mcap", "--rig", str(tmp_path / "rig.toml"), "--do", "severity", "--out", "ends")
    status, said = ended(started("daq", "batch", *command, "--scheduler", "local:1", folder=folder))
    assert status == 4, said
    (row,) = table(folder / "ends", "runs")
    assert row["code"] == "worker"
    assert "ended its worker each time" in row["reason"]
