"""The pictures of the report: results in, SVG text out. Figures are objects; matplotlib's global state is not touched.

Colours by Okabe and Ito: measurement dark grey, the model as it is blue, the model before vermilion and dashed, so
that neither colour vision nor a black-and-white print loses the difference.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .numbers import percent, prefix, unit_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Json = Mapping[str, Any]
Array = NDArray[np.float64]
MEASURED_COLOUR, MODEL_COLOUR, BEFORE_COLOUR = "#333333", "#0072B2", "#D55E00"
AXIS_OF_STATE = {
    "displacement": ("displacement", "m"),
    "velocity": ("velocity", "m/s"),
    "shaft_angle": ("shaft angle", "deg"),
    "other_direction": ("displacement, other direction", "m"),
    "other_bearing": ("displacement, other bearing", "m"),
    "frequency": ("frequency", "Hz"),
    "time": ("time", "s"),
    "level": ("vibration level", "m"),
}
LEFT_INCHES, RIGHT_INCHES, BOTTOM_INCHES, TOP_INCHES = 0.72, 0.16, 0.46, 0.28  # inches about each picture of a grid
BETWEEN_INCHES = 0.3  # of those that share an axis
MIN_PEAK_DB, MAX_RESONANCES = 3.0, 4  # of a predicted resonance: height over its surroundings; how many are marked
STATES_BY_PRIORITY = ("displacement", "velocity", "shaft_angle", "other_direction")  # of which curves are drawn


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, fixed: bool = True, **more: Any
) -> tuple[Figure, list[Axes]]:
    """A figure; sizes in inches. fixed : use the margins above, because fitting them takes as long as drawing."""
    from matplotlib.figure import Figure

    fixed = fixed and rows * columns > 1
    figure = Figure(figsize=(width, height), layout=None if fixed else "constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **more)
    if fixed:
        beside, above = BETWEEN_INCHES if "sharey" in more else LEFT_INCHES, BOTTOM_INCHES + TOP_INCHES
        wide = (width - LEFT_INCHES - RIGHT_INCHES - (columns - 1) * beside) / columns
        high = (height - above - (rows - 1) * above) / rows
        figure.subplots_adjust(
            LEFT_INCHES / width,
            BOTTOM_INCHES / height,
            1 - RIGHT_INCHES / width,
            1 - TOP_INCHES / height,
            beside / wide,
            above / high,
        )
    for ax in axes.flat:
        ax.grid(True, color="#dddddd", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
    return figure, list(axes.flat)


def svg(figure: Figure, name: str) -> str:
    """The figure as an <svg> element. name : makes its internal ids its own, and the same in every run."""
    import matplotlib as mpl

    out = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name, "font.family": "sans-serif"}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    return text[text.index("<svg") :]


def plain(text: str) -> str:
    """The text without formulas: a dollar sign starts none."""
    return str(text).replace("$", r"\$")


def floats(values: Any) -> Array:
    """An array of what JSON holds; null becomes NaN."""
    return np.array([math.nan if v is None else v for v in values], dtype=np.float64)


def label_axes(ax: Axes, x: str, y: str, title: str = "") -> None:
    ax.set_xlabel(plain(x), fontsize=8.5)
    ax.set_ylabel(plain(y), fontsize=8.5)
    if title:
        ax.set_title(plain(title), fontsize=9.5, loc="left")


def ladder(steps: Sequence[Json]) -> str:
    """Missing force with its interval, one bar a model."""
    figure, (ax,) = new_figure(7.6, 0.9 + 0.42 * len(steps))
    for row, step in enumerate(steps):
        missing = step["missing_force_percent"]
        value, low, high = (
            missing["value"],
            min(missing["low"], missing["value"]),
            max(missing["high"], missing["value"]),
        )
        last = row == len(steps) - 1
        ax.barh(row, value, color=MODEL_COLOUR if last else BEFORE_COLOUR, alpha=0.85, height=0.6)
        ax.errorbar(value, row, xerr=[[value - low], [high - value]], color="black", capsize=3, linewidth=1)
        ax.annotate(percent(value), (high, row), xytext=(6, 0), textcoords="offset points", va="center", fontsize=8.5)
    ax.set_yticks(range(len(steps)), [plain(model_name(step["effects"])) for step in steps])
    ax.invert_yaxis()
    ax.margins(x=0.12)
    ax.set_xlim(left=0)
    label_axes(ax, "missing force, % of the bearing force (held-out data, 95 % interval)", "")
    return svg(figure, "ladder")


def model_name(effects: Sequence[str]) -> str:
    return "linear" + "".join(f" + {name}" for name in effects)


def where_map(after: Sequence[Json], before: Sequence[Json] | None = None, channels: Sequence[str] = ()) -> str | None:
    """Share of the missing force, channels by what it is a function of; the model before (None: there is none)
    beside it. channels : those looked at, also where nothing was found."""
    maps = {"this model": after} if before is None else {"before": before, "this model": after}
    before = before or ()
    everything = [*before, *after]
    channels = list(dict.fromkeys([*channels, *(r["channel"] for r in everything)]))
    against = list(AXIS_OF_STATE)
    if not channels or not everything:
        return None
    size = (5.4 * len(maps) if len(maps) > 1 else 7.6, 1.3 + 0.36 * len(channels))
    figure, axes = new_figure(*size, 1, len(maps), fixed=False)
    for ax, (name, rows) in zip(axes, maps.items(), strict=True):
        share = np.zeros((len(channels), len(against)))
        for r in rows:
            share[channels.index(r["channel"]), against.index(r["against"])] += r["share_percent"]
        ax.grid(False)
        ax.imshow(share, cmap="Blues", vmin=0, vmax=100, aspect="auto")
        for i, j in np.ndindex(*share.shape):
            tone = "white" if share[i, j] > 60 else "black"
            ax.text(
                j,
                i,
                f"{share[i, j]:.0f} %" if share[i, j] else "\N{EN DASH}",
                ha="center",
                va="center",
                fontsize=8.5,
                color=tone,
            )
        ax.set_yticks(range(len(channels)), [plain(c) for c in channels])
        ax.set_xticks(range(len(against)), [a.replace("_", "\n") for a in against], fontsize=6.5)
        label_axes(ax, "the missing force as a function of ...", "channel", name if len(maps) > 1 else "")
    return svg(figure, "where")


def grid_of(names: Sequence[str], height: float = 2.5) -> tuple[Figure, list[Axes]]:
    columns = 1 if len(names) == 1 else 2
    rows = math.ceil(len(names) / columns)
    figure, axes = new_figure(9.6, height * rows + 0.2, rows, columns)
    for ax in axes[len(names) :]:
        ax.remove()
    return figure, axes


def decade_ticks(ax: Axes) -> None:
    """1, 2, 5 of each decade of a logarithmic frequency axis, written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda f, _: f"{f / 1000:g}k" if f >= 1000 else f"{f:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


