"""The report's pictures of force against a state: the restoring law, the residual, an unknown shape."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from .figures import (
    AXIS_OF_STATE,
    BEFORE_COLOUR,
    MEASURED_COLOUR,
    MODEL_COLOUR,
    STATES_BY_PRIORITY,
    floats,
    label_axes,
    new_figure,
    svg,
)
from .numbers import prefix

Json = Mapping[str, Any]
AS_THEY_ARE = ("deg", "Hz", "s")  # units without prefixes


def force_reach(curves: Sequence[Json]) -> float:
    """Limit of the force axis, N: it holds all known curves and the usual band (0 without one)."""
    widths = [
        floats(c["band_high"]) - floats(c["band_low"]) if c.get("band_high") and c.get("band_low")
        else 0.0 * floats(c["force"])
        for c in curves
    ]  # fmt: skip
    usual = max((float(np.nanmedian(w)) for w in widths if np.isfinite(w).any()), default=0.0)
    known = [np.abs(floats(c["force"]))[w <= 4 * usual] for c, w in zip(curves, widths, strict=True)]
    tallest = max((float(np.nanmax(k, initial=0)) for k in known), default=0.0)
    return 1.15 * max(tallest, usual) or 1.0


def scaled(many: Iterable[Sequence[float]], unit: str) -> tuple[float, str]:
    """Factor and unit for values in `unit`; angles, Hz and s stay as they are."""
    if unit in AS_THEY_ARE:
        return 1.0, unit
    return prefix(max((float(np.nanmax(np.abs(floats(v)), initial=0)) for v in many), default=0), unit)


def of(curves: Sequence[Json], channel: str, against: str) -> list[Json]:
    return [c for c in curves if c["channel"] == channel and c["against"] == against]


def laws(after: Sequence[Json], before: Sequence[Json] = ()) -> str | None:
    """Restoring force beyond a straight line, as estimated with its band, and as the models have it."""
    channels = list(dict.fromkeys(c["channel"] for c in after))
    against = [a for a in AXIS_OF_STATE if any(c["against"] == a for c in after)]
    if not channels or not against:
        return None
    columns = len(channels) if len(channels) <= 2 else 2
    rows = -(-len(channels) // columns) * len(against)
    figure, axes = new_figure(9.6, 2.6 * rows + 0.3, rows, columns)
    names = [(channel, kind) for kind in against for channel in channels]
    for ax, (channel, kind) in zip(axes, names, strict=False):
        (law,) = of(after, channel, kind)
        old = of(before, channel, kind)
        name, base = AXIS_OF_STATE[kind]
        x_gain, x_unit = scaled((k["at"] for k in after if k["against"] == kind), base)  # both directions in one unit
        low, high = floats(law["band_low"]), floats(law["band_high"])
        known = high - low <= 4 * np.nanmedian(high - low)
        top = 1.15 * float(np.nanmax([np.abs(floats(law[k]))[known].max(initial=0) for k in ("measured", "model")]))
        top = max(top, 2 * float(np.nanmedian(high - low))) or 1.0
        gain, unit = scaled((k["measured"] for k in after if k["against"] == kind), "N")
        x = floats(law["at"]) * x_gain
        ax.axhline(0, color="#888888", linewidth=0.8)
        ax.fill_between(x, low * gain, high * gain, color=MEASURED_COLOUR, alpha=0.22, linewidth=0)
        ax.plot(x, floats(law["measured"]) * gain, color=MEASURED_COLOUR, linewidth=1.3, label="estimated")
        for k in old:
            old_x, old_y = floats(k["at"]) * x_gain, floats(k["model"]) * gain
            ax.plot(old_x, old_y, color=BEFORE_COLOUR, linewidth=1.5, dashes=(4, 2), label="before")
        ax.plot(x, floats(law["model"]) * gain, color=MODEL_COLOUR, linewidth=1.5, label="this model")
        ax.set_ylim(-top * gain, top * gain)
        label_axes(ax, f"{name}, {x_unit}", f"{channel}: force, {unit}")
        if ax is axes[0]:
            ax.legend(fontsize=8, frameon=False)
    for ax in axes[len(names) :]:
        ax.remove()
    return svg(figure, "laws")


def residuals(after: Sequence[Json], before: Sequence[Json] = ()) -> str | None:
    """Residual force against displacement, velocity, shaft angle ..., one row a channel, with its band."""
    curves = [*before, *after]
    channels = list(dict.fromkeys(c["channel"] for c in curves))
    present = {c["against"] for c in curves}
    against = [a for a in STATES_BY_PRIORITY if a in present] or [a for a in AXIS_OF_STATE if a in present][:3]
    if not channels or not against:
        return None
    size = (min(3.5, 10.8 / len(against)) * len(against), 2.1 * len(channels) + 0.3)
    figure, axes = new_figure(*size, len(channels), len(against), sharey="row")
    for k, ax in enumerate(axes):
        channel, kind = channels[k // len(against)], against[k % len(against)]
        name, base = AXIS_OF_STATE[kind]
        row = [c for c in curves if c["channel"] == channel and c["against"] in against]
        reach = force_reach(row)
        gain, unit = prefix(reach, "N")
        factor, x_unit = scaled((c["at"] for c in of(curves, channel, kind)), base)
        ax.axhline(0, color="#888888", linewidth=0.8)
        for group, colour, dashes, text in (
            (before, BEFORE_COLOUR, (4, 2), "before"),
            (after, MODEL_COLOUR, (), "this model"),
        ):
            for c in of(group, channel, kind):
                x = floats(c["at"]) * factor
                ax.fill_between(x, floats(c["band_low"]) * gain, floats(c["band_high"]) * gain, color=colour,
                                alpha=0.22, linewidth=0)  # fmt: skip
                ax.plot(x, floats(c["force"]) * gain, color=colour, linewidth=1.4, dashes=dashes, label=text)
        ax.set_ylim(-reach * gain, reach * gain)
        first_row, first_column = k < len(against), k % len(against) == 0
        label_axes(ax, f"{name}, {x_unit}", f"{channel}: residual force, {unit}" if first_column else "")
        if first_row and first_column and before and after:
            ax.legend(fontsize=8, frameon=False)
    return svg(figure, "residuals")


def shape(found: Json, number: int = 0) -> str:
    """Picture of an unknown effect: force against the state that explains most."""
    name, base = AXIS_OF_STATE.get(found["against"], (found["against"], ""))
    at, force = floats(found["at"]), floats(found["force"])
    x_gain, x_unit = scaled([found["at"]], base)
    reach = force_reach([found])
    y_gain, y_unit = scaled([[reach]], "N")
    figure, (ax,) = new_figure(6.4, 3.0)
    ax.set_ylim(-reach * y_gain, reach * y_gain)
    ax.axhline(0, color="#888888", linewidth=0.8)
    if found.get("band_low") and found.get("band_high"):
        low, high = floats(found["band_low"]) * y_gain, floats(found["band_high"]) * y_gain
        ax.fill_between(at * x_gain, low, high, color=BEFORE_COLOUR, alpha=0.22, linewidth=0)
    ax.plot(at * x_gain, force * y_gain, color=BEFORE_COLOUR, linewidth=1.6)
    label_axes(ax, f"{name}, {x_unit}", f"unexplained force, {y_unit}", str(found.get("channel", "")))
    return svg(figure, f"shape{number}")
