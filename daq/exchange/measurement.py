"""A log, or a file that can be imported, as the array that the estimator takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.part import WHOLE_RECORD, Part
from daq.rig.rig import Rig

if TYPE_CHECKING:
    from daq.log.reader import Recording

MAX_DOUBLE_VALUES = 1 << 24  # samples of all channels that are held in double precision, 128 MiB


@dataclass(frozen=True, slots=True)
class Measurement:
    """A record of the rig's channels.

    y : (n, channels of the rig) SI, float64, or float32 of more than MAX_DOUBLE_VALUES samples; NaN where a sample is
    missing or at full scale.
    rate_hz : sampling rate, Hz.
    facts : heading -> text, for the head of a report.
    started : time of the first row, UTC; None where the file does not state it.
    from_s : of a part, where it begins in the record; None of a whole record.
    full_scale : channel -> how many of its samples are at full scale and NaN.
    """

    y: NDArray[np.float64]
    rate_hz: float
    facts: dict[str, str]
    started: datetime | None = None
    _: KW_ONLY
    from_s: float | None = None
    full_scale: Mapping[str, int] = field(default_factory=dict)


def measure(
    path: Path, rig: Rig, note: Callable[[str], None], part: Part = WHOLE_RECORD,
    afford: Callable[[int], None] | None = None,
) -> Measurement:  # fmt: skip
    """The record of the rig's channels in a log, or in any file that `rotorscope import` reads; a part of it in time.

    note : called with one line for everything that is left out or differs from the rig file. afford : called with the
    number of samples of all channels, before those of a log are read; what it raises is raised.
    Raises LogError: a channel is missing, the file cannot be read, or the band does not fit the rate; ConfigError:
    nothing lies in the part.
    """
    if path.suffix.lower() == ".mcap" or not path.is_file():
        from daq.log.reader import read_log
        from daq.log.rig_samples import rig_samples

        log = read_log(path, part=replace(part, channels=()))
        if afford is not None:
            afford((log.stop - log.first) * len(rig.model.channels))
        y, full_scale = rig_samples(log, rig, note, _dtype(log, rig))
        started, rate_hz, from_s = log.started, log.rate_hz, log.from_s
    else:
        from .checks import load

        record = load(path, rig, None, note, part=part)
        if afford is not None:
            afford(sum(map(len, record.values)))
        started = None if record.started_ns is None else datetime.fromtimestamp(record.started_ns // 1000 / 1e6, UTC)
        y, rate_hz, from_s, full_scale = record.si(), record.rate_hz, record.from_s, {}
    facts = {"log": path.name, "record": f"{len(y) / rate_hz:.4g} s at {rate_hz:g} Hz"}
    if from_s is not None:
        facts["record"] += f", from {from_s:.6g} s on"
        note(f"{path}: {len(y) / rate_hz:.6g} s from {from_s:.6g} s on are read; times that are said count from there")
    if started is not None:
        facts["started"] = f"{started:%Y-%m-%d %H:%M:%S} UTC"
    return Measurement(y, rate_hz, facts, started, from_s=from_s, full_scale=full_scale)


def _dtype(log: Recording, rig: Rig) -> type[np.float64] | type[np.float32]:
    """Of the samples of a log: a long record is held in single precision."""
    values = (log.stop - log.first) * len(rig.model.channels)
    return np.float32 if values > MAX_DOUBLE_VALUES else np.float64


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
