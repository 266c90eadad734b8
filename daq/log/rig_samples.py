"""The samples of a log in the channels of a rig: the array that the estimator takes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.errors import LogError

if TYPE_CHECKING:
    from daq.rig.rig import Rig

    from .reader import Recording

RATE_TOLERANCE_REL = 2e-3  # between the rate of a log and that of a rig file, before a note says so


def rig_samples(
    log: Recording,
    rig: Rig,
    note: Callable[[str], None],
    dtype: type[np.float64] | type[np.float32] = np.float64,
) -> tuple[NDArray[np.float64], dict[str, int]]:
    """(n, channels of the rig) in SI, NaN where a sample is missing or at full scale; see `Recording.samples`.

    And how many samples of each channel are at full scale.
    """
    columns = _columns(log, rig)
    y, clipped = log.unclipped(columns, dtype)
    if not len(y):
        raise LogError(f"{log.path}: holds no samples")
    for text in _doubts(log):
        note(text)
    if clipped.any():
        names = ", ".join(rig.model.channels[k].name for k in np.flatnonzero(clipped))
        note(
            f"{log.path}: {clipped.sum()} samples of {names} are at full scale and are left out; "
            "as the loudest moments are missing, damping is estimated too high"
        )
    expected_hz = rig.acquisition.rate_hz if rig.acquisition else log.rate_hz
    if abs(log.rate_hz / expected_hz - 1) > RATE_TOLERANCE_REL:
        note(f"{log.path}: {log.rate_hz:g} Hz, where the rig file expects {expected_hz:g} Hz; the log's rate is used")
    if rig.model.band[1] >= log.rate_hz / 2:
        half_hz = log.rate_hz / 2
        text = f"band.high = {rig.model.band[1]:g} Hz of the rig is not below {half_hz:g} Hz, half the sampling rate"
        raise LogError(f"{log.path}: {text}; lower band.high")
    return y, {c.name: int(n) for c, n in zip(rig.model.channels, clipped, strict=True) if n}


def _columns(log: Recording, rig: Rig) -> list[int]:
    """The signal of the log that is each channel of the rig, by name; its unit has to be that of the rig's channel."""
    columns = []
    for channel, si_unit in zip(rig.model.channels, rig.si_units, strict=True):
        if channel.name not in log.channels:
            from daq.rig.problems import did_you_mean  # loads pydantic

            held = [name for name in log.channels if name not in rig.units] or list(log.channels)
            remedy = did_you_mean(channel.name, held, "it has")
            raise LogError(f'{log.path}: has no channel "{channel.name}" of the rig; {remedy}')
        columns.append(log.channels.index(channel.name))
        unit = log.info.signals[columns[-1]].unit
        if unit and unit != si_unit:
            text = f"{channel.name} is in {unit} there, and a {channel.kind} in the rig file"
            raise LogError(f"{log.path}: {text}; correct kind or unit of the channel")
    return columns


def _doubts(log: Recording) -> list[str]:
    """Facts of the log that a reader of its samples needs."""
    doubts = []
    if log.growing:
        doubts.append(f"{log.path}: is being written; used is what it holds now, up to sample {log.stop - 1}")
    elif not log.complete:
        doubts.append(f"{log.path}: is not complete (rotorscope info says more); what is intact is used")
    if log.lost_samples:
        holes = sum(1 for gap in log.gaps if gap.count)
        text = f"{log.lost_samples} samples are missing in {holes} gaps; they are left out, not bridged"
        doubts.append(f"{log.path}: {text}")
    return doubts + [f"{log.path}: {other} are left out" for other in log.others]
