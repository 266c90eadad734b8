"""Charts of the trend's page: the series that share a chart, and its unit."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from daq.report.numbers import PREFIXED_UNITS, prefix, unit_text

from ..series import Series, Trend

PLACE_PATTERN = re.compile(r"(bearing\d(?:\.[xy])?)\.(.+)")
FIRST_PARAMETERS = ("kL", "c", "S")  # then the laws
LEVEL_TITLES = {
    "velocity_rms_mm_s": "Velocity, 10 to 1000 Hz, rms",
    "displacement_rms_um": "Displacement, 10 to 1000 Hz, rms",
    "rms": "Level, rms", "peak": "Peak", "crest": "Crest factor", "kurtosis": "Kurtosis",
}  # fmt: skip
PARAMETER_TITLES = {"kL": "Stiffness kL", "c": "Damping c", "S": "Force S"}
MAX_TONE_CHARTS = 8  # orders that are seen most often
INTERVAL_SD = 1.96  # half of a 95 % interval


def charts(trend: Trend) -> list[dict[str, Any]]:
    """The charts in the order of the page, as trend.html draws them."""
    return [*_parameters(trend), *_missing(trend), *_severity(trend), *_machine(trend)]


def chart(trend: Trend, section: str, title: str, lines: Sequence[tuple[str, Series]]) -> dict[str, Any]:
    """One chart. lines : name of each and its numbers, all in one unit."""
    unit = lines[0][1].unit
    peak = max(float(np.abs(own.means()).max()) for _, own in lines)
    gain, shown = prefix(peak, unit) if unit in PREFIXED_UNITS else (1.0, "" if unit == "1" else unit_text(unit))
    drawn = [_line(name, own, gain) for name, own in lines]
    limits = [[zone, _short(limit)] for zone, limit in trend.limits.items()] if unit == "mm/s" else []
    return {"section": section, "title": title, "unit": shown, "lines": drawn, "limits": limits}


def _line(name: str, own: Series, gain: float) -> dict[str, Any]:
    at = own.there
    halves = [_short(INTERVAL_SD * sd * gain) if np.isfinite(sd) else None for sd in own.sds()]
    several = bool((own.count[at] > 1).any())
    return {
        "name": name,
        "i": at.tolist(),
        "v": [_short(v * gain) for v in own.means()],
        "h": halves if any(half is not None for half in halves) else None,
        "lo": [_short(v * gain) for v in own.low[at]] if several else None,
        "hi": [_short(v * gain) for v in own.high[at]] if several else None,
        "z": [own.zone[k] for k in at] if any(own.zone) else None,
    }  # fmt: skip


def _short(value: float) -> float:
    return float(f"{value:.6g}")


def _parameters(trend: Trend) -> Iterator[dict[str, Any]]:
    found: dict[tuple[str, str], list[tuple[str, Series]]] = {}
    for own in trend.of_kind("estimate"):
        match = PLACE_PATTERN.fullmatch(own.name)
        place, what = (match[1], match[2]) if match else ("", own.name)
        found.setdefault((what, own.unit), []).append((place or own.name, own))

    def order(key: tuple[str, str]) -> tuple[int, str]:
        return (FIRST_PARAMETERS.index(key[0]) if key[0] in FIRST_PARAMETERS else len(FIRST_PARAMETERS), key[0])

    for key in sorted(found, key=order):
        yield chart(trend, "Parameters", PARAMETER_TITLES.get(key[0], key[0]), found[key])


def _missing(trend: Trend) -> Iterator[dict[str, Any]]:
    own = trend.of_kind("missing_force")
    if own:
        title = "Force that the model lacks, part of the bearing force"
        yield chart(trend, "Missing force", title, [(s.name, s) for s in own])


def _severity(trend: Trend) -> Iterator[dict[str, Any]]:
    found: dict[tuple[str, str], list[tuple[str, Series]]] = {}
    for own in trend.of_kind("severity"):
        channel, _, what = own.name.rpartition(".")
        found.setdefault((what, own.unit), []).append((channel, own))
    for key in sorted(
        found, key=lambda k: list(LEVEL_TITLES).index(k[0]) if k[0] in LEVEL_TITLES else len(LEVEL_TITLES)
    ):
        yield chart(trend, "Severity", LEVEL_TITLES.get(key[0], key[0]), found[key])


def _machine(trend: Trend) -> Iterator[dict[str, Any]]:
    for own in trend.of_kind("speed"):
        yield chart(trend, "Machine", "Speed of the shaft", [(own.name, own)])
    strikes: dict[str, list[tuple[str, Series]]] = {}
    for own in trend.of_kind("strikes"):
        strikes.setdefault(own.unit, []).append((own.name, own))
    for lines in strikes.values():
        yield chart(trend, "Machine", "Strike trains: severity", lines)
    tones: dict[tuple[str, str], list[tuple[str, Series]]] = {}
    for own in trend.of_kind("tone"):
        name, _, channel = own.name.rpartition(".")
        tones.setdefault((name, own.unit), []).append((channel, own))
    often = sorted(tones, key=lambda key: -sum(int(own.count.sum()) for _, own in tones[key]))[:MAX_TONE_CHARTS]
    for key in sorted(often, key=lambda key: (not key[0].endswith("X"), key[0])):
        yield chart(trend, "Machine", f"Tone {key[0]}, amplitude", tones[key])
