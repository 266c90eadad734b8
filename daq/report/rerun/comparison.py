"""The comparison in Rerun: the report's pictures as planes, the ladder as a time line to scrub along.

Takes the same results as the report (page.py names their keys). On the time line "model", 0 is the model before and
the last step the model now.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from daq.report.curves import force_reach, scaled
from daq.report.figures import AXIS_OF_STATE, STATES_BY_PRIORITY, floats
from daq.report.numbers import unit_text
from daq.report.signal_figures import level_range
from drivers.contract import LinkError

from . import plane as plane
from .layout import part
from .text import documents

Json = Mapping[str, Any]
Series = tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, int, int]]
MEASURED_COLOUR, MODEL_COLOUR, BEFORE_COLOUR = (200, 200, 200), (86, 180, 233), (230, 159, 0)
DARK_COLOUR = (95, 95, 95)
WATERFALL_COLOURS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))  # viridis
BAND_COLOURS = {MODEL_COLOUR: (45, 85, 110), BEFORE_COLOUR: (105, 80, 25)}
STEP_TIMELINE = "model"


class Picture(NamedTuple):
    """A plane of one step: its curves, and the name of its view."""

    frame: plane.Plane
    series: list[Series]
    title: str
    marks: Sequence[tuple[float, str]] = ()  # lines over the whole height, with names

    def log(self, recording: Any, entity: str, static: bool = False) -> None:
        """Draw it."""
        lines = [(np.full(2, at), np.array([self.frame.y.low, self.frame.y.high]), DARK_COLOUR) for at, _ in self.marks]
        drawings = [*self.frame.frame(), ("curves", plane.curves(self.frame, [*lines, *self.series]))]
        drawings += [("marks", plane.mark_names(self.frame, self.marks))] if self.marks else []
        for name, drawing in drawings:
            recording.log(f"{entity}/{name}", drawing, static=static)


def log_comparison(
    target: str,
    comparison: Json | None = None,
    before: Json | None = None,
    diagnoses: Sequence[Json] = (),
    ladder: Sequence[Json] = (),
    title: str = "comparison",
    notes: Sequence[str] = (),
    signal: Json | None = None,
    seen: Json | None = None,
) -> None:
    """Show the comparison with its layout.

    comparison : None where no model of the bearings is judged; before : of the first model, without additions;
    signal : measured spectra; seen : layers of a record without a comparison; target : an .rrd file, "spawn"
    or a viewer's URL (viewer_target). Raises LinkError if there is no viewer at the URL.
    """
    import rerun as rr

    recording = rr.RecordingStream("rotorscope_comparison")
    connect(recording, target)
    rr.set_log_time_enabled(False, recording=recording)
    rr.set_log_tick_enabled(False, recording=recording)
    recording.send_recording_name(title)
    steps = [step for step in (before, comparison) if step is not None]
    drawn: dict[str, str] = {}
    for k in range(len(steps)):
        recording.set_time(STEP_TIMELINE, sequence=k)
        for entity, picture in planes(steps, k).items():
            drawn[entity] = picture.title
            picture.log(recording, entity)
    for entity, picture in (unknown(diagnoses) | measured(signal or {}) | shaft_orders(signal or {})).items():
        drawn[entity] = picture.title
        picture.log(recording, entity, static=True)
    for channel, fall in (signal or {}).get("waterfalls", {}).items():
        entity = f"waterfall/{part(channel)}"
        frame, image = waterfall(fall)
        recording.log(f"{entity}/level", rr.Image(image), static=True)
        for name, drawing in frame.frame():
            recording.log(f"{entity}/{name}", drawing, static=True)
        drawn[entity] = f"{channel}, level of the spectrum [dB of ({unit_text(fall['unit'])})²/Hz]"
    texts = documents(title, comparison, before, diagnoses, ladder, notes, seen)
    for name, text in texts.items():
        page = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        recording.log(name.lower(), page, static=True)
    recording.send_blueprint(layout(drawn, list(texts)))
    recording.flush(timeout_sec=10)
    recording.disconnect()


def connect(recording: Any, target: str) -> None:
    """Connect to a file, or to a viewer that runs or is started."""
    import time

    from .process import START_S, VIEWER_PORT, answers, start_viewer

    url = target
    if target == "spawn":
        url = f"rerun+http://127.0.0.1:{VIEWER_PORT}/proxy"
        if not answers(url):
            start_viewer()
            until = time.monotonic() + START_S
            while not answers(url) and time.monotonic() < until:
                time.sleep(0.2)
    if "://" not in url:
        recording.save(url)
    elif answers(url):
        recording.connect_grpc(url)
    else:
        raise LinkError(f"--rerun {target}: no viewer answers at {url}; start one with `rerun`, or give FILE.rrd")


def planes(steps: Sequence[Json], now: int) -> dict[str, Picture]:
    """Entity path -> frame and curves of step `now`, those of the step before it faintly underneath.

    Frames fit all the steps, so that scrubbing moves the curves and not the axes.
    """
    return (
        laws(steps, now)
        | residuals(steps, now)
        | spectra(steps, now)
        | densities(steps, now)
        | orbits(steps[now], tone(steps, now))
    )


def tone(steps: Sequence[Json], k: int) -> tuple[int, int, int]:
    return MODEL_COLOUR if k == len(steps) - 1 else BEFORE_COLOUR


def laws(steps: Sequence[Json], now: int) -> dict[str, Picture]:
    """Restoring force beyond a straight line: measured with its band, the model's, and that of the step before."""
    found: dict[str, Picture] = {}
    for law in steps[now].get("laws", ()):
        channel, against = law["channel"], law["against"]
        alike = [k for s in steps for k in s.get("laws", ()) if (k["channel"], k["against"]) == (channel, against)]
        name, base = AXIS_OF_STATE[against]
        x_gain, x_unit = scaled((k["at"] for k in alike), base)
        as_curves = [{**k, "force": k[key]} for k in alike for key in ("measured", "model")]
        reach = force_reach(as_curves)
        y_gain, y_unit = scaled([[reach]], "N")
        high = plane.round_up(reach * y_gain)
        frame = plane.Plane(
            span((k["at"] for k in alike), x_gain, f"{name}, {x_unit}"), plane.Axis(-high, high, y_unit)
        )
        at = floats(law["at"]) * x_gain
        series: list[Series] = [(at, floats(law[key]) * y_gain, DARK_COLOUR) for key in ("band_low", "band_high")]
        series.append((at, floats(law["measured"]) * y_gain, MEASURED_COLOUR))
        for k in range(now + 1):
            for c in steps[k].get("laws", ()):
                if (c["channel"], c["against"]) == (channel, against):
                    series.append((floats(c["at"]) * x_gain, floats(c["model"]) * y_gain, tone(steps, k)))
        found[f"law/{part(channel)}/{part(against)}"] = Picture(frame, series, f"{channel} against {name} [{y_unit}]")
    return found


