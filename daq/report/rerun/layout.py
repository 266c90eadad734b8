"""The blueprint shipped with every recording: what is shown where, on which time line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from daq.report.numbers import unit_text

from .plane import HEIGHT, WIDTH

if TYPE_CHECKING:
    import rerun.blueprint as rrb

DEVICE_TIME, HOST_TIME = "device_time", "host_time"
LINEAR = ("kL", "c", "m", "S")
MOST_APART = 6  # waveforms with a plot of their own
WINDOW_S = 10.0  # of the rolling waveform view; zoom out for the rest
# Okabe and Ito's colours, told apart with every common colour vision, on dark and on light ground.
PALETTE = (
    (86, 180, 233), (230, 159, 0), (0, 158, 115), (204, 121, 167), (213, 94, 0),
    (240, 228, 66), (0, 114, 178), (150, 150, 150),
)  # fmt: skip
BAD, GOOD, IDLE = (213, 94, 0), (0, 158, 115), (130, 130, 130)


def part(name: str) -> str:
    """A name of the user's or a device's as one part of an entity path."""
    import rerun as rr

    escaped: str = rr.escape_entity_path_part(name)
    return escaped or "_"


def colour(k: int) -> tuple[int, int, int]:
    return PALETTE[k % len(PALETTE)]


def layout(
    signals: Mapping[str, Sequence[str]], bearings: Sequence[str], parameters: Mapping[str, str], missing_force: bool
) -> rrb.Blueprint:
    """The live view. signals : unit -> waveforms; bearings : those with an orbit; parameters : kind -> heading."""
    import rerun.blueprint as rrb

    rolling = rrb.VisibleTimeRange(
        DEVICE_TIME,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop)

    def series(path: str, name: str, **more: Any) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=path, name=name, plot_legend=legend, **more)

    def trace(path: str, name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=path, name=name, plot_legend=rrb.PlotLegend(visible=False), time_ranges=rolling
        )

    def plot(path: str, name: str, width: float = WIDTH) -> rrb.Spatial2DView:
        bounds = rrb.VisualBounds2D(x_range=(-110, width + 40), y_range=(-30, HEIGHT + 90))
        return rrb.Spatial2DView(origin=path, name=name, visual_bounds=bounds)

    def tabbed(views: list[Any]) -> Any:
        return views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0)

    waveforms = [
        series(f"waveform/{k}", f"Waveforms [{unit_text(unit)}]", time_ranges=rolling)
        if len(names) > MOST_APART
        else rrb.Vertical(*(trace(f"waveform/{k}/{part(name)}", f"{name} [{unit_text(unit)}]") for name in names))
        for k, (unit, names) in enumerate(signals.items())
    ]
    spectra = [plot(f"spectrum/{k}", f"Spectrum [({unit_text(unit)})²/Hz]") for k, unit in enumerate(signals)]
    scopes = [plot(f"scope/{k}", f"Scope, every sample [{unit_text(unit)}]") for k, unit in enumerate(signals)]
    orbits = [plot(f"orbit/{part(bearing)}", f"Orbit, {bearing} [nm]", HEIGHT) for bearing in bearings]
    estimates = {kind: series(f"estimate/{part(kind)}", heading) for kind, heading in parameters.items()}
    linear = [estimates[kind] for kind in LINEAR if kind in estimates]
    nonlinear = [view for kind, view in estimates.items() if kind not in LINEAR]
    missing = [series("missing_force", "Missing force [%]")] if missing_force else []
    tabs = [tabbed(group) for group in (linear, nonlinear, missing) if group]
    left = [rrb.Vertical(*waveforms)] if waveforms else []
    left += [rrb.Horizontal(*tabs)] if tabs else []
    left += [rrb.StateTimelineView(origin="state", name="Link, gaps, sensors, estimator, model")]
    health = rrb.Tabs(
        rrb.TextLogView(origin="log", name="Log"),
        series("health/lost", "Lost and damaged, running total"),
        series("health/lag", "Lag of each stage [s]"),
        series("health/clock", "Clock"),
        rrb.TextDocumentView(origin="rig", name="Rig file"),
        active_tab=0,
    )
    right = [*([tabbed(spectra + scopes)] if signals else []), *([rrb.Horizontal(*orbits)] if orbits else []), health]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[5, 4, 2][-len(left) :]),
            rrb.Vertical(*right, row_shares=[4, 4, 3][-len(right) :]),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(timeline=DEVICE_TIME, state="collapsed", play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )
