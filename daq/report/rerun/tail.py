"""The last second of a session's signals and what is drawn of it: spectra, a scope, orbits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.contract import Info, Signal

from . import plane as plane
from .layout import colour, part
from .signal import INTEGRATIONS_TO_DISPLACEMENT, displacement, spectrum

if TYPE_CHECKING:
    import rerun as rr

Array = NDArray[np.float64]
Places = Mapping[str, tuple[str, str]]  # channel -> ("bearing1.x", kind)
TAIL_S = 1.0
SCOPE_S = 0.02
ORBIT_S = 0.06


class Tail:
    """Samples in SI units, NaN where there are none. pairs : bearing -> columns of its x and y, and their kind."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        info: Info,
        places: Mapping[str, tuple[str, str]],
        band: tuple[float, float],
    ) -> None:
        self._to = recording
        self._signals: tuple[Signal, ...] = info.signals
        self._rate, self._band = info.rate_hz, band
        self._units = list(dict.fromkeys(s.unit for s in info.signals))
        self._y = np.full((max(64, round(TAIL_S * info.rate_hz)), len(info.signals)), np.nan)
        self._planes: dict[str, plane.Plane] = {}
        self.pairs = self._orbits(places)

    def push(self, y: Array) -> None:
        """The next samples."""
        y = y[-len(self._y) :]
        self._y = np.concatenate([self._y[len(y) :], y])

    def skip(self, count: int) -> None:
        """Samples that will not come are NaN rows, not a shift."""
        if count > 0:
            self.push(np.full((min(count, len(self._y)), len(self._signals)), np.nan))

    def draw(self) -> None:
        """Spectra, scope and orbits as of the last sample, at the time set on the recording."""
        rate = self._rate
        found = spectrum(self._y, rate)
        last = self._y[-max(16, round(SCOPE_S * rate)) :]
        ms = np.arange(len(last)) / rate * 1e3
        for u, unit in enumerate(self._units):
            members = [k for k, s in enumerate(self._signals) if s.unit == unit]
            if found is not None:
                f, power = found[0], found[1][:, members]
                x = plane.Axis(float(f[0]), float(f[-1]), "frequency, Hz", log=True)
                y = self._log_axis(f"spectrum/{u}", power, f"({unit})²/Hz")
                frame = plane.Plane(x, y)
                self._draw(f"spectrum/{u}", frame, [(f, power[:, j], colour(k)) for j, k in enumerate(members)])
            if np.isfinite(last[:, members]).any():
                y = self._linear_axis(f"scope/{u}", last[:, members], unit)
                frame = plane.Plane(plane.Axis(0, float(ms[-1]), "time, ms"), y)
                self._draw(f"scope/{u}", frame, [(ms, last[:, k], colour(k)) for k in members])
        if np.isfinite(self._y).all():
            for b, (bearing, (i, j, kind)) in enumerate(self.pairs.items()):
                self._orbit(b, bearing, self._y[:, [i, j]], kind)

    def _orbit(self, b: int, bearing: str, y: Array, kind: str) -> None:
        rate = self._rate
        low, high = self._band
        q = displacement(y, kind, rate, (low, min(high, 0.45 * rate)))
        keep = slice(len(q) // 2, len(q) // 2 + max(16, round(ORBIT_S * rate)))
        q = q[keep] * 1e9
        side = self._linear_axis(f"orbit/{part(bearing)}", q, "y, nm")
        x = plane.Axis(side.low, side.high, "")
        self._draw(f"orbit/{part(bearing)}", plane.Plane(x, side, plane.HEIGHT_UNITS), [(q[:, 0], q[:, 1], colour(b))])

    def _log_axis(self, path: str, values: Array, label: str) -> plane.Axis:
        """Decades that hold the values, and those held before."""
        low, high = plane.decades(values)
        old = self._planes.get(path)
        if old is not None:
            high = max(high, old.y.high)
            low = max(min(low, old.y.low), high / 1e8)
        return plane.Axis(low, high, label, log=True)

    def _linear_axis(self, path: str, values: Array, label: str) -> plane.Axis:
        """A symmetric range that holds the values; kept while they fill more than a fifth of it."""
        peak = float(np.nanmax(np.abs(values))) or 1.0
        old = self._planes.get(path)
        high = old.y.high if old is not None else 0.0
        if peak > high or peak < 0.2 * high:
            high = plane.round_up(peak)
        return plane.Axis(-high, high, label)

    def _draw(self, path: str, frame: plane.Plane, series: Sequence[tuple[Array, Array, tuple[int, int, int]]]) -> None:
        if self._planes.get(path) != frame:
            self._planes[path] = frame
            for name, drawing in frame.frame():
                self._to.log(f"{path}/{name}", drawing)
        self._to.log(f"{path}/curves", plane.curves(frame, series))

    def _orbits(self, places: Places) -> dict[str, tuple[int, int, str]]:
        """Bearing -> columns of its x and y of the same kind."""
        found: dict[str, dict[str, tuple[int, str]]] = {}
        for k, signal in enumerate(self._signals):
            place, kind = places.get(signal.name, ("", ""))
            node, _, direction = place.partition(".")
            if kind in INTEGRATIONS_TO_DISPLACEMENT:
                found.setdefault(node, {}).setdefault(direction, (k, kind))
        return {
            node: (d["x"][0], d["y"][0], d["x"][1])
            for node, d in found.items()
            if "x" in d and "y" in d and d["x"][1] == d["y"][1]
        }
