"""Spectra of the channels and of their squared envelopes, with marks at tones and defect frequencies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.model import MOTION_UNITS, Model, kinematics

from .layers import tone_name

Json = Mapping[str, Any]
Array = NDArray[np.float64]
Mark = tuple[float, str]  # Hz, label
MAX_SEGMENT = 1 << 17  # rows of a segment of an envelope: lines of a defect are narrow
MIN_SEGMENT = 256
MIN_AVERAGES = 8  # of a spectrum, where the record is long enough
MIN_AXIS_HZ = 1.0
MAX_POINTS = 1500  # drawn of a spectrum
MAX_MARKS = 12  # labels that can be read
ENVELOPE_HARMONICS = 3  # of the highest defect frequency that the envelope spectrum reaches
DEFAULT_REACH_HZ = 500.0  # of the envelope spectrum where no defect frequency is known
SHAFT_ORDERS_MARKED = 3
MAX_ORDER = 12.0  # of the order spectrum: harmonics of the shaft, and the first of the defects
HANN_NOISE_BINS = 1.5  # equivalent noise bandwidth of a Hann window: amplitude of a line from its PSD
MAX_SLICES, MAX_CELLS = 160, 220  # of a waterfall: times, frequencies
SLICE_HZ = 5.0  # resolution of a waterfall, where the record is long enough for it


def signal_spectra(model: Model, y: Array, rate_hz: float, diagnosis: Json) -> dict[str, Any]:
    """Spectra of the motion channels of a record, for the report.

    Parameters
    ----------
    model : Model
        The rig. Its channels, band and bearing geometry are used.
    y : (n, channels) float64
        Samples in SI units; NaN where one is missing.
    rate_hz : float
        Sampling rate, Hz.
    diagnosis : mapping
        A diagnosis as JSON: speed, tones and strike trains.

    Returns
    -------
    dict
        ``spectra`` and ``envelopes``: {channel: {frequency_hz, psd, unit, marks: [[Hz, label]]}}; an envelope has its
        `band_hz` too, a spectrum its `place`. ``orders``: {channel: {order, amplitude, unit, marks: [[order, label]]}},
        where the speed is known. ``waterfalls``: {channel: {time_s, frequency_hz, level_db, unit}}, a row a time, dB of
        the PSD; null where samples are missing. ``modes``, ``poles``: of the diagnosis. ``band``: of the model, Hz.
    """
    machine = diagnosis.get("machine") or {}
    strikes = machine.get("strikes", ())
    orders = defect_frequencies(model, machine)
    shaft = shaft_marks(machine)
    out: dict[str, Any] = {"spectra": {}, "envelopes": {}, "orders": {}, "waterfalls": {}}
    structure = diagnosis.get("structure") or {}
    out |= {"modes": structure.get("modes", ()), "poles": structure.get("poles", ()), "band": list(model.band)}
    for k, channel in enumerate(model.channels):
        pieces = finite_pieces(y[:, k]) if channel.kind in MOTION_UNITS else []
        if not pieces:
            continue
        f, psd = averaged_spectrum(halved(pieces), rate_hz)
        marks = [(t["frequency_hz"], tone_name(t)) for t in machine.get("tones", ()) if channel.name in t["amplitude"]]
        seen = (f > 0) & (f >= min(MIN_AXIS_HZ, 0.1 * model.band[0]))
        f, psd = thinned(f[seen], psd[seen], [hz for hz, _ in marks])
        own = {"frequency_hz": f.tolist(), "psd": psd.tolist(), "unit": MOTION_UNITS[channel.kind]}
        named = {label for _, label in marks}
        own["marks"] = readable([*(mark for mark in shaft if mark[1] not in named), *marks])
        out["spectra"][channel.name] = own | {"place": channel.place}
        unit = MOTION_UNITS[channel.kind]
        if shaft:
            out["orders"][channel.name] = order_spectrum(pieces, rate_hz, shaft[0][0], orders) | {"unit": unit}
        if (fall := waterfall(y[:, k], rate_hz)) is not None:
            out["waterfalls"][channel.name] = fall | {"unit": unit}
        band = next((t["band_hz"] for t in strikes if t["channel"] == channel.name and "band_hz" in t), model.band)
        reach = max([ENVELOPE_HARMONICS * hz for hz, _ in orders], default=DEFAULT_REACH_HZ)
        envelope = [squared_envelope(piece, rate_hz, band) for piece in pieces]
        f, psd = averaged_spectrum(envelope, rate_hz)
        inside = (f > 0) & (f <= min(reach * 1.1, rate_hz / 2))
        if inside.any():
            own = {"frequency_hz": f[inside].tolist(), "psd": psd[inside].tolist(), "band_hz": list(band), "unit": unit}
            out["envelopes"][channel.name] = own | {"marks": [list(mark) for mark in (*shaft[:1], *orders)]}
    return out


def defect_frequencies(model: Model, machine: Json) -> list[Mark]:
    """Kinematic frequencies of the bearing in Hz with their names, at the speed of the record."""
    speed = machine.get("speed_rpm")
    if model.bearing is None or not speed:
        return []
    return [(order * speed["value"] / 60.0, name) for name, order in kinematics(model.bearing).items()]


def shaft_marks(machine: Json) -> list[Mark]:
    """The first orders of the shaft in Hz with their names; none where the speed is not known."""
    speed = machine.get("speed_rpm")
    return [(k * speed["value"] / 60.0, f"{k}X") for k in range(1, SHAFT_ORDERS_MARKED + 1)] if speed else []


def order_spectrum(pieces: Sequence[Array], rate_hz: float, shaft_hz: float, defects: Sequence[Mark]) -> dict[str, Any]:
    """Amplitude of lines against the order of the shaft, at its mean speed.

    pieces : of a channel, of one length. defects : frequencies of the bearing in Hz with their names.
    """
    f, psd = averaged_spectrum(pieces, rate_hz)
    inside = (f > 0) & (f <= min(MAX_ORDER * shaft_hz, 0.5 * rate_hz))
    amplitude = np.sqrt(2.0 * HANN_NOISE_BINS * psd[inside] * f[1])
    marks = [(float(k), f"{k}X") for k in range(1, SHAFT_ORDERS_MARKED + 1)]
    marks += [(hz / shaft_hz, name) for hz, name in defects]
    order, amplitude = thinned(f[inside] / shaft_hz, amplitude, [at for at, _ in marks], np.linspace)
    return {"order": order.tolist(), "amplitude": amplitude.tolist(), "marks": [list(mark) for mark in sorted(marks)]}


def waterfall(y: Array, rate_hz: float) -> dict[str, Any] | None:
    """Level of a channel (n,) against time and frequency, dB of its PSD; None of a record shorter than two slices."""
    rows = min(int(rate_hz / SLICE_HZ), len(y) // 8)
    if rows < MIN_SEGMENT:
        return None
    starts = np.unique(np.linspace(0, len(y) - rows, min(MAX_SLICES, len(y) // rows)).astype(int))
    f = np.fft.rfftfreq(rows, 1.0 / rate_hz)
    edges = np.unique(np.searchsorted(f, np.geomspace(f[1], f[-1] * (1 + 1e-9), MAX_CELLS + 1)))
    window = np.hanning(rows + 1)[:-1]
    scale = 2.0 / (rate_hz * np.sum(window**2))
    level = []
    for at in starts:
        piece = np.asarray(y[at : at + rows], np.float64)
        power = scale * np.abs(np.fft.rfft((piece - piece.mean()) * window)) ** 2
        cells = np.maximum.reduceat(power, edges[:-1])
        level.append(
            [None] * cells.size if not np.isfinite(cells).all() else (10.0 * np.log10(cells + 1e-300)).tolist()
        )
    times = (starts + 0.5 * rows) / rate_hz
    return {"time_s": times.tolist(), "frequency_hz": f[edges[:-1]].tolist(), "level_db": level}


def finite_pieces(y: Array) -> list[Array]:
    """Gap-free pieces of a channel of one length, without their mean: the longest such, or many short ones alike."""
    edges = np.flatnonzero(np.diff(np.r_[False, np.isfinite(y), False]))
    spans = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
    longest = max((stop - first for first, stop in spans), default=0)
    size = min(longest, MAX_SEGMENT)
    if size < MIN_SEGMENT:
        return []
    starts = [at for first, stop in spans for at in range(first, stop - size + 1, size)]
    return [y[at : at + size] - np.mean(y[at : at + size]) for at in starts]


def halved(pieces: Sequence[Array]) -> Sequence[Array]:
    """Pieces cut in halves until there are enough to average, but not shorter than 8192 rows."""
    while len(pieces) < MIN_AVERAGES and len(pieces[0]) >= 2 * 8192:
        half = len(pieces[0]) // 2
        pieces = [part for piece in pieces for part in (piece[:half], piece[half : 2 * half])]
    return pieces


def averaged_spectrum(pieces: Sequence[Array], rate_hz: float) -> tuple[Array, Array]:
    """Frequencies and mean one-sided PSD of pieces of one length, Hann window."""
    window = np.hanning(len(pieces[0]) + 1)[:-1]
    total = np.zeros(len(window) // 2 + 1)
    for piece in pieces:
        total += np.abs(np.fft.rfft((piece - piece.mean()) * window)) ** 2
    scale = 2.0 / (rate_hz * np.sum(window**2) * len(pieces))
    return np.asarray(np.fft.rfftfreq(len(window), 1.0 / rate_hz)), total * scale


def squared_envelope(piece: Array, rate_hz: float, band_hz: Sequence[float]) -> Array:
    """Squared magnitude of the analytic signal in a band."""
    spectrum = np.fft.fft(piece)
    f = np.fft.fftfreq(len(piece), 1.0 / rate_hz)
    spectrum[(f < band_hz[0]) | (f > band_hz[1])] = 0.0
    return np.asarray(np.abs(2.0 * np.fft.ifft(spectrum)) ** 2)


def thinned(
    f: Array, psd: Array, keep: Sequence[float], spaced: Callable[..., Array] = np.geomspace
) -> tuple[Array, Array]:
    """A spectrum with fewer points: of each cell the largest value, so that no line is lost.

    spaced : edges of the cells; they are spaced as the axis is, a logarithmic one.
    """
    if f.size <= MAX_POINTS:
        return f, psd
    edges = np.unique(np.searchsorted(f, spaced(f[0], f[-1] * (1 + 1e-9), MAX_POINTS + 1)))
    tops = [first + int(np.argmax(psd[first:stop])) for first, stop in zip(edges[:-1], edges[1:], strict=True)]
    at = np.unique([*tops, *(int(np.argmin(np.abs(f - hz))) for hz in keep)])
    return f[at], psd[at]


def readable(marks: Sequence[Mark]) -> list[list[Any]]:
    """The first marks, as many as are readable, in the order of frequency."""
    return [list(mark) for mark in sorted(marks[:MAX_MARKS])]
