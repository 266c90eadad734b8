"""The body of trend: how the numbers of a machine went, in a table, a page, a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from daq.base.console.extras import check_installed
from daq.base.console.fitting import FittingTable
from daq.base.console.output import Output, check_place, spare
from daq.base.contract.dates import utc_text
from daq.trend.page.charts import charts
from daq.trend.page.words import TREND_HEADINGS, rows, what_happened
from daq.trend.series import MAX_POINTS, Trend, read_trend


def trend(
    output: Output, folder: Path, since: str | None, machine: str | None, html: Path | None, rerun: str | None
) -> None:
    """Read the trend of a folder of segments, or of an archive's results, and show it."""
    check_installed(("pyarrow",), "formats", "trend")
    if html is not None:
        check_installed(("jinja2",), "report", "--html")
        check_place("--html", html)
        spare(html, ".toml")
    if rerun is not None:
        check_installed(("rerun",), "", "--rerun")
        from daq.report.rerun.process import viewer_target

        rerun = viewer_target(rerun)
    with output.progress("reading"):
        found = read_trend(folder, since, machine)
    cells, lines = rows(found), what_happened(found)
    said = []
    if html is not None:
        _write_page(found, folder, html, cells, lines)
        said.append(f"page: {html}")
    if rerun is not None:
        from daq.report.rerun.trend import log_trend

        drawn = [_recorded(found, chart) for chart in charts(found)]
        log_trend(rerun, f"Rotorscope trend: {folder.name}", drawn, _events(found))
        said.append(f"look at it: rerun {rerun}" if rerun.endswith(".rrd") else f"shown: {rerun}")
    numbers = range(1, len(TREND_HEADINGS))
    right = frozenset(k for k in numbers if TREND_HEADINGS[k] != "unit")
    table = FittingTable(headings=TREND_HEADINGS, rows=cells, order=[1, 3, 2, 8, 4, 5, 7, 6], right=right)
    head = f"{_day(found.first_ns)} to {_day(found.last_ns)} UTC"
    output.result(found.to_json(), head, "", table, "", *lines, *said)


def _day(time_ns: int) -> str:
    return utc_text(time_ns)[:16].replace("T", " ")


def _write_page(found: Trend, folder: Path, html: Path, cells: list[list[str]], lines: list[str]) -> None:
    from daq.trend.page.page import write_trend

    name = folder.absolute().name
    facts = {"trend of": name, "from": f"{_day(found.first_ns)} UTC", "to": f"{_day(found.last_ns)} UTC",
             "a point": _length(found.bin_ns / 1e9)}  # fmt: skip
    bins = min(MAX_POINTS, (found.last_ns - found.first_ns) // found.bin_ns + 1)
    write_trend(
        html, f"Trend: {name}", facts=facts, first_ms=found.first_ns / 1e6, bin_ms=found.bin_ns / 1e6, bins=bins,
        charts=charts(found), events=_events(found), rows=cells, headings=TREND_HEADINGS, notes=lines,
    )  # fmt: skip


def _length(seconds: float) -> str:
    unit, size = next((u, s) for u, s in (("d", 86400.0), ("h", 3600.0), ("min", 60.0), ("s", 0.0)) if seconds >= s)
    return f"{seconds / (size or 1.0):.3g} {unit}"


def _events(found: Trend) -> list[dict[str, Any]]:
    """Alarms, gaps and warnings for page and recording."""
    out = []
    for row in found.events:
        text = row.text or (f"{row.value:.0f} {row.unit}" if row.value is not None else "")
        time = utc_text(row.time_ns)[:19].replace("T", " ")
        name = f"gap: {row.name}" if row.kind == "gap" else row.name
        out.append({"time_ms": row.time_ns / 1e6, "time": time, "kind": row.kind, "name": name, "text": text})
    return out


def _recorded(found: Trend, chart: dict[str, Any]) -> dict[str, Any]:
    """A chart with Unix times in place of the numbers of bins."""
    middle = found.first_ns + found.bin_ns // 2
    lines = [line | {"time_ns": [middle + i * found.bin_ns for i in line["i"]]} for line in chart["lines"]]
    return chart | {"lines": lines}
