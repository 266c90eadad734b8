"""The trend on disk: a file a day, whole after a crash, and what a session puts into it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from promises import until
from sessions import RATE_HZ, make_block, make_estimate, make_session, make_status

from daq.trend.days import DayWriter, Row, read_days, table
from daq.trend.store import TrendStore
from drivers.contract.reading import Gap, Notice

DAY_S, S_NS = 86_400, 10**9
T0_NS = 1_700_006_400 * S_NS  # 2023-11-15, midnight
LAYERS: dict[str, Any] = {
    "record": {"channels": {"b1x": {"unit": "m/s^2", "rms": 2.0, "velocity_rms_mm_s": 3.1, "zone": "B"}}},
    "machine": {
        "speed_rpm": {"value": 2100.0, "sd": 1.0, "source": "record"},
        "tones": [{"kind": "order", "order": 1.0, "frequency_hz": 35.0, "amplitude": {"b1x": 0.5}, "unit": "m/s^2"}],
        "strikes": [{"name": "BPFO", "order": 3.58, "frequency_hz": 125.0, "channel": "b1x", "p_value": 1e-9,
                     "severity": 0.4}],
    },
}  # fmt: skip


def rows(folder: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = read_days(folder).to_pylist()
    return found


def test_a_day_is_a_file(tmp_path: Path) -> None:
    writer = DayWriter(tmp_path)
    for k in range(3):
        writer.append([Row(T0_NS + k * DAY_S * S_NS, "estimate", "a", float(k), 0.1, "N/m")])
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "2023-11-15.parquet", "2023-11-16.parquet", "2023-11-17.0.arrows",
    ]  # fmt: skip
    assert [r["value"] for r in rows(tmp_path)] == [0.0, 1.0, 2.0]
    writer.end_day()
    again = DayWriter(tmp_path)
    again.append([Row(T0_NS + 2 * DAY_S * S_NS + 5, "estimate", "a", 9.0)])
    again.end_day()
    assert [r["value"] for r in rows(tmp_path)] == [0.0, 1.0, 2.0, 9.0]
    assert len(list(tmp_path.iterdir())) == 3


def test_what_a_crash_leaves_is_read_and_put_in_order(tmp_path: Path) -> None:
    writer = DayWriter(tmp_path)
    for k in range(20):
        writer.append([Row(T0_NS + k, "estimate", "a", float(k))])
    (stream,) = tmp_path.glob("*.arrows")
    data = stream.read_bytes()
    writer.end_day()
    folder = tmp_path / "killed"
    folder.mkdir()
    (folder / "2023-11-15.0.arrows").write_bytes(data[: len(data) - 70])
    (folder / "2023-11-15.1.arrows").write_bytes(b"")
    before = rows(folder)
    assert 15 <= len(before) < 20
    DayWriter(folder)
    assert [p.name for p in folder.iterdir()] == ["2023-11-15.parquet"]
    assert rows(folder) == before


def test_a_disk_that_fails_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = DayWriter(tmp_path / "trend")
    writer.append([Row(T0_NS, "estimate", "a", 0.0)])
    (tmp_path / "trend").rename(tmp_path / "moved")
    writer.append([Row(T0_NS + DAY_S * S_NS - 1, "estimate", "a", 1.0)])  # the stream is open
    with pytest.raises(OSError, match="No such file"):
        writer.append([Row(T0_NS + DAY_S * S_NS, "estimate", "a", 2.0)])
    (tmp_path / "moved").rename(tmp_path / "trend")
    writer.append([Row(T0_NS + DAY_S * S_NS + 1, "estimate", "a", 3.0)])
    assert [r["value"] for r in rows(tmp_path / "trend")] == [0.0, 1.0, 2.0, 3.0]
    writer.end_day()


def test_a_session_puts_its_numbers_into_the_trend(tmp_path: Path) -> None:
    store = TrendStore(tmp_path, live=False, wall_offset_ns=T0_NS - 10**12, every_s=0.1)
    store.start(make_session())
    for k in range(10):
        store.readings([make_block(1024 * k, 1024)])
        store.estimate(make_estimate(1024 * k + 1000))
        store.layers(0, LAYERS)
    store.readings([Gap(10_240, 76, "crc"), Notice(10**12, "warning", "clipped", "b1x at full scale\nmore")])
    store.close()
    found = rows(tmp_path)
    kinds = {(r["kind"], r["name"]) for r in found}
    assert kinds >= {
        ("estimate", "bearing1.x.kL"), ("severity", "b1x.velocity_rms_mm_s"), ("severity", "b1x.rms"),
        ("tone", "1X.b1x"), ("strikes", "BPFO"), ("speed", "shaft"), ("gap", "crc"), ("notice", "clipped"),
    }  # fmt: skip
    assert ("estimate", "bearing1.x.c") not in kinds  # what the data cannot tell is no number
    values = [r for r in found if r["name"] == "bearing1.x.kL"]
    assert len(values) == 4  # the last of each 0.1 s
    last = values[-1]
    assert (last["value"], last["sd"], last["unit"]) == (1e7 + 10_216 / 3, 1e4, "N/m")
    assert last["time"].timestamp() == pytest.approx(T0_NS / 1e9 + 10_217 / RATE_HZ, abs=2e-4)
    (zone,) = {r["text"] for r in found if r["name"] == "b1x.velocity_rms_mm_s"}
    assert zone == "B"
    assert [r["value"] for r in found if r["kind"] == "gap"] == [76.0]


def test_a_warning_does_not_wait_for_the_minute(tmp_path: Path) -> None:
    store = TrendStore(tmp_path, wall_offset_ns=T0_NS - 10**12)
    store.start(make_session())
    store.readings([make_block(0, 1024), Notice(10**12, "warning", "alarm", "kL")])
    store.status(make_status(1024))
    until(lambda: [r["name"] for r in rows(tmp_path)] == ["alarm"])
    store.close()


def test_columns_have_their_version() -> None:
    assert table([Row(T0_NS, "a", "b")]).schema.metadata == {b"rotorscope.trend": b"1"}
