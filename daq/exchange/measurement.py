"""A log, or a file that can be imported, as the array that the estimator takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.errors import LogError
from daq.rig.problems import did_you_mean
from daq.rig.rig import Rig

RATE_TOLERANCE = 2e-3


@dataclass(frozen=True, slots=True)
class Measurement:
    """y : (n, channels of the rig) SI, NaN where a sample is missing or clipped; facts : for the head of a report."""

    y: NDArray[np.float64]
    rate_hz: float
    facts: dict[str, str]


def measure(path: Path, rig: Rig, note: Callable[[str], None]) -> Measurement:
    """The rig's channels of a log (or of any file that `rotorscope import` reads).

    note : told what is left out and what differs from the rig file. Raises LogError: a channel is missing, the file
    cannot be read, or the band does not fit the rate.
    """
    if path.suffix.lower() == ".mcap" or not path.is_file():
        y, rate_hz = _of_log(path, rig, note)
    else:
        from .checks import checked
        from .formats import read

        record = checked(path, read(path, [c.name for c in rig.model.channels]), rig, None, note)
        return _measured(path, record.si(), record.rate_hz)
    expected = rig.acquisition.rate_hz if rig.acquisition else rate_hz
    if abs(rate_hz / expected - 1) > RATE_TOLERANCE:
        note(f"{path}: {rate_hz:g} Hz, where the rig file expects {expected:g} Hz; the log's rate is used")
    if rig.model.band[1] >= rate_hz / 2:
        text = f"band.high = {rig.model.band[1]:g} Hz of the rig is not below half its rate of {rate_hz:g} Hz"
        raise LogError(f"{path}: {text}; lower band.high")
    return _measured(path, y, rate_hz)


def _measured(path: Path, y: NDArray[np.float64], rate_hz: float) -> Measurement:
    return Measurement(y, rate_hz, {"log": path.name, "record": f"{len(y) / rate_hz:.4g} s at {rate_hz:g} Hz"})


def _of_log(path: Path, rig: Rig, note: Callable[[str], None]) -> tuple[NDArray[np.float64], float]:
    from daq.log.reader import read_log

    log = read_log(path)
    columns = []
    for c in rig.model.channels:
        if c.name not in log.channels:
            held = [name for name in log.channels if name not in rig.units] or list(log.channels)
            raise LogError(f'{path}: has no channel "{c.name}" of the rig; {did_you_mean(c.name, held, "it has")}')
        columns.append(log.channels.index(c.name))
    for k, i in enumerate(columns):
        unit = log.info.signals[i].unit
        if unit and unit != rig.si_units[k]:
            name = rig.model.channels[k].name
            raise LogError(f"{path}: {name} is in {unit} there, and a {rig.model.channels[k].kind} in the rig file")
    y, hits = log.unclipped(columns)
    if not len(y):
        raise LogError(f"{path}: holds no samples")
    if log.growing:
        note(f"{path}: is being written; what is there now is used, up to sample {log.stop - 1}")
    elif not log.complete:
        note(f"{path}: is not complete (rotorscope info says more); what is intact is used")
    if log.lost_samples:
        real = sum(1 for g in log.gaps if g.count)
        note(f"{path}: {log.lost_samples} samples are missing in {real} gaps; they are left out, not bridged")
    for other in log.others:
        note(f"{path}: {other} are left out")
    if hits.any():
        names = ", ".join(rig.model.channels[k].name for k in np.flatnonzero(hits))
        note(
            f"{path}: {hits.sum()} samples of {names} are at full scale; they are left out, and the loudest moments "
            "with them: damping comes out too high"
        )
    return y, log.rate_hz
