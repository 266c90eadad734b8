"""What a vibration analyst looks at first: spectra of the channels and of their squared envelopes, with marks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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


def signal_spectra(model: Model, y: Array, rate_hz: float, diagnosis: Json) -> dict[str, Any]:
    """Spectra of the motion channels of a record, for the report.

    Parameters
    ----------
    model : Model
        The rig; of it are used the channels, the band and the geometry of the bearing.
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
        `band_hz` too, a spectrum its `place`. ``modes``, ``poles``: those of the diagnosis. ``band``: of the model, Hz.
    """
    machine = diagnosis.get("machine") or {}
    strikes = machine.get("strikes", ())
    orders = defect_frequencies(model, machine)
    out: dict[str, Any] = {"spectra": {}, "envelopes": {}}
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
        out["spectra"][channel.name] = own | {"marks": readable(marks), "place": channel.place}
        band = next((t["band_hz"] for t in strikes if t["channel"] == channel.name and "band_hz" in t), model.band)
        reach = max([ENVELOPE_HARMONICS * hz for hz, _ in orders], default=DEFAULT_REACH_HZ)
        envelope = [squared_envelope(piece, rate_hz, band) for piece in pieces]
        f, psd = averaged_spectrum(envelope, rate_hz)
        inside = (f > 0) & (f <= min(reach * 1.1, rate_hz / 2))
        if inside.any():
            own = {"frequency_hz": f[inside].tolist(), "psd": psd[inside].tolist(), "band_hz": list(band)}
            out["envelopes"][channel.name] = own | {"marks": [list(mark) for mark in orders]}
    return out


def defect_frequencies(model: Model, machine: Json) -> list[Mark]:
    """Kinematic frequencies of the bearing in Hz with their names, at the speed of the record."""
    speed = machine.get("speed_rpm")
    if model.bearing is None or not speed:
        return []
    return [(order * speed["value"] / 60.0, name) for name, order in kinematics(model.bearing).items()]


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


def thinned(f: Array, psd: Array, keep: Sequence[float]) -> tuple[Array, Array]:
    """A spectrum with fewer points on a logarithmic axis: of each cell the largest value, so that no line is lost."""
    if f.size <= MAX_POINTS:
        return f, psd
    edges = np.unique(np.searchsorted(f, np.geomspace(f[0], f[-1] * (1 + 1e-9), MAX_POINTS + 1)))
    tops = [first + int(np.argmax(psd[first:stop])) for first, stop in zip(edges[:-1], edges[1:], strict=True)]
    at = np.unique([*tops, *(int(np.argmin(np.abs(f - hz))) for hz in keep)])
    return f[at], psd[at]


def readable(marks: Sequence[Mark]) -> list[list[Any]]:
    """As many labels as can be read, the first ones first, in the order of frequency."""
    return [list(mark) for mark in sorted(marks[:MAX_MARKS])]