def residuals(steps: Sequence[Json], now: int) -> dict[str, Picture]:
    found: dict[str, Picture] = {}
    every = [c for s in steps for c in s.get("curves", ()) if c["against"] in STATES_BY_PRIORITY]
    for channel, against in dict.fromkeys((c["channel"], c["against"]) for c in steps[now].get("curves", ())):
        row = [c for c in every if c["channel"] == channel]
        column = [c for c in every if c["against"] == against]
        if not column:
            continue
        name, base = AXIS_OF_STATE[against]
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
                        series.append((at, floats(c[key]) * y_gain, BAND_COLOURS[tone(steps, k)]))
                    series.append((at, floats(c["force"]) * y_gain, tone(steps, k)))
        found[f"residual/{part(channel)}/{part(against)}"] = Picture(
            plane.Plane(x, y), series, f"{channel} against {name} [{y_unit}]"
        )
    return found


def unknown(diagnoses: Sequence[Json]) -> dict[str, Picture]:
    """The shape of the force that no effect explains, from the last diagnosis with such a force."""
    shape = next((d["shape"] for d in reversed(diagnoses) if d.get("shape")), None)
    if shape is None:
        return {}
    name, base = AXIS_OF_STATE.get(shape["against"], (shape["against"], ""))
    x_gain, x_unit = scaled([shape["at"]], base)
    reach = force_reach([shape])
    y_gain, y_unit = scaled([[reach]], "N")
    high = plane.round_up(reach * y_gain)
    frame = plane.Plane(span([shape["at"]], x_gain, f"{name}, {x_unit}"), plane.Axis(-high, high, y_unit))
    at = floats(shape["at"]) * x_gain
    bands = [key for key in ("band_low", "band_high") if shape.get(key)]
    series: list[Series] = [(at, floats(shape[key]) * y_gain, BAND_COLOURS[BEFORE_COLOUR]) for key in bands]
    series.append((at, floats(shape["force"]) * y_gain, BEFORE_COLOUR))
    channel = str(shape.get("channel", ""))
    return {f"unknown/{part(channel)}": Picture(frame, series, f"{channel} against {name} [{y_unit}]")}


