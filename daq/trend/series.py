"""A trend as series of a bounded number of points, read a day at a time: a year needs no more memory than a week."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.dates import utc_text
from daq.base.contract.errors import ConfigError, LogError

from .days import DAY_SUFFIX, STREAM_SUFFIX, Row, arrow, days_of, read_day
from .names import TREND_FOLDER
from .results import is_results, results_rows
from .sizes import duration_s

MAX_POINTS = 1000  # of a series: as many as a page shows
MAX_EVENTS = 2000  # the newest ones; all are counted
EVENT_KINDS = frozenset({"gap", "notice", "alarm_raised", "alarm_over"})
TEXT_COLUMNS = ("kind", "name", "unit", "text")
LIMIT_KIND = "zone_limit"
KEY_SEPARATOR = "\t"
Floats = NDArray[np.float64]


@dataclass(slots=True, kw_only=True)
class Series:
    """A number over time, in bins of equal length.

    count, total, low, high, sd_total, sd_count : (bins,) of the values in each bin. zone : (bins,) its worst zone.
    """

    kind: str
    name: str
    unit: str
    _bins: int = MAX_POINTS
    count: NDArray[np.int64] = field(init=False)
    total: Floats = field(init=False)
    low: Floats = field(init=False)
    high: Floats = field(init=False)
    sd_total: Floats = field(init=False)
    sd_count: NDArray[np.int64] = field(init=False)
    zone: list[str] = field(init=False)
    last: tuple[int, float, float | None] = field(init=False, default=(0, 0.0, None))

    def __post_init__(self) -> None:
        n = self._bins
        self.count, self.sd_count = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self.total, self.sd_total = np.zeros(n), np.zeros(n)
        self.low, self.high = np.full(n, np.inf), np.full(n, -np.inf)
        self.zone = [""] * n

    def add(self, at: NDArray[np.int64], value: Floats, sd: Floats) -> None:
        """Values by bin; NaN where there is none."""
        n, good, known = len(self.count), np.isfinite(value), np.isfinite(sd)
        self.count += np.bincount(at[good], minlength=n)
        self.total += np.bincount(at[good], value[good], minlength=n)
        np.minimum.at(self.low, at[good], value[good])
        np.maximum.at(self.high, at[good], value[good])
        self.sd_count += np.bincount(at[known], minlength=n)
        self.sd_total += np.bincount(at[known], sd[known], minlength=n)

    @property
    def there(self) -> NDArray[np.int64]:
        """The bins with a value."""
        return np.flatnonzero(self.count)

    def means(self) -> Floats:
        """(points,) mean value of each bin that has one."""
        out: Floats = self.total[self.there] / self.count[self.there]
        return out

    def sds(self) -> Floats:
        """(points,) mean standard deviation of a value in each bin; NaN where none is known."""
        at = self.there
        with np.errstate(invalid="ignore", divide="ignore"):
            out: Floats = self.sd_total[at] / self.sd_count[at]
        return out


@dataclass(frozen=True, kw_only=True)
class Trend:
    """A trend over a span. first_ns, bin_ns : start and length of the bins, Unix time.

    series : by kind and name. events : gaps, notices and alarms, the newest MAX_EVENTS. counts : of all of them.
    limits : zone -> velocity at which it begins, mm/s.
    """

    path: Path
    first_ns: int
    last_ns: int
    bin_ns: int
    series: dict[tuple[str, str], Series]
    events: list[Row]
    counts: Counter[tuple[str, str]]
    limits: dict[str, float]

    def times_ns(self, series: Series) -> NDArray[np.int64]:
        """(points,) Unix time of the middle of each bin with a value."""
        return self.first_ns + series.there * self.bin_ns + self.bin_ns // 2

    def of_kind(self, kind: str) -> list[Series]:
        """The series of a kind, by name."""
        return [s for (own, _), s in sorted(self.series.items()) if own == kind]

    def to_json(self) -> dict[str, Any]:
        """As docs/schemas/trend.json."""
        return {
            "schema": 1,
            "trend": str(self.path),
            "from": utc_text(self.first_ns),
            "to": utc_text(self.last_ns),
            "bin_s": self.bin_ns / 1e9,
            "zone_limits_mm_s": self.limits,
            "series": [self._series_json(own) for _, own in sorted(self.series.items())],
            "events": [_event_json(row) for row in self.events],
            "event_counts": [{"kind": k, "name": n, "count": c} for (k, n), c in sorted(self.counts.items())],
        }

    def _series_json(self, own: Series) -> dict[str, Any]:
        at, last = own.there, own.last
        return {
            "kind": own.kind,
            "name": own.name,
            "unit": own.unit,
            "values": int(own.count.sum()),
            "last": {"time": utc_text(last[0]), "value": last[1], "sd": last[2]},
            "time": [utc_text(int(t)) for t in self.times_ns(own)],
            "value": own.means(),
            "sd": own.sds(),
            "low": own.low[at],
            "high": own.high[at],
        } | ({"zone": [own.zone[k] for k in at]} if any(own.zone) else {})


def _event_json(row: Row) -> dict[str, Any]:
    own = {"time": utc_text(row.time_ns), "kind": row.kind, "name": row.name, "value": row.value, "unit": row.unit}
    return own | {"text": row.text}


def trend_folder(folder: Path) -> Path:
    """The folder of the trend: within a folder of segments, or the folder itself. Raises LogError if there is none."""
    for place in (folder / TREND_FOLDER, folder):
        if place.is_dir() and (days_of(place, DAY_SUFFIX) or days_of(place, STREAM_SUFFIX)):
            return place
    if not folder.exists():
        raise LogError(f"{folder}: there is no such folder; check the path")
    text = "holds no trend; give a folder of `rotorscope run --segment`, or the results of `batch`"
    if any(folder.glob("*.mcap")):
        text = "holds no trend yet: it begins with the first severity or estimate of `rotorscope run`, after about 10 s"
    raise LogError(f"{folder}: {text}")


def since_ns(text: str, newest_ns: int) -> int:
    """--since: a time before the newest row, or an ISO date. Raises ConfigError."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return newest_ns - round(duration_s(text, "--since") * 1e9)
    return round((time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp() * 1e9)


def read_trend(folder: Path, since: str | None = None, machine: str | None = None) -> Trend:
    """The trend of a folder: of segments, or of the results of `rotorscope batch`.

    since : "7d" before its end, or an ISO date. machine : of results of several. Raises LogError, ConfigError.
    """
    try:
        if is_results(folder):
            rows = results_rows(folder, machine)
            out = _without_rows(folder, [rows], since)
            _take(out, rows)
            return out
        place = trend_folder(folder)
        if machine is not None:
            raise ConfigError(f"--machine {machine}: {folder} is the trend of one; leave it out")
        days = sorted({*days_of(place, DAY_SUFFIX), *days_of(place, STREAM_SUFFIX)})
        out = _without_rows(place, [read_day(place, day) for day in dict.fromkeys((days[0], days[-1]))], since)
        for day in days:
            if day >= (datetime.fromtimestamp(out.first_ns / 1e9, UTC) - timedelta(days=1)).strftime("%Y-%m-%d"):
                _take(out, read_day(place, day))
    except OSError as error:
        raise LogError(f"{folder}: cannot be read: {error.strerror or error}") from error
    return out


def _without_rows(place: Path, tables: list[Any], since: str | None) -> Trend:
    """A trend without its rows. tables : those with the first and the last row."""
    known = [end for end in map(_ends, tables) if end is not None]
    if not known:
        raise LogError(f"{place}: the trend holds no row with a date")
    first_ns, last_ns = min(known)[0], max(known, key=lambda end: end[1])[1]
    if since is not None:
        first_ns = max(first_ns, since_ns(since, last_ns))
    if first_ns > last_ns:
        raise ConfigError(f"--since {since}: the trend ends at {utc_text(last_ns)}; give an earlier time")
    bin_ns = max(10**9, (last_ns - first_ns) // MAX_POINTS + 1)
    return Trend(path=place, first_ns=first_ns, last_ns=last_ns, bin_ns=bin_ns, series={}, events=[],
                 counts=Counter(), limits={})  # fmt: skip


def _ends(table: Any) -> tuple[int, int] | None:
    times = _times_us(table)
    return (int(times[0]) * 1000, int(times[-1]) * 1000) if len(times) else None


def _times_us(table: Any) -> NDArray[np.int64]:
    out: NDArray[np.int64] = table["time"].cast(arrow().int64()).to_numpy()
    return out


def _take(trend: Trend, table: Any) -> None:
    """Add the rows of a day."""
    compute = arrow("pyarrow.compute")
    times = _times_us(table) * 1000
    inside = (times >= trend.first_ns) & (times <= trend.last_ns)
    if not inside.any():
        return
    table, times = table.filter(arrow().array(inside)), times[inside]
    keys = compute.dictionary_encode(compute.binary_join_element_wise(table["kind"], table["name"], KEY_SEPARATOR))
    keys = keys.combine_chunks()
    code = keys.indices.to_numpy()
    value, sd = (table[name].to_numpy().astype(float) for name in ("value", "sd"))
    at = (times - trend.first_ns) // trend.bin_ns
    order = np.argsort(code, kind="stable")
    edges = np.searchsorted(code[order], np.arange(len(keys.dictionary) + 1))
    for k, key in enumerate(keys.dictionary.to_pylist()):
        kind, _, name = key.partition(KEY_SEPARATOR)
        rows = order[edges[k] : edges[k + 1]]
        if kind in EVENT_KINDS:
            trend.counts[kind, name] += len(rows)
            trend.events.extend(_rows(table, rows[-MAX_EVENTS:], times))
        elif kind == LIMIT_KIND:
            trend.limits[name] = float(value[rows[-1]])
        else:
            unit = table["unit"][int(rows[-1])].as_py()
            if (kind, name) not in trend.series:
                trend.series[kind, name] = Series(kind=kind, name=name, unit=unit)
            own, good = trend.series[kind, name], rows[np.isfinite(value[rows])]
            own.add(at[rows], value[rows], sd[rows])
            if len(good):
                last = good[-1]
                own.last = int(times[last]), float(value[last]), float(sd[last]) if np.isfinite(sd[last]) else None
            _take_zones(
                own, at[rows], table["text"].take(arrow().array(rows)).to_pylist() if kind == "severity" else []
            )
    trend.events.sort(key=lambda row: row.time_ns)
    del trend.events[:-MAX_EVENTS]


def _take_zones(own: Series, at: NDArray[np.int64], texts: list[str | None]) -> None:
    for k, zone in zip(at, texts, strict=False):
        if zone and zone > own.zone[k]:
            own.zone[k] = zone


def _rows(table: Any, rows: NDArray[np.int64], times: NDArray[np.int64]) -> Iterator[Row]:
    for own, time in zip(table.take(arrow().array(rows)).to_pylist(), times[rows], strict=True):
        kind, name, unit, text = (own[column] or "" for column in TEXT_COLUMNS)
        yield Row(int(time), kind, name, value=own["value"], sd=own["sd"], unit=unit, text=text)
