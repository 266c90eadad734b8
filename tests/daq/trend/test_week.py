"""A week of a machine as fast as it goes: segments, retention, trend and an alarm; memory and handles stay."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from stand_ins import ScriptedDriver

from daq.base.contract.dates import Recorded
from daq.log.reader import read_log
from daq.rig.rig import Rig
from daq.session.acquire import acquire_from
from daq.session.estimation import block_rows
from daq.trend.alarms.watch import AlarmWatch
from daq.trend.folder import sessions
from daq.trend.names import segments
from daq.trend.segments import SegmentedLog
from daq.trend.series import read_trend
from daq.trend.sizes import Cut, Keep
from daq.trend.store import TrendStore
from drivers.contract.reading import Block, Info, Notice, Reading, Signal
from estimator.model.rig import Model
from estimator.results import Estimate, Parameter

pytestmark = [pytest.mark.soak, pytest.mark.timeout(3600)]
RATE_HZ, ROWS = 5.0, 50
DAY_S, HOUR_S = 86_400, 3600
CHANGED_DAY = 4.5  # the level of the signal rises by 5 % then
T0_NS = 1_700_006_400 * 10**9  # midnight
RIG = Rig.parse("""schema = 1
[rig]
name = "press"
[band]
low = 0.2
high = 2.0
[acquisition]
rate_hz = 5.0
[[channel]]
name = "x"
node = "bearing1"
direction = "x"
unit = "m/s^2"
[[alarm]]
what = "bearing1.x.kL"
change = "5 %"
""")


class LevelEstimator:
    """Says as kL the mean level of the last ten seconds: a number that is known."""

    def __init__(self, model: Model, rate_hz: float) -> None:
        self._level, self._share, self._n = 0.0, 1.0 / (10.0 * rate_hz), 0

    def update(self, block: NDArray[np.float64]) -> None:
        for value in np.abs(block[:, 0]).tolist():
            self._level += self._share * (value - self._level) if self._n else value
            self._n += 1

    def snapshot(self) -> Estimate:
        return Estimate(self._n - 1, {"bearing1.x.kL": Parameter(1e7 * self._level, 1e5, "N/m")}, 50.0)


def own_mb() -> float:
    """Memory that only we fill."""
    lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    return sum(int(line[1]) for line in lines if line[0] in ("RssAnon:", "VmSwap:")) / 1e3


def test_a_week(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    days = float(os.environ.get("ROTORSCOPE_WEEK_DAYS", "7"))
    mb, handles, notices = list[float](), list[int](), list[Notice]()
    rng = np.random.default_rng(1)

    def stream() -> Iterator[list[Reading]]:
        yield [Info((Signal("x", "m/s^2", 1e-3),), RATE_HZ)]
        for k in range(int(days * DAY_S * RATE_HZ / ROWS)):
            seconds = k * ROWS / RATE_HZ
            level = 1000.0 * (1.05 if seconds > CHANGED_DAY * DAY_S else 1.0)
            counts = np.round(level * (1.0 + 0.05 * rng.standard_normal((ROWS, 1)))).astype(np.int32)
            if k % round(6 * HOUR_S * RATE_HZ / ROWS) == 0:
                mb.append(own_mb())
                handles.append(len(os.listdir("/proc/self/fd")))
            yield [Block(k * ROWS, counts, T0_NS + round((k + 1) * ROWS * 1e9 / RATE_HZ))]

    keep = Keep(age_s=1.5 * DAY_S, free_bytes=1)
    recorded = Recorded(0)
    log = SegmentedLog(
        tmp_path, "press", Cut(seconds=HOUR_S), keep, block_rows=block_rows, live=False, recorded=recorded
    )
    store = TrendStore(tmp_path / "trend", live=False, wall_offset_ns=0)
    watch = AlarmWatch(RIG, [store.alarm], tmp_path / "trend" / "alarms.json", lambda: 0)
    begin = time.monotonic()
    summary = acquire_from(
        RIG, ScriptedDriver(stream(), "capture"), [log, store, watch], make=LevelEstimator, notify=notices.append,
        queue_bytes=1 << 14,
    )  # fmt: skip
    took_s = time.monotonic() - begin
    kept = segments(tmp_path)
    found = read_trend(tmp_path)
    alarms = [row for row in found.events if row.kind == "alarm_raised"]
    quarter = len(mb) // 4
    growth = float(np.median(mb[-quarter:]) - np.median(mb[quarter : 2 * quarter]))
    size_mb = sum(p.stat().st_size for p in (tmp_path / "trend").iterdir()) / 1e6
    measured = (
        f"{took_s:.0f} s, {len(kept)} segments of {int(days * 24)} stay, {len(alarms)} alarm "
        f"{(alarms[0].time_ns - T0_NS) / 6e10 - CHANGED_DAY * 1440:.0f} min after the change, trend {size_mb:.1f} MB, "
        f"memory {mb[quarter]:.0f} -> {mb[-1]:.0f} MB ({growth:+.1f}), handles {min(handles[2:])} to {max(handles[2:])}"
    )
    print(f"\n{days:g} days: {measured}")
    how = "a simulated week into hourly segments, kept 1.5 days, with trend and an alarm, as fast as it goes"
    promised = "old segments go, the trend and the segments of the alarm stay, memory and handles flat"
    record_property("reliability", f"endurance | {how} | {promised} | {measured}")
    assert summary.samples == int(days * DAY_S * RATE_HZ / ROWS) * ROWS
    assert len([s for s in kept if not s.alarm]) in (36, 37, 38)
    assert [s.start_ns for s in kept if s.alarm] == [T0_NS + h * HOUR_S * 10**9 + 2 * 10**8 for h in (107, 108)]
    assert all(read_log(s.path).complete for s in kept[-3:])
    assert "begins with segment" in sessions(tmp_path)[0].unlike
    assert len(list((tmp_path / "trend").glob("*.parquet"))) in (days, days + 1)  # the end lies at midnight
    assert int(found.series["estimate", "bearing1.x.kL"].count.sum()) == pytest.approx(days * 1440, abs=3)
    assert len(alarms) == 1
    assert "log_removed" in {n.code for n in notices}
    assert growth < 5.0
    assert max(handles[2:]) - min(handles[2:]) <= 3
