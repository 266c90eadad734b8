"""Tables on disk: whole or not there, newest first, p-values that pay for the archive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.stats import false_discovery_control

from daq.base.contract.errors import ConfigError, LogError
from daq.batch.tables import CORRECTION_KEY, PIECES_NAME, SCHEMA_KEY, Results


def run(log: str, task: str = "fit", key: str = "", **more: Any) -> dict[str, Any]:
    row = {"key": key or f"{log} {task}", "log": log, "rig": "r.toml", "machine": "m", "task": task}
    row |= {"from_s": None, "window_s": None, "status": "done", "code": "", "reason": "", "notes": [], "rows": {}}
    return row | {"run_at": 1.7e9} | more


def parameter(value: float) -> dict[str, Any]:
    return {"parameters": [{"name": "bearing1.x.kL", "value": value, "sd": 1.0, "unit": "N/m", "identifiable": True}]}


def verdict(p_value: float, name: str = "cubic") -> dict[str, Any]:
    return {"verdicts": [{"verdict": name, "p_value": p_value, "at": ["bearing1"], "codes": []}]}


def table(folder: Path, name: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = pq.read_table(folder / f"{name}.parquet").to_pylist()
    return rows


def store(folder: Path, row: dict[str, Any]) -> None:
    with Results.opened(folder) as results:
        results.add([row])
        results.merge()


class Dying:
    """Writes tables until a number of calls."""

    def __init__(self, dies_at: int) -> None:
        self._left, self._whole = dies_at, pq.write_table

    def __call__(self, *args: Any, **more: Any) -> None:
        self._left -= 1
        if not self._left:
            raise KeyboardInterrupt
        self._whole(*args, **more)


def test_rows_come_in_one_order_whatever_the_order_of_the_work(tmp_path: Path) -> None:
    rows = [run("/b", rows=parameter(2.0)), run("/a", rows=parameter(1.0)), run("/a", "severity")]
    for name, order in (("one", rows), ("two", rows[::-1])):
        with Results.opened(tmp_path / name) as results:
            for row in order:
                results.add([row])
            results.merge()
    for name in ("runs", "parameters", "verdicts", "severity"):
        assert table(tmp_path / "one", name) == table(tmp_path / "two", name)
    assert [(r["log"], r["task"]) for r in table(tmp_path / "one", "runs")] == [
        ("/a", "fit"), ("/a", "severity"), ("/b", "fit"),
    ]  # fmt: skip
    assert [r["value"] for r in table(tmp_path / "one", "parameters")] == [1.0, 2.0]
    assert pq.read_schema(tmp_path / "one" / "runs.parquet").metadata[SCHEMA_KEY.encode()] == b"1"


def test_a_newer_row_of_a_place_takes_the_older_one_with_all_that_came_of_it(tmp_path: Path) -> None:
    with Results.opened(tmp_path) as results:
        results.add([run("/a", key="old", rows=parameter(1.0)), run("/b", key="no rig", rig="", status="failed")])
        results.merge()
        results.add([run("/a", key="new", rows=parameter(2.0)), run("/b", rows=parameter(3.0))])
    with Results.opened(tmp_path) as results:  # the pieces of a command that was killed
        assert [(place[0], run[0]) for place, run in results.known().items()] == [("/a", "new"), ("/b", "/b fit")]
    assert [r["value"] for r in table(tmp_path, "parameters")] == [2.0, 3.0]


def test_a_merge_that_is_cut_off_anywhere_is_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store(tmp_path, run("/a", key="old", rows=parameter(1.0) | verdict(0.5)))
    for stop in range(1, 5):  # at each of the four tables
        row = run("/a", key=f"new {stop}", rows=parameter(2.0 + stop) | verdict(0.1))
        with monkeypatch.context() as patch:
            patch.setattr(pq, "write_table", Dying(stop + 1))  # the first is the piece
            with pytest.raises(KeyboardInterrupt):
                store(tmp_path, row)
        with Results.opened(tmp_path):
            pass
        assert [r["key"] for r in table(tmp_path, "runs")] == [f"new {stop}"]
        assert [r["value"] for r in table(tmp_path, "parameters")] == [2.0 + stop]
        assert len(table(tmp_path, "verdicts")) == 1
        assert not list((tmp_path / PIECES_NAME).iterdir())


def test_a_piece_without_an_end_is_none(tmp_path: Path) -> None:
    with Results.opened(tmp_path) as results:
        results.add([run("/a")])
        results.add([run("/b")])
    first = tmp_path / "pieces" / "00000001.parquet"
    first.write_bytes(first.read_bytes()[:50])
    with Results.opened(tmp_path) as results:
        assert [place[0] for place in results.known()] == ["/b"]


def test_p_values_pay_for_all_records(tmp_path: Path) -> None:
    p_values = np.array([1e-6, 0.004, 0.02, 0.03, 1.0, 1.0, 1.0, 1.0])
    names = ["cubic", "cubic", "cubic", "complete", "complete", "unknown", "complete", "complete"]
    with Results.opened(tmp_path) as results:
        for k, (p, name) in enumerate(zip(p_values, names, strict=True)):
            results.add([run(f"/{k}", "diagnose", rows=verdict(float(p), name))])
        results.add([run("/0", "compare", rows={"verdicts": [{"adequate": True, "codes": []}]})])
        results.merge()
    rows = [r for r in table(tmp_path, "verdicts") if r["task"] == "diagnose"]
    np.testing.assert_allclose([r["p_archive"] for r in rows], false_discovery_control(p_values))
    assert [r["stands"] for r in rows] == [True, True, False, None, None, None, None, None]
    assert {r["p_archive_records"] for r in rows} == {8}
    text = pq.read_schema(tmp_path / "verdicts.parquet").metadata[CORRECTION_KEY.encode()].decode()
    assert "the 8 records of this table (Benjamini-Hochberg)" in text


def test_two_commands_do_not_share_a_folder(tmp_path: Path) -> None:
    with Results.opened(tmp_path), pytest.raises(ConfigError, match="another rotorscope batch"):
        store(tmp_path, run("/a"))


def test_tables_of_others_are_refused(tmp_path: Path) -> None:
    store(tmp_path, run("/a"))
    path = tmp_path / "runs.parquet"
    other = pq.read_table(path).replace_schema_metadata({SCHEMA_KEY: "7"})
    pq.write_table(other, path)
    with Results.opened(tmp_path) as results, pytest.raises(ConfigError, match="its schema is 7"):
        results.known()
    path.write_bytes(b"junk")
    with Results.opened(tmp_path) as results, pytest.raises(LogError, match="cannot be read as a table"):
        results.known()
