"""A trend in words: a table of all numbers, and what happened."""

from __future__ import annotations

import numpy as np

from daq.base.contract.dates import utc_text
from daq.report.numbers import number, unit_text

from ..names import ALARM_CODE, TREND_FOLDER
from ..series import Series, Trend

TREND_HEADINGS = ("what", "last", "± 95 %", "unit", "least", "greatest", "first tenth", "last tenth", "change")
ORDER_OF_KINDS = ("estimate", "missing_force", "severity", "speed", "strikes", "tone")
TITLE_OF_KIND = {"missing_force": "missing force, ", "speed": "speed, ", "strikes": "strikes ", "tone": "tone "}
MIN_POINTS_OF_CHANGE = 20  # of a series: below them a tenth is too little to speak of a change
SHOWN_LEVELS = (".velocity_rms_mm_s", ".rms")
TABLE_TONES = 6  # that are seen most often; the others are in JSON and page
INTERVAL_SD = 1.96  # half of a 95 % interval


def rows(trend: Trend) -> list[list[str]]:
    """Cells of the table, a row for each series."""
    out = []
    for kind in ORDER_OF_KINDS:
        found = trend.of_kind(kind)
        if kind == "severity":  # the others are in JSON and page
            found = [own for own in found if own.name.endswith(SHOWN_LEVELS)]
        if kind == "tone":
            found = sorted(found, key=lambda own: -int(own.count.sum()))[:TABLE_TONES]
        out += [_row(own) for own in found if own.count.any()]
    return out


def _row(own: Series) -> list[str]:
    value, sd = own.last[1:]
    cells = [
        number(value, 4),
        number(INTERVAL_SD * sd, 2) if sd else "-",
        "" if own.unit == "1" else unit_text(own.unit),
    ]
    if zone := next((z for z in reversed(own.zone) if z), ""):
        cells[0] += f" (zone {zone})"
    least, greatest = float(own.low.min()), float(own.high.max())
    cells += [number(least, 4), number(greatest, 4), *_change(own)]
    return [TITLE_OF_KIND.get(own.kind, "") + own.name, *cells]


def _change(own: Series) -> list[str]:
    """Means of the first and the last tenth of the points, and how they differ."""
    values = own.means()
    if len(values) < MIN_POINTS_OF_CHANGE:
        return ["-", "-", "-"]
    tenth = len(values) // 10
    first, last = float(np.mean(values[:tenth])), float(np.mean(values[-tenth:]))
    change = f"{100 * (last / first - 1):+.2g} %" if first else "-"
    return [number(first, 4), number(last, 4), change]


def what_happened(trend: Trend) -> list[str]:
    """Alarms first, one line each, then how often the rest came."""
    alarms = [row for row in trend.events if row.kind == "alarm_raised"]
    lines = [f"alarm {utc_text(row.time_ns)[:19]}Z: {row.text}" for row in alarms[-5:]]
    if len(alarms) > len(lines):
        lines.insert(0, f"{len(alarms)} alarms, the last {len(lines)}:")
    if not alarms and trend.path.name == TREND_FOLDER:  # an archive has none
        lines.append("no alarm")
    lost = {name: sum(r.value or 0.0 for r in trend.events if (r.kind, r.name) == ("gap", name))
            for kind, name in trend.counts if kind == "gap"}  # fmt: skip
    lines += [f"lost: {count:.0f} samples, {name}" for name, count in sorted(lost.items()) if count]
    often = [
        f"{name} ({n} times)" if n > 1 else name
        for (k, name), n in sorted(trend.counts.items())
        if k == "notice" and name != ALARM_CODE
    ]
    return [*lines, *([f"said: {', '.join(often)}"] if often else [])]
