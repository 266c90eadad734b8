"""The comparison in Rerun: the report's pictures as planes, the ladder as a time line to scrub along.

Takes the same results as the report (report.py names their keys). On the time line "model", 0 is the model before and
the last step the model now.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import report_words as words
from . import rerun_plane as plane
from .report_figures import AGAINST, FIRST, floats, force_reach, model_name
from .report_numbers import fixed, percent, prefix, unit_text
from .rerun_layout import part

Json = Mapping[str, Any]
Series = tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, int, int]]
MEASURED, MODEL, BEFORE = (200, 200, 200), (86, 180, 233), (230, 159, 0)
BAND = {MODEL: (45, 85, 110), BEFORE: (105, 80, 25)}
STEP = "model"


class Picture(NamedTuple):
    """A plane of one step: what is drawn in it, and the name of its view."""

    frame: plane.Plane
    series: list[Series]
    title: str


def log_comparison(
    path: Path,
    comparison: Json,
    before: Json | None = None,
    diagnosis: Json | None = None,
    ladder: Sequence[Json] = (),
    title: str = "comparison",
) -> None:
    """Write the comparison to an .rrd file with its layout. before : of the model before anything was added."""
    import rerun as rr

    recording = rr.RecordingStream("rotorscope_comparison")
    recording.save(path)
    rr.set_log_time_enabled(False, recording=recording)
    rr.set_log_tick_enabled(False, recording=recording)
    recording.send_recording_name(title)
    steps = [before, comparison] if before is not None else [comparison]
    drawn: dict[str, str] = {}
    for k in range(len(steps)):
        recording.set_time(STEP, sequence=k)
        for entity, picture in planes(steps, k).items():
            drawn[entity] = picture.title
            for name, drawing in picture.frame.frame():
                recording.log(f"{entity}/{name}", drawing)
            recording.log(f"{entity}/curves", plane.curves(picture.frame, picture.series))
    text = document(title, comparison, diagnosis, ladder)
    recording.log("summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
    recording.send_blueprint(layout(drawn))
    recording.flush(timeout_sec=10)
    recording.disconnect()


def planes(steps: Sequence[Json], now: int) -> dict[str, Picture]:
    """Entity path -> frame and curves of step `now`, those of the step before it faintly underneath.

    Frames fit all the steps, so that scrubbing moves the curves and not the axes.
    """
    return residuals(steps, now) | spectra(steps, now) | densities(steps, now) | orbits(steps[now], tone(steps, now))


def tone(steps: Sequence[Json], k: int) -> tuple[int, int, int]:
    return MODEL if k == len(steps) - 1 else BEFORE


def residuals(steps: Sequence[Json], now: int) -> dict[str, Picture]:
    found: dict[str, Picture] = {}
    every = [c for s in steps for c in s.get("curves", ()) if c["against"] in FIRST]
    for channel, against in dict.fromkeys((c["channel"], c["against"]) for c in steps[now].get("curves", ())):
        row = [c for c in every if c["channel"] == channel]
        column = [c for c in every if c["against"] == against]
        if not column:
            continue
        name, base = AGAINST[against]
        x_gain, x_unit = scaled((c["at"] for c in column), base)
        y_gain, y_unit = scaled((c["force"] for c in row), "N")
        x = span((c["at"] for c in column), x_gain, f"{name}, {x_unit}")
        high = plane.round_up(force_reach(row) * y_gain)
        y = plane.Axis(-high, high, y_unit)
        series: list[Series] = []
        for k in range(now + 1):
            for c in steps[k].get("curves", ()):
                if (c["channel"], c["against"]) == (channel, against):
                    at = floats(c["at"]) * x_gain
                    for key in ("band_low", "band_high") if k == now else ():
                        series.append((at, floats(c[key]) * y_gain, BAND[tone(steps, k)]))
                    series.append((at, floats(c["force"]) * y_gain, tone(steps, k)))
        found[f"residual/{part(channel)}/{part(against)}"] = Picture(
            plane.Plane(x, y), series, f"{channel} against {name} [{y_unit}]"
        )
    return found


def spectra(steps: Sequence[Json], now: int) -> dict[str, Picture]:
    found: dict[str, Picture] = {}
    for channel, s in steps[now].get("spectra", {}).items():
        alike = [o["spectra"][channel] for o in steps if channel in o.get("spectra", {})]
        values = np.concatenate([floats(o[key]) for o in alike for key in ("measured", "model")])
        f = floats(s["frequency_hz"])
        x = plane.Axis(float(f.min()), float(f.max()), "frequency, Hz", log=True)
        y = plane.Axis(*plane.decades(values), f"({unit_text(s.get('unit', 'm/s^2'))})²/Hz", log=True)
        series = [(f, floats(s["measured"]), MEASURED), (f, floats(s["model"]), tone(steps, now))]
        found[f"spectrum/{part(channel)}"] = Picture(plane.Plane(x, y), series, f"{channel} [{y.label}]")
    return found


def densities(steps: Sequence[Json], now: int) -> dict[str, Picture]:
    found: dict[str, Picture] = {}
    for channel, d in steps[now].get("densities", {}).items():
        alike = [o["densities"][channel] for o in steps if channel in o.get("densities", {})]
        gain, unit = scaled((o["at"] for o in alike), "m")
        values = np.concatenate([floats(o[key]) / gain for o in alike for key in ("measured", "model")])
        x = span((o["at"] for o in alike), gain, f"displacement, {unit}")
        y = plane.Axis(*plane.decades(values, at_most=5), f"1/{unit}", log=True)
        at = floats(d["at"]) * gain
        series = [(at, floats(d["measured"]) / gain, MEASURED), (at, floats(d["model"]) / gain, tone(steps, now))]
        found[f"density/{part(channel)}"] = Picture(plane.Plane(x, y), series, f"{channel} [{y.label}]")
    return found


def orbits(step: Json, colour: tuple[int, int, int]) -> dict[str, Picture]:
    found: dict[str, Picture] = {}
    for bearing, o in step.get("orbits", {}).items():
        both = [values for key in ("measured", "model") for values in o[key]]
        gain, unit = scaled(both, "m")
        side = span(both, gain, unit)
        for key, shade in (("measured", MEASURED), ("model", colour)):
            series = [(floats(o[key][0]) * gain, floats(o[key][1]) * gain, shade)]
            frame = plane.Plane(side, side, plane.HEIGHT)
            found[f"orbit/{part(bearing)}/{key}"] = Picture(frame, series, f"{bearing}, {key} [{unit}]")
    return found


def scaled(many: Iterable[Sequence[float]], unit: str) -> tuple[float, str]:
    """Factor and unit for values in `unit`; angles, Hz and s stay as they are."""
    if unit in ("deg", "Hz", "s"):
        return 1.0, unit
    return prefix(max((float(np.nanmax(np.abs(floats(v)), initial=0)) for v in many), default=0), unit)


def span(many: Iterable[Sequence[float]], gain: float, label: str) -> plane.Axis:
    """An axis that holds all the values: symmetric if they have both signs."""
    values = np.concatenate([floats(v) for v in many] or [np.zeros(1)]) * gain
    values = values[np.isfinite(values)]
    high = plane.round_up(float(np.abs(values).max(initial=0)) or 1.0)
    return plane.Axis(-high if (values < 0).any() else 0.0, high, label)


def document(title: str, comparison: Json, diagnosis: Json | None, ladder: Sequence[Json]) -> str:
    """The summary and the ladder in Markdown."""
    lines = [f"# {title}", *words.summary(comparison, diagnosis, ladder)]
    if ladder:
        rows = ["| model | held-out NLL | missing force |", "|---|---|---|"]
        for step in ladder:
            missing = percent(step["missing_force_percent"]["value"])
            rows.append(f"| {model_name(step['effects'])} | {fixed(step['heldout_nll'])} | {missing} |")
        lines.append("\n".join(rows))
    lines.append("Blue: the model now. Orange: the model before (step back on the time line). Grey: measured.")
    return "\n\n".join(lines)


def layout(drawn: Mapping[str, str]) -> Any:
    """Tabs of planes beside the summary."""
    import rerun.blueprint as rrb

    def view(entity: str, name: str) -> rrb.Spatial2DView:
        width = plane.HEIGHT if entity.startswith("orbit") else plane.WIDTH
        bounds = rrb.VisualBounds2D(x_range=(-130, width + 40), y_range=(-30, plane.HEIGHT + 130))
        return rrb.Spatial2DView(origin=entity, name=name, visual_bounds=bounds)

    per_row = len({entity.rsplit("/", 1)[1] for entity in drawn if entity.startswith("residual/")})
    kinds = {"residual": "Residual force", "spectrum": "Spectra", "density": "Densities", "orbit": "Orbits"}
    tabs = []
    for kind, name in kinds.items():
        views = [view(entity, text) for entity, text in drawn.items() if entity.startswith(kind + "/")]
        if views:
            tabs.append(rrb.Grid(*views, grid_columns=per_row if kind == "residual" else 2, name=name))
    summary = rrb.TextDocumentView(origin="summary", name="Summary")
    return rrb.Blueprint(
        rrb.Horizontal(summary, rrb.Tabs(*tabs, active_tab=0), column_shares=[2, 5]) if tabs else summary,
        rrb.TimePanel(timeline=STEP, state="collapsed", play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )
