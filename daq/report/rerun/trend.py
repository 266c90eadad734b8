"""A trend in Rerun: a view for each chart, on the time line of UTC; alarms, gaps and warnings as a text log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .comparison import connect
from .layout import part

Json = Mapping[str, Any]
TIME_LINE = "utc"
GAP_RATIO = 3.0  # of the usual step: beyond it values are missing
COLOURS_RGB = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233))
LEVEL_OF_KIND = {"alarm_raised": "ERROR", "alarm_over": "INFO", "gap": "WARN", "notice": "WARN"}


def log_trend(target: str, title: str, charts: Sequence[Json], events: Sequence[Json]) -> None:
    """Show a trend. charts : as the page has them, each line with `time_ns`; target : as of `log_comparison`."""
    import rerun as rr
    import rerun.blueprint as rrb

    recording = rr.RecordingStream("rotorscope_trend")
    connect(recording, target)
    rr.set_log_time_enabled(False, recording=recording)
    rr.set_log_tick_enabled(False, recording=recording)
    recording.send_recording_name(title)
    times = [t for chart in charts for line in chart["lines"] for t in (line["time_ns"][0], line["time_ns"][-1])]
    ends = [rrb.TimeRangeBoundary.absolute(nanos=f(times)) for f in (min, max)] if times else []
    whole = rrb.TimeAxis(view_range=rrb.TimeRange(start=ends[0], end=ends[1])) if ends else None
    views: dict[str, list[Any]] = {}
    for number, chart in enumerate(charts):
        entity = f"{part(chart['section'])}/{number:02d}_{part(chart['title'])}"
        for k, line in enumerate(chart["lines"]):
            _line(recording, f"{entity}/{part(line['name'])}", line, COLOURS_RGB[k % len(COLOURS_RGB)])
        unit = f" [{chart['unit']}]" if chart["unit"] else ""
        view = rrb.TimeSeriesView(
            origin=entity, name=chart["title"] + unit, plot_legend=rrb.Corner2D.LeftTop, axis_x=whole
        )  # fmt: skip
        views.setdefault(chart["section"], []).append(view)
    for event in events:
        recording.set_time(TIME_LINE, timestamp=np.datetime64(round(event["time_ms"] * 1e6), "ns"))
        text = f"{event['name']}: {event['text']}"
        recording.log("events", rr.TextLog(text, level=LEVEL_OF_KIND.get(event["kind"], "INFO")))
    tabs = [rrb.Vertical(*own, name=section) for section, own in views.items()]
    log = rrb.TextLogView(origin="events", name="Alarms, gaps and warnings")
    recording.send_blueprint(rrb.Blueprint(rrb.Vertical(rrb.Tabs(*tabs), log, row_shares=[4, 1]), collapse_panels=True))
    recording.flush(timeout_sec=10)
    recording.disconnect()


def _line(recording: Any, entity: str, line: Json, colour: tuple[int, int, int]) -> None:
    """Value and, behind it, the edges of its 95 % interval."""
    import rerun as rr

    at_ns = np.array(line["time_ns"], np.int64)
    steps = np.diff(at_ns)
    holes = np.flatnonzero(steps > GAP_RATIO * np.median(steps)) + 1 if len(steps) else np.zeros(0, int)
    between = np.insert(at_ns, holes, at_ns[holes - 1] + 1)  # a gap is not bridged
    times = rr.TimeColumn(TIME_LINE, timestamp=between.astype("datetime64[ns]"))
    value = np.array(line["v"], float)
    drawn = {"": (value, line["name"], 2.0, colour)}
    if line["h"] is not None:
        half = np.array([math.nan if h is None else h for h in line["h"]])
        pale = (colour[0] // 2 + 60, colour[1] // 2 + 60, colour[2] // 2 + 60)
        drawn |= {"/low": (value - half, "", 0.7, pale), "/high": (value + half, "", 0.7, pale)}
    for suffix, (series, name, width, own) in drawn.items():
        recording.log(entity + suffix, rr.SeriesLines(names=name or "95 %", widths=width, colors=own), static=True)
        shown = np.insert(series, holes, math.nan)
        recording.send_columns(entity + suffix, indexes=[times], columns=rr.Scalars.columns(scalars=shown))
