"""Pictures of the measured signal: spectra with tones, envelope spectra with defect frequencies, modes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .figures import (
    BEFORE_COLOUR,
    MEASURED_COLOUR,
    MODEL_COLOUR,
    decade_ticks,
    floats,
    grid_of,
    label_axes,
    plain,
    svg,
)
from .numbers import unit_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Json = Mapping[str, Any]
HARMONICS_MARKED = 3  # of each defect frequency
MIN_LABEL_DISTANCE = 0.085  # of the width of the axes
MIN_MODE_LABEL_DISTANCE = 0.25  # those labels are longer
LABEL_ROWS = 5  # that labels close together are spread over; more of them are left out


def pictures(signal: Json) -> dict[str, str | None]:
    """SVG by name: measured, orders, envelopes, waterfalls, modes; None where there is nothing to show."""
    return {
        "measured": measured(signal.get("spectra", {})),
        "envelopes": envelopes(signal.get("envelopes", {})),
        "orders": orders(signal.get("orders", {})),
        "waterfalls": waterfalls(signal.get("waterfalls", {})),
        "modes": modes(signal),
    }


def measured(spectra: Json) -> str | None:
    """Measured PSD by channel, with the tones labelled."""
    if not spectra:
        return None
    figure, axes = grid_of(list(spectra), height=2.9)
    for ax, (channel, s) in zip(axes, spectra.items(), strict=False):
        f, psd = floats(s["frequency_hz"]), floats(s["psd"])
        _draw(ax, ax.loglog, f, psd)
        decade_ticks(ax)
        ax.set_xlim(f[0], f[-1])
        label_marks(ax, s["marks"], log=True)
        label_axes(ax, "frequency, Hz", f"PSD, ({unit_text(s['unit'])})²/Hz", channel)
    return svg(figure, "measured")


def envelopes(spectra: Json) -> str | None:
    """PSD of the squared envelope by channel, with the defect frequencies of the bearing and their multiples."""
    if not spectra:
        return None
    figure, axes = grid_of(list(spectra), height=2.9)
    for ax, (channel, s) in zip(axes, spectra.items(), strict=False):
        f, psd = floats(s["frequency_hz"]), floats(s["psd"])
        _draw(ax, ax.semilogy, f, psd)
        ax.set_xlim(0, f[-1])
        marks = [(k * hz, name if k == 1 else f"{k}×{name}") for hz, name in s["marks"] for k in _multiples(name)]
        label_marks(ax, sorted(m for m in marks if m[0] <= f[-1]))
        low, high = s["band_hz"]
        unit = f", ({unit_text(s['unit'])})⁴/Hz" if "unit" in s else ""
        label_axes(ax, "frequency, Hz", f"PSD of its square{unit}", f"{channel}, {low:.4g} to {high:.4g} Hz")
    return svg(figure, "envelopes")


def _multiples(name: str) -> Sequence[int]:
    """Harmonics that are marked; of the cage and the shaft the first alone."""
    return (1,) if name in ("FTF", "1X") else range(1, HARMONICS_MARKED + 1)


def orders(spectra: Json) -> str | None:
    """Amplitude of lines by channel against the order of the shaft, with the orders of the bearing."""
    if not spectra:
        return None
    figure, axes = grid_of(list(spectra), height=2.9)
    for ax, (channel, s) in zip(axes, spectra.items(), strict=False):
        order, amplitude = floats(s["order"]), floats(s["amplitude"])
        _draw(ax, ax.semilogy, order, amplitude)
        ax.set_xlim(0, order[-1])
        label_marks(ax, s["marks"])
        label_axes(ax, "order of the shaft", f"amplitude, {unit_text(s['unit'])}", channel)
    return svg(figure, "orders")


def waterfalls(falls: Json) -> str | None:
    """Level of the spectrum by channel against time and frequency."""
    if not falls:
        return None
    figure, axes = grid_of(list(falls), height=2.9)
    for ax, (channel, s) in zip(axes, falls.items(), strict=False):
        level = np.array([floats(row) for row in s["level_db"]])
        low, high = level_range(level)
        f = floats(s["frequency_hz"])
        image = ax.pcolormesh(
            floats(s["time_s"]), f, level.T, cmap="viridis", vmin=low, vmax=high, rasterized=True, shading="nearest"
        )
        ax.set_yscale("log")
        ax.set_ylim(max(f[0], 1e-3 * f[-1]), f[-1])
        ax.grid(visible=False)
        label_axes(ax, "time, s", "frequency, Hz", f"{channel}, dB of ({unit_text(s['unit'])})²/Hz")
        ax.figure.colorbar(image, ax=ax, pad=0.01).ax.tick_params(labelsize=7)
    return svg(figure, "waterfalls")


def level_range(level: NDArray[np.float64]) -> tuple[float, float]:
    """Levels in dB between which colours run: 60 dB below the loudest cell at most."""
    there = level[np.isfinite(level)]
    if not there.size:
        return -1.0, 0.0
    high = float(np.quantile(there, 0.999))
    return max(high - 60.0, float(np.quantile(there, 0.02))), high


def _draw(ax: Axes, plot: Callable[..., object], x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    """A measured line on a logarithmic axis: zeros are left out, and marks have room above it."""
    plot(x, np.where(y > 0, y, np.nan), color=MEASURED_COLOUR, linewidth=0.7)
    _room_above(ax, y)


def _room_above(ax: Axes, psd: Any) -> None:
    """Limits that show the spectrum and leave room for labels."""
    there = psd[psd > 0]
    if there.size:
        low, high = float(np.quantile(there, 0.002)), float(there.max())
        ax.set_ylim(low / 2, high * (high / low) ** 0.35)


def label_marks(
    ax: Axes, marks: Sequence[Sequence[Any]], log: bool = False, distance: float = MIN_LABEL_DISTANCE
) -> None:
    """Thin lines at frequencies with their labels at the top, close ones below each other."""
    low, high = ax.get_xlim()
    ends = [-np.inf] * LABEL_ROWS
    for hz, text in marks:
        if not low <= hz <= high:
            continue
        at = np.log(hz / low) / np.log(high / low) if log else (hz - low) / (high - low)
        ax.axvline(hz, color=MODEL_COLOUR, linewidth=0.5, alpha=0.6, zorder=0)
        row = next((k for k, end in enumerate(ends) if at - end >= distance), None)
        if row is None:
            continue
        ends[row] = at
        ax.text(
            at, 0.98 - 0.065 * row, plain(text), transform=ax.transAxes, fontsize=6.5, ha="center", va="top",
            color=MODEL_COLOUR, bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.8},
        )  # fmt: skip


def modes(signal: Json) -> str | None:
    """Stabilisation diagram by place: the poles of fits with more and more modes, over the spectrum."""
    found, poles = signal.get("modes", ()), signal.get("poles", ())
    places = list(dict.fromkeys(point["place"] for point in (*found, *poles)))
    if not places:
        return None
    low, high = signal["band"]
    figure, axes = grid_of(places, height=2.9)
    for ax, place in zip(axes, places, strict=False):
        behind = ax.twinx()
        for s in signal["spectra"].values():
            if s["place"] == place:
                f, psd = floats(s["frequency_hz"]), floats(s["psd"])
                inside = (f >= low) & (f <= high) & (psd > 0)
                behind.semilogy(f[inside], psd[inside], color="#bbbbbb", linewidth=0.7)
        behind.set_axis_off()
        ax.set_zorder(behind.get_zorder() + 1)
        ax.patch.set_visible(False)
        ax.set_xscale("log")
        ax.set_xlim(low, high)
        for stable, fill in ((True, "full"), (False, "none")):
            own = [p for p in poles if p["place"] == place and p["stable"] == stable]
            at = [p["frequency_hz"] for p in own], [p["order"] for p in own]
            ax.plot(*at, "o", color=BEFORE_COLOUR, fillstyle=fill, markersize=4.5)
        most = max([p["order"] for p in poles if p["place"] == place], default=1)
        ax.set_ylim(0.4, most * 1.5 + 0.6)
        ax.set_yticks(range(1, most + 1))
        decade_ticks(ax)
        named = [(m["frequency_hz"], mode_label(m)) for m in found if m["place"] == place]
        label_marks(ax, sorted(named), log=True, distance=MIN_MODE_LABEL_DISTANCE)
        label_axes(ax, "frequency, Hz", "modes in the fit", place)
    return svg(figure, "modes")


def mode_label(mode: Json) -> str:
    """Frequency and damping of a mode; a star where it is the bearing's."""
    star = "* " if mode["bearing"] else ""
    return f"{star}{mode['frequency_hz']:.4g} Hz, {100 * mode['damping']:.2g} %"
