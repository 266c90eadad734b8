"""Shaft angle from a tacho channel (one pulse a turn, its rising edge at angle 0), or from the speed of the rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.model.rig import Model

from .thresholds import LIMITS


class ShaftAngle:
    """Shaft angle of a stream: `push` rows, `drop` old rows, ask for the `angle` along rows that are held."""

    def __init__(self, model: Model, rate_hz: float) -> None:
        self._column = model.tacho
        self._rate_hz = rate_hz
        self._given = 2.0 * np.pi * (model.speed_rpm or 0.0) / 60.0 / rate_hz  # rad a row
        self._first = 0
        self._pulses: list[Array] = []
        self._known = (0, 0.0)  # a row and its angle: the next window goes on from there

    def push(self, block: Array) -> None:
        """The next rows (n, channels of the model), NaN where missing."""
        if self._column is not None:
            self._pulses.append(block[:, self._column].copy())

    def drop(self, before: int) -> None:
        """Forget rows under `before`."""
        while self._pulses and self._first + len(self._pulses[0]) <= before:
            self._first += len(self._pulses.pop(0))

    def angle(self, start: int, stop: int) -> Array | None:
        """(stop - start,) rad along rows that are held; None while the tacho gives no speed."""
        if self._column is None:
            return np.asarray(self._given * np.arange(start, stop), dtype=np.float64)
        pulses = np.concatenate(self._pulses) if self._pulses else np.empty(0)
        try:
            angle = shaft_angle(pulses, self._rate_hz)
        except DataError:
            return None
        row, known = self._known
        if self._first <= row < self._first + angle.size:  # turns are counted through from window to window
            angle += 2.0 * np.pi * np.rint((known - angle[row - self._first]) / (2.0 * np.pi))
        out = angle[start - self._first : stop - self._first]
        self._known = (stop - 1, float(out[-1]))
        return out


def measured_phase(model: Model, y: Array, rate_hz: float) -> Array | None:
    """Shaft angle along a record, from its tacho channel.

    Parameters
    ----------
    model : Model
        The rig; ``model.tacho`` is the column of the tacho channel.
    y : (n, channels) float64
        Samples, columns in the order of ``model.channels``.
    rate_hz : float
        Sampling rate, Hz.

    Returns
    -------
    (n,) float64 or None
        Shaft angle, rad; None without a tacho channel.

    Raises
    ------
    DataError
        The tacho channel has fewer than four pulses.
    """
    column = model.tacho
    return None if column is None else shaft_angle(y[:, column], rate_hz, model.channels[column].name)


def with_measured_speed(model: Model, y: Array, rate_hz: float) -> Model:
    """The model with the mean speed that its tacho measured along y (n, channels). Raises DataError."""
    phase = measured_phase(model, y, rate_hz)
    if phase is None or len(phase) < 2:
        return model
    turns = float(phase[-1] - phase[0]) / (2 * np.pi)
    return replace(model, speed_rpm=60.0 * turns * rate_hz / (len(phase) - 1))


def shaft_angle(pulses: Array, rate_hz: float, name: str = "tacho") -> Array:
    """Shaft angle (n,) rad, rising through a multiple of 2 pi at each pulse.

    It is a cubic spline between pulses, and goes on at the last known speed beyond them. It begins within half a turn
    of 0: the phase of a fractional order depends on which pulse is 0.

    The spline matters at high orders: linear interpolation lags by up to alpha T^2 / 8 within a turn of period T under
    an angular acceleration alpha.

    pulses : (n,) any height and width, NaN where a sample is missing. Raises DataError with fewer than four pulses.
    """
    edges = rising_edges(pulses)
    if edges.size >= LIMITS.min_pulses:
        edges = edges[np.concatenate([[True], np.diff(edges) > LIMITS.short_over_period * np.median(np.diff(edges))])]
    if edges.size < LIMITS.min_pulses:
        raise DataError(
            f"channel {name}: {edges.size} tacho pulses; at least {LIMITS.min_pulses} are needed, one a turn"
        )
    distance = np.diff(edges)
    period = _usual(distance)
    turns = np.where(distance > LIMITS.long_over_period * period, np.rint(distance / period), 1.0)
    angle = np.concatenate([[0.0], np.cumsum(turns)])
    n = np.arange(len(pulses), dtype=np.float64)
    out = _between(edges, angle, n)
    first, last = turns[0] / distance[0], turns[-1] / distance[-1]
    out = np.where(n < edges[0], (n - edges[0]) * first, out)
    out = np.where(n > edges[-1], angle[-1] + (n - edges[-1]) * last, out)
    return np.asarray(2 * np.pi * (out - np.rint(out[0])))


def _between(edges: Array, angle: Array, n: Array) -> Array:
    """(n,) turns at rows n; linear if the pulses are so uneven that a spline would turn back."""
    from scipy.interpolate import CubicSpline

    inner = np.clip(n, edges[0], edges[-1])
    smooth = CubicSpline(edges, angle)(inner)
    return np.asarray(smooth if np.all(np.diff(smooth) >= 0.0) else np.interp(inner, edges, angle))


def rising_edges(pulses: Array) -> Array:
    """(k,) fractional rows at which the signal rises through its middle."""
    there = np.flatnonzero(np.isfinite(pulses))
    if there.size < 2:
        return np.empty(0)
    y = pulses[there]
    low, high = float(y.min()), float(y.max())
    if high <= low:
        return np.empty(0)
    middle = 0.5 * (low + high)
    armed = middle - LIMITS.hysteresis_over_height * (high - low)
    state = np.where(y >= middle, 1, np.where(y < armed, -1, 0))  # 0: keeps what it was
    last = np.maximum.accumulate(np.where(state != 0, np.arange(y.size), 0))
    state = state[last]
    rise = np.flatnonzero((state[1:] == 1) & (state[:-1] != 1)) + 1
    rise = rise[there[rise] - there[rise - 1] == 1]  # an edge inside a gap has no place
    before, after = y[rise - 1], y[rise]
    step = after - before
    return np.asarray(there[rise] - np.where(step > 0, (after - middle) / np.where(step > 0, step, 1.0), 0.0))


def _usual(distance: Array, around: int = 9) -> Array:
    """(k,) running median of the distances: the local length of a turn, also while the speed changes."""
    half = around // 2
    padded = np.pad(distance, half, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, around), axis=1))