def spectra(after: Json, before: Json, distance_db: Json, unit: str = "m/s^2") -> str | None:
    """Measured and modelled one-sided PSD by channel, with the resonances that the model predicts."""
    if not after:
        return None
    figure, axes = grid_of(list(after))
    for k, (ax, (channel, s)) in enumerate(zip(axes, after.items(), strict=False)):
        f = floats(s["frequency_hz"])
        ax.loglog(f, floats(s["measured"]), color=MEASURED_COLOUR, linewidth=1.1, label="measured")
        if channel in before:
            old = before[channel]
            ax.loglog(
                floats(old["frequency_hz"]),
                floats(old["model"]),
                color=BEFORE_COLOUR,
                dashes=(4, 2),
                linewidth=1.2,
                label="before",
            )
        ax.loglog(f, floats(s["model"]), color=MODEL_COLOUR, linewidth=1.3, label="this model")
        for hz in resonances(f, floats(s["model"])):
            ax.axvline(hz, color=MODEL_COLOUR, linewidth=0.7, linestyle=":")
            ax.annotate(f"{hz:.4g} Hz", (hz, 1), xycoords=("data", "axes fraction"), xytext=(2, -8),
                        textcoords="offset points", fontsize=6.5, color=MODEL_COLOUR)  # fmt: skip
        d = f"   {distance_db[channel]:.1f} dB apart" if channel in distance_db else ""
        decade_ticks(ax)
        label_axes(ax, "frequency, Hz", f"PSD, ({unit_text(unit)})²/Hz", channel + d)
        if not k:
            ax.legend(fontsize=8, frameon=False)
    return svg(figure, "spectra")


