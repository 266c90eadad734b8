"""The command batch on a Dask cluster in this process: rows for all, only missing ones, and texts for the user."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from made_up_archive import RIG_TOML, archive, record, table

from daq import read_log
from daq.commands.cli.app import main
from daq.trend.results import results_rows

ONE_CAP = str(Path(__file__).parents[2] / "data" / "one_cap.toml")
SCHEMA_FILE = Path(__file__).parents[3] / "docs" / "schemas" / "batch.json"


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1,
        threads_per_worker=2,
        processes=False,
        protocol="tcp",
        dashboard_address="127.0.0.1:0",
        memory_limit=0,
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    archive(tmp_path, 3)
    (tmp_path / "junk.npz").write_bytes(b"junk")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def asked(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> dict[str, Any]:
    assert main(["batch", *arguments, "--out", "out", "--json", "-"]) == status
    value: dict[str, Any] = json.loads(capsys.readouterr().out)
    jsonschema.validate(value, json.loads(SCHEMA_FILE.read_text("utf-8")))
    return value


def test_a_second_call_does_what_is_missing(folder: Path, scheduler: str, capsys: pytest.CaptureFixture[str]) -> None:
    common = ("*.npz", "--rig", "rig.toml", "--do", "severity", "--scheduler", scheduler)
    value = asked(capsys, *common)
    assert value["runs"] == {"done": 3, "failed": 1, "already_there": 0}
    assert [reason["code"] for reason in value["reasons"]] == ["log"]
    rows = table(folder / "out", "runs")
    assert [(Path(r["log"]).name, r["status"]) for r in rows] == [
        ("junk.npz", "failed"), ("record000.npz", "done"), ("record001.npz", "done"), ("record002.npz", "done"),
    ]  # fmt: skip
    assert [(r["channel"], r["zone"]) for r in table(folder / "out", "severity")][:2] == [("a", "C"), ("b", "C")]
    assert asked(capsys, *common)["runs"] == {"done": 0, "failed": 0, "already_there": 4}
    record(folder / "record001.npz", seconds=5.0)
    record(folder / "record003.npz")
    assert asked(capsys, *common)["runs"] == {"done": 2, "failed": 0, "already_there": 3}
    record(folder / "junk.npz")
    assert asked(capsys, *common, "--only-failed")["runs"] == {"done": 1, "failed": 0, "already_there": 4}
    (folder / "rig.toml").write_text(RIG_TOML + "# a remark\n")
    assert asked(capsys, *common)["table"] == {"runs": 5, "failed": 0}
    assert {r["status"] for r in table(folder / "out", "runs")} == {"done"}


def test_windows_of_logs_and_rig_files_by_machine(
    folder: Path, scheduler: str, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    (folder / "junk.npz").unlink()
    record(folder / "short.npz", seconds=1.0)
    common = ("{part}.npz", "--rig-of", "{part}.toml", "--do", "severity", "--scheduler", scheduler)
    for name in ("record000", "record001", "short"):
        (folder / f"{name}.toml").write_text(RIG_TOML)
    value = asked(capsys, *common, "--window", "1.5s", "--every", "2s")
    assert value["runs"] == {"done": 6, "failed": 2, "already_there": 0}
    rows = table(folder / "out", "runs")
    assert [(r["machine"], r["task"], r["from_s"], r["status"]) for r in rows if r["machine"] != "record001"] == [
        ("record000", "severity", 0.0, "done"), ("record000", "severity", 2.0, "done"),
        ("record000", "windows", None, "done"), ("record002", "windows", None, "failed"),
        ("short", "windows", None, "failed"),
    ]  # fmt: skip
    again = asked(capsys, *common, "--window", "1.5s", "--every", "2s")
    assert again["runs"]["already_there"] == 6


def test_verdicts_pay_for_the_archive_and_the_numbers_are_those_of_fit(
    folder: Path, scheduler: str, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    text = ("log.mcap", "--rig", ONE_CAP)
    assert main(["simulate", ONE_CAP, "--out", "log.mcap", "--seconds", "4", "--speed", "max", "--quiet"]) == 0
    assert main(["fit", *text, "--json", "-"]) == 0
    own = json.loads(capsys.readouterr().out)["parameters"]
    value = asked(capsys, *text, "--do", "fit,diagnose", "--scheduler", scheduler)
    assert (value["runs"]["done"], value["correction"]["records"]) == (2, 1)
    assert {r["name"]: r["value"] for r in table(folder / "out", "parameters")} == {
        name: p["value"] for name, p in own.items()
    }
    (verdict,) = table(folder / "out", "verdicts")
    assert (verdict["p_archive"], verdict["p_archive_records"]) == (verdict["p_value"], 1)


def test_windows_are_a_trend_at_their_own_times(
    folder: Path, scheduler: str, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    simulate = ("simulate", ONE_CAP, "--out", "log.mcap", "--seconds", "3", "--speed", "max", "--quiet")
    assert main(list(simulate)) == 0
    asked(capsys, "log.mcap", "--rig", ONE_CAP, "--do", "severity", "--window", "1s", "--scheduler", scheduler)
    started = read_log("log.mcap").started
    times = sorted(set(results_rows(folder / "out")["time"].to_pylist()))
    assert started is not None
    assert [(time - started).total_seconds() for time in times] == pytest.approx([0.0, 1.0, 2.0], abs=2e-3)


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["*.npz"], 2, "give one of --rig RIG"),
        (["*.npz", "--rig", "rig.toml", "--rig-of", "{a}.toml"], 2, "give one of --rig RIG"),
        (["*.mcap", "--rig", "rig.toml"], 2, "no file matches"),
        (["*.npz", "--rig", "none.toml"], 2, "no such rig file"),
        (["*.npz", "--rig", "rig.toml", "--do", "fits"], 2, "is no analysis"),
        (["*.npz", "--rig", "rig.toml", "--scheduler", "local:many"], 2, "local:4"),
        (["*.npz", "--rig", "rig.toml", "--scheduler", "10.0.0.5"], 2, "tcp://10.0.0.5:8786"),
        (["*.npz", "--rig", "rig.toml", "--out", "rig.toml"], 2, "choose another folder"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], status: int, words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [] if "--out" in arguments else ["--out", "out"]
    assert main(["batch", *arguments, *out]) == status
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1


def test_an_archive_of_junk_ends_with_the_status_of_a_log(
    folder: Path, scheduler: str, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    common = ("junk.npz", "--rig", "rig.toml", "--do", "severity,fit", "--scheduler", scheduler)
    assert asked(capsys, *common, status=4)["runs"] == {"done": 0, "failed": 2, "already_there": 0}