def spectra(steps: Sequence[Json], now: int) -> dict[str, Picture]:
    found: dict[str, Picture] = {}
    for channel, s in steps[now].get("spectra", {}).items():
        alike = [o["spectra"][channel] for o in steps if channel in o.get("spectra", {})]
        values = np.concatenate([floats(o[key]) for o in alike for key in ("measured", "model")])
        f = floats(s["frequency_hz"])
        x = plane.Axis(float(f.min()), float(f.max()), "frequency, Hz", log=True)
        y = plane.Axis(*plane.decades(values), f"({unit_text(s.get('unit', 'm/s^2'))})²/Hz", log=True)
        series = [(f, floats(s["measured"]), MEASURED_COLOUR), (f, floats(s["model"]), tone(steps, now))]
        found[f"spectrum/{part(channel)}"] = Picture(plane.Plane(x, y), series, f"{channel} [{y.label}]")
    return found


def measured(signal: Json) -> dict[str, Picture]:
    """Measured spectra, and those of the squared envelope, by channel, with their marks."""
    found: dict[str, Picture] = {}
    for kind, title, log, power in (("spectra", "measured", True, "²"), ("envelopes", "squared envelope", False, "⁴")):
        for channel, s in signal.get(kind, {}).items():
            f, psd = floats(s["frequency_hz"]), floats(s["psd"])
            y = plane.Axis(*plane.decades(psd), f"({unit_text(s['unit'])}){power}/Hz", log=True)
            x = plane.Axis(float(f.min()), float(f.max()), "frequency, Hz", log=log)
            marks = [(hz, label) for hz, label in s["marks"] if x.low <= hz <= x.high]
            heading = f"{channel}, {title} [{y.label}]"
            found[f"{kind}/{part(channel)}"] = Picture(plane.Plane(x, y), [(f, psd, MEASURED_COLOUR)], heading, marks)
    return found


def shaft_orders(signal: Json) -> dict[str, Picture]:
    """Amplitude of lines against the order of the shaft by channel, with their marks."""
    found: dict[str, Picture] = {}
    for channel, s in signal.get("orders", {}).items():
        order, amplitude = floats(s["order"]), floats(s["amplitude"])
        y = plane.Axis(*plane.decades(amplitude), unit_text(s["unit"]), log=True)
        x = plane.Axis(0.0, float(order.max()), "order of the shaft")
        inside = [(at, label) for at, label in s["marks"] if at <= x.high]
        marks = [(at, label if label == f"{at:g}X" else f"{label} {at:.3g}") for at, label in inside]
        curve = (order, amplitude, MEASURED_COLOUR)
        found[f"orders/{part(channel)}"] = Picture(plane.Plane(x, y), [curve], f"{channel} [{y.label}]", marks)
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
        series = [
            (at, floats(d["measured"]) / gain, MEASURED_COLOUR),
            (at, floats(d["model"]) / gain, tone(steps, now)),
        ]
        found[f"density/{part(channel)}"] = Picture(plane.Plane(x, y), series, f"{channel} [{y.label}]")
    return found


