"""Pictures of the measured signal: spectra with tones, envelope spectra with defect frequencies, modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .figures import (
    BEFORE_COLOUR,
    MEASURED_COLOUR,
    MODEL_COLOUR,
    decade_ticks,
    floats,
    grid_of,
    label_axes,
    new_figure,
    plain,
    svg,
)
from .numbers import unit_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Json = Mapping[str, Any]
HARMONICS_MARKED = 3  # of each defect frequency
MIN_LABEL_DISTANCE = 0.075  # of the width of the axes
LABEL_ROWS = 5  # that labels close together are spread over; more of them are left out


def pictures(signal: Json) -> dict[str, str | None]:
    """SVG by name: measured, envelopes, modes; None where there is nothing to show."""
    return {
        "measured": measured(signal.get("spectra", {})),
        "envelopes": envelopes(signal.get("envelopes", {})),
        "modes": modes(signal.get("modes", ()), signal.get("spectra", {})),
    }


def measured(spectra: Json) -> str | None:
    """Measured PSD by channel, with the tones labelled."""
    if not spectra:
        return None
    figure, axes = grid_of(list(spectra), height=2.9)
    for ax, (channel, s) in zip(axes, spectra.items(), strict=False):
        f, psd = floats(s["frequency_hz"]), floats(s["psd"])
        ax.loglog(f, np.where(psd > 0, psd, np.nan), color=MEASURED_COLOUR, linewidth=0.7)
        _room_above(ax, psd)
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
        ax.semilogy(f, np.where(psd > 0, psd, np.nan), color=MEASURED_COLOUR, linewidth=0.7)
        _room_above(ax, psd)
        ax.set_xlim(0, f[-1])
        marks = [(k * hz, name if k == 1 else f"{k}×{name}") for hz, name in s["marks"] for k in _multiples(name)]
        label_marks(ax, sorted(m for m in marks if m[0] <= f[-1]))
        low, high = s["band_hz"]
        label_axes(ax, "frequency, Hz", "PSD of the squared envelope", f"{channel}, {low:.4g} to {high:.4g} Hz")
    return svg(figure, "envelopes")


def _multiples(name: str) -> Sequence[int]:
    """Harmonics that are marked; of the cage the first alone."""
    return (1,) if name == "FTF" else range(1, HARMONICS_MARKED + 1)


def _room_above(ax: Axes, psd: Any) -> None:
    """Limits that show the spectrum and leave room for labels."""
    there = psd[psd > 0]
    if there.size:
        low, high = float(np.quantile(there, 0.002)), float(there.max())
        ax.set_ylim(low / 2, high * (high / low) ** 0.35)


def label_marks(ax: Axes, marks: Sequence[Sequence[Any]], log: bool = False) -> None:
    """Thin lines at frequencies with their labels at the top, close ones below each other."""
    low, high = ax.get_xlim()
    ends = [-np.inf] * LABEL_ROWS
    for hz, text in marks:
        if not low <= hz <= high:
            continue
        at = np.log(hz / low) / np.log(high / low) if log else (hz - low) / (high - low)
        ax.axvline(hz, color=MODEL_COLOUR, linewidth=0.5, alpha=0.6, zorder=0)
        row = next((k for k, end in enumerate(ends) if at - end >= MIN_LABEL_DISTANCE), None)
        if row is None:
            continue
        ends[row] = at
        ax.text(
            at, 0.98 - 0.065 * row, plain(text), transform=ax.transAxes, fontsize=6.5, ha="center", va="top",
            color=MODEL_COLOUR, bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.8},
        )  # fmt: skip


def modes(found: Sequence[Json], spectra: Json) -> str | None:
    """Frequency and damping ratio of each mode with standard deviations, over the spectrum of the first channel."""
    if not found:
        return None
    figure, (ax,) = new_figure(9.6, 3.2)
    behind = ax.twinx()
    s = next(iter(spectra.values()), None)
    if s is not None:
        f, psd = floats(s["frequency_hz"]), floats(s["psd"])
        behind.semilogy(f, np.where(psd > 0, psd, np.nan), color="#bbbbbb", linewidth=0.7)
    behind.set_yticks([])
    behind.spines[["top", "right"]].set_visible(False)
    ax.set_zorder(behind.get_zorder() + 1)
    ax.patch.set_visible(False)
    for k, place in enumerate(dict.fromkeys(mode["place"] for mode in found)):
        own = [mode for mode in found if mode["place"] == place]
        colour = (MODEL_COLOUR, BEFORE_COLOUR, "#009E73", "#CC79A7")[k % 4]
        for mode in own:
            ax.errorbar(
                mode["frequency_hz"], 100 * mode["damping"], xerr=mode["frequency_sd"] or 0.0,
                yerr=100 * (mode["damping_sd"] or 0.0), fmt="o", color=colour, capsize=3, markersize=6,
                fillstyle="full" if mode["bearing"] else "none", label=place if mode is own[0] else None,
            )  # fmt: skip
    ax.set_xscale("log")
    decade_ticks(ax)
    ax.set_ylim(bottom=0.0)
    ax.legend(fontsize=8, frameon=False)
    label_axes(ax, "frequency, Hz", "damping ratio, %")
    return svg(figure, "modes")
