"""An x-y plot as lines and labels of a 2-D view: Rerun's own plots have a time axis and linear scales only."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import rerun as rr

# view units; the view fits itself to the frame, so every plot has the same size
WIDTH_UNITS, HEIGHT_UNITS = 1300.0, 560.0
MARGIN_UNITS = 60.0
LABEL_UNITS = 85.0  # of the words of the x axis below it: clear of the numbers also in a small view
MARK_ROWS, MARK_ROW_UNITS = 3, 62.0  # of names of marks, so that neighbours do not cover each other
GRID_COLOUR = (120, 120, 120, 70)
TEXT_COLOUR = (150, 150, 150, 255)
MINUS_SIGN = str.maketrans("-", "\N{MINUS SIGN}")


@dataclass(frozen=True, slots=True)
class Axis:
    """From `low` to `high` in the unit that `label` names; logarithmic axes span whole decades or parts of them."""

    low: float
    high: float
    label: str
    log: bool = False

    def fraction(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Position along the axis, 0 at low, 1 at high, clipped there."""
        if self.log:
            values = np.log10(np.maximum(values, self.low))
            low, high = math.log10(self.low), math.log10(self.high)
        else:
            low, high = self.low, self.high
        return np.clip((values - low) / (high - low), 0.0, 1.0)

    def ticks(self) -> list[tuple[float, str]]:
        """Where to draw a grid line, and what to write there."""
        if not self.log:
            step = nice_step((self.high - self.low) / 4)
            first = math.ceil(self.low / step - 1e-9)
            return [(k * step, f"{k * step:g}") for k in range(first, math.floor(self.high / step + 1e-9) + 1)]
        low, high = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
        stride = max(1, math.ceil((high - low) / 5))
        return [(10.0**k, f"1e{k}" if abs(k) > 3 else f"{10.0**k:g}") for k in range(low, high + 1, stride)]


def nice_step(value: float) -> float:
    """The smallest of 1, 2, 5, 10 times a power of ten that is not below `value` (> 0)."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(f * decade for f in (1.0, 2.0, 5.0, 10.0) if f * decade >= value * (1 - 1e-9))


def round_up(value: float) -> float:
    """A round number a little above `value` (> 0): what an axis ends at."""
    decade = 10.0 ** math.floor(math.log10(value))
    steps = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0)
    return next(f * decade for f in steps if f * decade >= value * (1 - 1e-9))


def decades(values: NDArray[np.float64], at_most: int = 10) -> tuple[float, float]:
    """Whole decades around the positive `values`, the lowest given up if there are more than `at_most`."""
    positive = values[np.isfinite(values) & (values > 0)]
    if not positive.size:
        return 1e-3, 1.0
    high = math.ceil(math.log10(positive.max()) + 1e-9)
    low = max(math.floor(math.log10(positive.min())), high - at_most)
    return 10.0**low, 10.0 ** max(high, low + 1)


@dataclass(frozen=True, slots=True)
class Plane:
    """A frame with two axes, drawn under one entity path."""

    x: Axis
    y: Axis
    width: float = WIDTH_UNITS

    def points(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) view coordinates (y downwards); rows with a NaN are left out."""
        keep = np.isfinite(x) & np.isfinite(y)
        return np.column_stack([self.x.fraction(x[keep]) * self.width, (1 - self.y.fraction(y[keep])) * HEIGHT_UNITS])

    def frame(self) -> list[tuple[str, Any]]:
        """The grid and the labels, as (name, archetype) pairs to log under the plot's path."""
        import rerun as rr

        border = [[0.0, 0.0], [self.width, 0.0], [self.width, HEIGHT_UNITS], [0.0, HEIGHT_UNITS], [0.0, 0.0]]
        strips: list[list[list[float]]] = [border]
        marks: list[list[float]] = []
        words: list[str] = []
        for value, text in self.x.ticks():
            at = float(self.x.fraction(np.array([value]))[0]) * self.width
            strips.append([[at, 0], [at, HEIGHT_UNITS]])
            marks.append([at, HEIGHT_UNITS])
            words.append(text)
        for value, text in self.y.ticks():
            at = (1 - float(self.y.fraction(np.array([value]))[0])) * HEIGHT_UNITS
            strips.append([[0, at], [self.width, at]])
            marks.append([-MARGIN_UNITS, at - MARGIN_UNITS / 4])
            words.append(text)
        marks += [[self.width / 2, HEIGHT_UNITS + LABEL_UNITS]] if self.x.label else []
        words += [self.x.label] if self.x.label else []
        words = [w.translate(MINUS_SIGN) for w in words]
        return [
            ("grid", rr.LineStrips2D(strips, colors=[GRID_COLOUR], radii=rr.Radius.ui_points(0.5))),
            (
                "labels",
                rr.Points2D(marks, labels=words, show_labels=True, colors=[TEXT_COLOUR], radii=rr.Radius.ui_points(0)),
            ),
        ]


def mark_names(plane: Plane, marks: Sequence[tuple[float, str]]) -> rr.Points2D:
    """The names of lines over the whole height, above the frame, neighbours in separate rows."""
    import rerun as rr

    marks = sorted(marks)
    at = plane.x.fraction(np.array([value for value, _ in marks])) * plane.width
    heads = np.column_stack([at, [-(1 + k % MARK_ROWS) * MARK_ROW_UNITS for k in range(len(marks))]])
    names = [name for _, name in marks]
    return rr.Points2D(heads, labels=names, show_labels=True, colors=[TEXT_COLOUR], radii=rr.Radius.ui_points(0))


def curves(
    plane: Plane, series: Iterable[tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, int, int]]]
) -> rr.LineStrips2D:
    """Lines (x, y, colour) in the plane."""
    import rerun as rr

    drawn = [(plane.points(x, y), colour) for x, y, colour in series]
    drawn = [(points, colour) for points, colour in drawn if len(points) > 1]
    return rr.LineStrips2D(
        [points for points, _ in drawn], colors=[colour for _, colour in drawn], radii=rr.Radius.ui_points(0.9)
    )