def orbits(step: Json, colour: tuple[int, int, int]) -> dict[str, Picture]:
    found: dict[str, Picture] = {}
    for bearing, o in step.get("orbits", {}).items():
        both = [values for key in ("measured", "model") for values in o[key]]
        gain, unit = scaled(both, "m")
        side = span(both, gain, unit)
        for key, shade, name in (("measured", MEASURED_COLOUR, "estimated"), ("model", colour, "model")):
            series = [(floats(o[key][0]) * gain, floats(o[key][1]) * gain, shade)]
            frame = plane.Plane(side, side, plane.HEIGHT_UNITS)
            found[f"orbit/{part(bearing)}/{key}"] = Picture(frame, series, f"{bearing}, {name} [{unit}]")
    return found


def waterfall(fall: Json) -> tuple[plane.Plane, NDArray[np.uint8]]:
    """Frame and picture (height, width, 3) of the level of a channel against time and frequency, dark is low."""
    level = np.array([floats(row) for row in fall["level_db"]])
    f, t = floats(fall["frequency_hz"]), floats(fall["time_s"])
    frame = plane.Plane(
        plane.Axis(0.0, float(t[-1]), "time, s"), plane.Axis(max(f[0], 1e-3 * f[-1]), float(f[-1]), "Hz", log=True)
    )
    across = np.searchsorted(t, np.linspace(t[0], t[-1], int(frame.width)), side="right") - 1
    up = np.geomspace(frame.y.high, frame.y.low, int(plane.HEIGHT_UNITS))
    rows = np.clip(np.searchsorted(f, up, side="right") - 1, 0, f.size - 1)
    low, high = level_range(level)
    share = np.nan_to_num(np.clip((level[across][:, rows].T - low) / (high - low or 1.0), 0.0, 1.0))
    colours = np.array(WATERFALL_COLOURS, np.float64)
    at = np.linspace(0.0, 1.0, len(colours))
    picture = np.stack([np.interp(share, at, colours[:, k]) for k in range(3)], axis=-1)
    return frame, picture.astype(np.uint8)


def span(many: Iterable[Sequence[float]], gain: float, label: str) -> plane.Axis:
    """An axis that holds all the values: symmetric if they have both signs."""
    values = np.concatenate([floats(v) for v in many] or [np.zeros(1)]) * gain
    values = values[np.isfinite(values)]
    high = plane.round_up(float(np.abs(values).max(initial=0)) or 1.0)
    return plane.Axis(-high if (values < 0).any() else 0.0, high, label)


def layout(drawn: Mapping[str, str], texts: Sequence[str] = ("Summary",)) -> Any:
    """Tabs of planes beside tabs of words."""
    import rerun.blueprint as rrb

    def view(entity: str, name: str) -> rrb.Spatial2DView:
        width = plane.HEIGHT_UNITS if entity.startswith("orbit") else plane.WIDTH_UNITS
        marked = entity.split("/")[0] in ("spectra", "envelopes", "orders")
        above = 30 + marked * (plane.MARK_ROWS + 0.5) * plane.MARK_ROW_UNITS
        bounds = rrb.VisualBounds2D(x_range=(-130, width + 40), y_range=(-above, plane.HEIGHT_UNITS + 165))
        return rrb.Spatial2DView(origin=entity, name=name, visual_bounds=bounds)

    per_row = len({entity.rsplit("/", 1)[1] for entity in drawn if entity.startswith("residual/")})
    kinds = {
        "spectra": "Measured spectra",
        "envelopes": "Envelopes",
        "orders": "Orders",
        "waterfall": "Waterfall",
        "law": "Law",
        "residual": "Residual force",
        "unknown": "Unknown",
        "spectrum": "Model and measured",
        "density": "Densities",
        "orbit": "Orbits",
    }
    tabs = []
    for kind, name in kinds.items():
        views = [view(entity, text) for entity, text in drawn.items() if entity.startswith(kind + "/")]
        if views:
            tabs.append(rrb.Grid(*views, grid_columns=per_row if kind == "residual" else 2, name=name))
    pages = [rrb.TextDocumentView(origin=name.lower(), name=name) for name in texts]
    words = rrb.Tabs(*pages, active_tab=0)
    return rrb.Blueprint(
        rrb.Horizontal(words, rrb.Tabs(*tabs, active_tab=0), column_shares=[2, 5]) if tabs else words,
        rrb.TimePanel(timeline=STEP_TIMELINE, state="collapsed", play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )
