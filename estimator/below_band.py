"""The displacement below the band where the sensor is one of displacement: what it measures there, its laws may see.

The band ends where the balance of forces is no longer used, but a law sees the whole displacement. What is left out is
taken for Gaussian and independent of the rest (columns.py). It is not quite: the slow part of the law's own force makes
some of it, and it turns the tangent that the rest moves along. With 10 Hz left out below a resonance of 50 Hz kNL of a
strong cubic comes out 0.4 % too small. An accelerometer sees nothing there; a displacement sensor does, down to where
its offset and drift begin.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .balance import motion_channels
from .bandlimit import left_out, passband
from .features import NEAREST
from .linear_memory import filtered
from .record import Record
from .start import Start

Floats = NDArray[np.float64]
DRIFT = 0.05  # of the lower band edge: below lie offset and drift of a sensor; the filter is as long as the band's


def seen_below(record: Record, start: Start, y: Floats) -> tuple[Record, Start]:
    """The record with the slow displacement, and the start with what is then left out; y : (n, channels) rows in SI.

    Both as they are where no sensor is one of displacement.
    """
    model, rate_hz, band = record.model, record.rate_hz, record.model.band
    own = {i: c for i, c in enumerate(motion_channels(model)) if model.channels[c].kind == "displacement"}
    if not own:
        return record, start

    def part(f_hz: Floats) -> Floats:
        slow = -np.expm1(-0.5 * (f_hz / (DRIFT * band[0])) ** 2)
        return np.where(f_hz < band[0], (1.0 - passband(f_hz, rate_hz, band)) * slow, 0.0)

    slow, widths = np.zeros((len(model.places), len(y))), start.widths.copy()
    fewer = left_out(start.m, start.c, start.kL, start.S, band, rate_hz, part)
    rows = np.arange(len(y))
    for i, channel in own.items():
        x = y[:, channel]
        there = np.isfinite(x)
        x = x - x[there].mean() if there.all() else np.interp(rows, rows[there], x[there] - x[there].mean())
        slow[i] = filtered(lambda w: part(w / (2 * np.pi)).astype(complex), x, rate_hz)
        widths[i, 0] = max(fewer[i, 0], NEAREST * record.scales[i, 0])
    return replace(record, slow=slow), replace(start, widths=widths)