def resonances(f: Array, model: Array) -> list[float]:
    """Frequencies in Hz at which the spectrum of a model peaks by 3 dB or more: its resonances as they are seen."""
    from scipy.signal import find_peaks

    there = np.isfinite(model) & (model > 0)
    if not there.any():
        return []
    peaks, _ = find_peaks(10.0 * np.log10(model[there]), prominence=MIN_PEAK_DB)
    return [float(hz) for hz in f[there][peaks[:MAX_RESONANCES]]]


def densities(after: Json, before: Json, distance: Json) -> str | None:
    """Probability density of the displacement in the analysis band, logarithmic: the tails show the law."""
    if not after:
        return None
    figure, axes = grid_of(list(after))
    gain, unit = prefix(max(float(np.nanmax(np.abs(floats(d["at"])), initial=0)) for d in after.values()), "m")
    for k, (ax, (channel, d)) in enumerate(zip(axes, after.items(), strict=False)):
        at = floats(d["at"])
        for values, colour, dashes, label in (
            (d["measured"], MEASURED_COLOUR, (), "estimated"),
            (before.get(channel, {}).get("model"), BEFORE_COLOUR, (4, 2), "before"),
            (d["model"], MODEL_COLOUR, (), "this model"),
        ):
            if values is not None:
                x = floats(before[channel]["at"]) if label == "before" else at
                p = floats(values) / gain
                ax.semilogy(
                    x * gain, np.where(p > 0, p, np.nan), color=colour, dashes=dashes, linewidth=1.2, label=label
                )
        gap = f"   distance {distance[channel]:.3g}" if channel in distance else ""
        label_axes(ax, f"displacement, {unit}", f"density, 1/{unit}", channel + gap)
        if not k:
            ax.legend(fontsize=8, frameon=False)
    return svg(figure, "densities")


def orbits(pairs: Json) -> str | None:
    """Orbit estimated from the record beside that of the simulated twin, one row a bearing."""
    if not pairs:
        return None
    figure, axes = new_figure(7.0, 3.3 * len(pairs) + 0.2, len(pairs), 2, sharex="row", sharey="row")
    for k, (bearing, pair) in enumerate(pairs.items()):
        both = {name: (floats(pair[name][0]), floats(pair[name][1])) for name in ("measured", "model")}
        peak = max(float(np.nanmax(np.abs(v), initial=0)) for xy in both.values() for v in xy)
        gain, unit = prefix(peak, "m")
        for ax, (name, colour) in zip(
            axes[2 * k :], (("measured", MEASURED_COLOUR), ("model", MODEL_COLOUR)), strict=False
        ):
            x, y = both[name]
            ax.plot(x * gain, y * gain, color=colour, linewidth=0.6, alpha=0.8)
            ax.set_aspect("equal", adjustable="box")
            label_axes(
                ax, f"x, {unit}", f"y, {unit}", f"{bearing}: {'estimated' if name == 'measured' else 'this model'}"
            )
    return svg(figure, "orbits")


def ranking(rows: Sequence[Json], number: int = 0) -> str:
    """Held-out gain of the best few effects."""
    figure, (ax,) = new_figure(7.6, 0.9 + 0.34 * len(rows))
    gains = [r["heldout_gain"] for r in rows]
    ax.barh(range(len(rows)), gains, color=[MODEL_COLOUR if not k else "#9db7c9" for k in range(len(rows))], height=0.6)
    ax.axvline(0, color="black", linewidth=0.8)
    ax.set_yticks(range(len(rows)), [plain(f"{r['effect']} at {', '.join(r['at'])}") for r in rows])
    ax.invert_yaxis()
    label_axes(ax, "gain in log-likelihood on held-out data, nats", "")
    return svg(figure, f"ranking{number}")
