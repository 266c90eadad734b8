"""A log, or a file that can be imported, as the array that the estimator takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.rig.rig import Rig


@dataclass(frozen=True, slots=True)
class Measurement:
    """A record of the rig's channels.

    y : (n, channels of the rig) float64, SI; NaN where a sample is missing or at full scale.
    rate_hz : sampling rate, Hz.
    facts : heading -> text, for the head of a report.
    started : time of the first row, UTC; None where the file does not state it.
    """

    y: NDArray[np.float64]
    rate_hz: float
    facts: dict[str, str]
    started: datetime | None = None


def measure(path: Path, rig: Rig, note: Callable[[str], None]) -> Measurement:
    """The record of the rig's channels in a log, or in any file that `rotorscope import` reads.

    note : called with one line for everything that is left out or differs from the rig file.
    Raises LogError: a channel is missing, the file cannot be read, or the band does not fit the rate.
    """
    if path.suffix.lower() == ".mcap" or not path.is_file():
        from daq.log.reader import read_log

        log = read_log(path)
        return _measured(path, log.samples(rig, note), log.rate_hz, log.started)
    from .checks import load

    record = load(path, rig, None, note)
    started = None if record.started_ns is None else datetime.fromtimestamp(record.started_ns // 1000 / 1e6, UTC)
    return _measured(path, record.si(), record.rate_hz, started)


def _measured(path: Path, y: NDArray[np.float64], rate_hz: float, started: datetime | None = None) -> Measurement:
    facts = {"log": path.name, "record": f"{len(y) / rate_hz:.4g} s at {rate_hz:g} Hz"}
    if started is not None:
        facts["started"] = f"{started:%Y-%m-%d %H:%M:%S} UTC"
    return Measurement(y, rate_hz, facts, started)


def findings(y: NDArray[np.float64], rate_hz: float, rig: Rig, most_values: int) -> list[tuple[str, str]]:
    """Code and text of what makes a record of the rig's channels unfit to be judged: copies, still or clipped channels.

    most_values : samples of all channels; of a longer record only the beginning is looked at, and that is said.
    """
    from estimator.identification.record import survey_record

    rows = max(2, most_values // max(1, y.shape[1]))
    out = [(f.code, f.text) for f in survey_record(rig.model, y[:rows], rate_hz).findings]
    if len(y) > rows and out:
        out = [(code, f"{text} (of the first {rows / rate_hz:.4g} s)") for code, text in out]
    return out
