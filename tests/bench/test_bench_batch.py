"""An archive: two workers against one, tables open in a second, the memory of each analysis against its bound."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from promises import Late, crowding

REPOSITORY_FOLDER = Path(__file__).parents[2]
ONE_CAP = REPOSITORY_FOLDER / "tests" / "data" / "one_cap.toml"
FOUR_CHANNELS = REPOSITORY_FOLDER / "configs" / "tiwari_vyas_1997.toml"
LOG_COUNT, ROW_COUNT = 64, 10_000
LEAST_RATIO = 0.85 * 2.0  # of the rates of two workers and one
ONE_THREAD_ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY_FOLDER)}
MEMORY_PROGRAM = """
import json, sys
from daq.base.console.output import version
from daq.batch.archive import find_logs, read_rig
from daq.batch.task import Task
from daq.batch.work import answer
log, rig, names, seconds = sys.argv[1:]
rig = read_rig(rig)
for log in find_logs([log], lambda *_: rig):
    for name in names.split(","):
        row = answer(Task(log=log, name=name, version=version(), from_s=0.0, seconds=float(seconds)))
        print(json.dumps({k: row[k] for k in ("task", "status", "bound_mb", "peak_mb", "took_s")}))
"""


def program(*arguments: str, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=ONE_THREAD_ENVIRONMENT, capture_output=True, text=True, check=True
    )
    return done.stdout


def simulated(rig: Path, out: Path, seconds: float) -> None:
    program("-m", "daq", "simulate", str(rig), "--out", str(out), "--seconds", f"{seconds:g}", "--speed", "max",
            folder=out.parent)  # fmt: skip


@pytest.mark.bench
@pytest.mark.timeout(900)
def test_two_workers_do_nearly_twice_what_one_does(tmp_path: Path) -> None:
    """On a machine that others use, wall time says nothing. Two things make two workers less than twice one: the time
    in which they wait for tasks, and that a task takes more of a core beside another. Both are measured there too.
    """
    import pyarrow.parquet as pq

    (tmp_path / "logs").mkdir()
    simulated(ONE_CAP, tmp_path / "logs" / "log00.mcap", 60.0)
    for k in range(1, LOG_COUNT):
        shutil.copy(tmp_path / "logs" / "log00.mcap", tmp_path / "logs" / f"log{k:02d}.mcap")
    seconds, busy_share, core_s = {}, {}, {}
    for workers in (1, 2):
        common = ("--rig", str(ONE_CAP), "--do", "severity,fit", "--out", f"out{workers}", "--json", "-")
        said = program("-m", "daq", "batch", "logs/*.mcap", *common, "--scheduler", f"local:{workers}", folder=tmp_path)
        value = json.loads(said)
        assert value["runs"] == {"done": 2 * LOG_COUNT, "failed": 0, "already_there": 0}
        runs = pq.read_table(tmp_path / f"out{workers}" / "runs.parquet").to_pydict()
        seconds[workers] = value["seconds"]
        busy_share[workers] = sum(runs["took_s"]) / (workers * value["seconds"])
        core_s[workers] = sum(runs["cpu_s"])
    wall, crowd = seconds[1] / seconds[2], crowding()
    ratio = 2.0 * busy_share[2] / busy_share[1] * core_s[1] / core_s[2]
    print(
        f"\n{LOG_COUNT} logs of 60 s, severity and fit, start and end of the workers included: one {seconds[1]:.1f} s, "
        f"two {seconds[2]:.1f} s, ratio {wall:.2f} (asked {LEAST_RATIO:g}); busy {busy_share[1]:.2f} and "
        f"{busy_share[2]:.2f} of the time, {core_s[1]:.1f} and {core_s[2]:.1f} s of a core, so {ratio:.2f} on cores of "
        f"their own; each core is shared by {crowd:.2f}"
    )
    if max(wall, ratio) < LEAST_RATIO:
        raise Late(f"ratio {wall:.2f}, {ratio:.2f}")


@pytest.mark.bench
def test_ten_thousand_rows_are_open_in_a_second(tmp_path: Path) -> None:
    from daq.batch.tables import Results

    def row(k: int) -> dict[str, Any]:
        of_run = {"key": f"{k:020x}", "log": f"/archive/m{k % 100}/{k}.mcap", "rig": "r.toml", "machine": f"m{k % 100}"}
        verdict = {"verdict": "complete", "p_value": 1.0 - k / ROW_COUNT, "at": [], "codes": []}
        values = [{"name": f"bearing1.x.p{i}", "value": 1.0 * k, "sd": 1.0, "unit": "N/m", "identifiable": True}
                  for i in range(4)]  # fmt: skip
        return of_run | {
            "task": "diagnose", "from_s": None, "window_s": None, "status": "done", "code": "", "reason": "",
            "notes": [], "run_at": 1.7e9, "started": 1.7e9 + k, "rows": {"verdicts": [verdict], "parameters": values},
        }  # fmt: skip

    with Results.opened(tmp_path) as results:
        for first in range(0, ROW_COUNT, 500):
            results.add([row(k) for k in range(first, first + 500)])
        begin = time.perf_counter()
        results.merge()
        merged_s = time.perf_counter() - begin
    code = (
        "import time; b = time.perf_counter(); import pandas; i = time.perf_counter()\n"
        "t = [pandas.read_parquet(f'{n}.parquet') for n in ('runs', 'parameters', 'verdicts', 'severity')]\n"
        "print(i - b, time.perf_counter() - i, [len(x) for x in t])"
    )
    imported_s, opened_s, *counts = program("-c", code, folder=tmp_path).split(maxsplit=2)
    begin = time.perf_counter()
    with Results.opened(tmp_path) as results:
        assert len(results.known()) == ROW_COUNT
    again_s = time.perf_counter() - begin
    print(
        f"\n{ROW_COUNT} runs, rows {counts[0].strip()}: pandas opens all four tables in {float(opened_s):.2f} s "
        f"(asked 1; pandas itself {float(imported_s):.2f} s); what is there already is known in {again_s:.2f} s; "
        f"merged in {merged_s:.2f} s"
    )
    if max(float(opened_s), again_s) > 1.0 * crowding():
        raise Late(f"{opened_s} s, {again_s:.2f} s")


@pytest.mark.bench
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("rig", "seconds"), [(ONE_CAP, 60.0), (FOUR_CHANNELS, 60.0)])
def test_memory_stays_below_its_bound(rig: Path, seconds: float, tmp_path: Path) -> None:
    made = rig.with_name("worn_bearing.toml") if rig != ONE_CAP else rig
    simulated(made, tmp_path / "log.mcap", seconds)
    for length in (seconds / 3.0, seconds):
        said = program("-c", MEMORY_PROGRAM, "log.mcap", str(rig), "severity,fit,compare,diagnose", f"{length:g}",
                       folder=tmp_path)  # fmt: skip
        for line in said.splitlines():
            row = json.loads(line)
            print(f"\n{rig.stem}, {length:g} s, {row['task']}: {row['peak_mb']:.0f} MB of {row['bound_mb']:.0f} MB, "
                  f"{row['took_s']:.1f} s", end="")  # fmt: skip
            assert row["status"] == "done"
            assert row["peak_mb"] < row["bound_mb"]
