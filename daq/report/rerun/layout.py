"""The blueprint in every recording: the views with their places and time lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from daq.report.numbers import unit_text

from .plane import HEIGHT_UNITS, WIDTH_UNITS

if TYPE_CHECKING:
    import rerun.blueprint as rrb

DEVICE_TIME, HOST_TIME = "device_time", "host_time"
LINEAR_PARAMETERS = ("kL", "c", "m", "S")
MOST_APART = 6  # waveforms with a plot each
WINDOW_S = 10.0  # of the rolling waveform view; zoom out for the rest
# Okabe and Ito's colours, distinct with every common colour vision, on dark and on light ground.
PLOT_COLOURS = (
    (86, 180, 233), (230, 159, 0), (0, 158, 115), (204, 121, 167), (213, 94, 0),
    (240, 228, 66), (0, 114, 178), (150, 150, 150),
)  # fmt: skip
BAD_COLOUR, GOOD_COLOUR, IDLE_COLOUR = (213, 94, 0), (0, 158, 115), (130, 130, 130)


def part(name: str) -> str:
    """A name of the user's or a device's as one part of an entity path."""
    import rerun as rr

    escaped: str = rr.escape_entity_path_part(name)
    return escaped or "_"


def colour(k: int) -> tuple[int, int, int]:
    return PLOT_COLOURS[k % len(PLOT_COLOURS)]


def layout(
    signals: Mapping[str, Sequence[str]], bearings: Sequence[str], parameters: Mapping[str, str], missing_force: bool
) -> rrb.Blueprint:
    """The live view. signals : unit -> waveforms; bearings : those with an orbit; parameters : kind -> heading."""
    import rerun.blueprint as rrb

    left = [rrb.Vertical(*_waveforms(signals))] if signals else []
    tabs = _estimates(parameters, missing_force)
    left += [rrb.Horizontal(*tabs)] if tabs else []
    left += [rrb.StateTimelineView(origin="state", name="Link, gaps, sensors, estimator, model")]
    spectra = [_plot(f"spectrum/{k}", f"Spectrum [({unit_text(unit)})²/Hz]") for k, unit in enumerate(signals)]
    scopes = [_plot(f"scope/{k}", f"Scope, every sample [{unit_text(unit)}]") for k, unit in enumerate(signals)]
    orbits = [_plot(f"orbit/{part(bearing)}", f"Orbit, {bearing} [nm]", HEIGHT_UNITS) for bearing in bearings]
    right = [_tabbed(spectra + scopes)] if signals else []
    right += [*([rrb.Horizontal(*orbits)] if orbits else []), _health()]
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


def _waveforms(signals: Mapping[str, Sequence[str]]) -> list[Any]:
    """For each unit the last seconds of its channels: each by itself, or in one plot if they are many."""
    import rerun.blueprint as rrb

    rolling = rrb.VisibleTimeRange(
        DEVICE_TIME,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )

    def trace(path: str, name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=path, name=name, plot_legend=rrb.PlotLegend(visible=False), time_ranges=rolling
        )

    return [
        _series(f"waveform/{k}", f"Waveforms [{unit_text(unit)}]", time_ranges=rolling)
        if len(names) > MOST_APART
        else rrb.Vertical(*(trace(f"waveform/{k}/{part(name)}", f"{name} [{unit_text(unit)}]") for name in names))
        for k, (unit, names) in enumerate(signals.items())
    ]


def _estimates(parameters: Mapping[str, str], missing_force: bool) -> list[Any]:
    """Tabs of the linear parameters, of the nonlinear ones, and of the missing force."""
    views = {kind: _series(f"estimate/{part(kind)}", heading) for kind, heading in parameters.items()}
    linear = [views[kind] for kind in LINEAR_PARAMETERS if kind in views]
    nonlinear = [view for kind, view in views.items() if kind not in LINEAR_PARAMETERS]
    missing = [_series("missing_force", "Missing force [%]")] if missing_force else []
    return [_tabbed(group) for group in (linear, nonlinear, missing) if group]


def _health() -> Any:
    """Tabs of the log, of the layers of the last seconds, and of the state of the stages."""
    import rerun.blueprint as rrb

    views = [
        rrb.TextLogView(origin="log", name="Log"),
        rrb.TextDocumentView(origin="layers", name="Layers"),
        _series("health/lost", "Lost and damaged, running total"),
        _series("health/lag", "Lag of each stage [s]"),
        _series("health/clock", "Clock"),
        rrb.TextDocumentView(origin="rig", name="Rig file"),
    ]
    return rrb.Tabs(*views, active_tab=0)


def _series(path: str, name: str, **more: Any) -> rrb.TimeSeriesView:
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(origin=path, name=name, plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop), **more)


def _plot(path: str, name: str, width: float = WIDTH_UNITS) -> rrb.Spatial2DView:
    import rerun.blueprint as rrb

    bounds = rrb.VisualBounds2D(x_range=(-110, width + 40), y_range=(-30, HEIGHT_UNITS + 90))
    return rrb.Spatial2DView(origin=path, name=name, visual_bounds=bounds)


def _tabbed(views: list[Any]) -> Any:
    import rerun.blueprint as rrb

    return views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0)
