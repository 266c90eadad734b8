"""The record layer: whether a record is fit to be judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.arrays import LONG_RECORD_BYTES, Array, real_samples, true_runs
from estimator.model.rig import Channel, Model
from estimator.parallel import map_threads

from .channel_faults import ChannelRecord, find_channel_faults
from .channel_pairs import find_pair_faults
from .channel_summary import longest_run, moments, usable_hz
from .findings import STILL_CODES, ChannelSummary, RecordFinding, RecordSurvey
from .thresholds import RECORD_LIMITS


def survey_record(model: Model, y: Array, rate_hz: float) -> RecordSurvey:
    """Level of every channel of a record, and what makes the record unfit to be judged.

    Parameters
    ----------
    model : Model
        The rig; its channels name the columns.
    y : (n, channels) float64 or float32
        Samples in SI units (tacho: any); NaN where a sample is missing. Any length.
    rate_hz : float
        Sampling rate, Hz.

    Returns
    -------
    RecordSurvey
        Summaries, findings, and the channels that no later layer may use. Nothing is raised; an array that is no record
        of this rig has no summary.

    References
    ----------
    Bendat and Piersol, Random Data, 4th ed., Wiley 2010, ch. 10 (data qualification); ISO 20816-1.
    """
    y = real_samples(y)
    if y.ndim != 2 or y.shape[1] != len(model.channels) or not (np.isfinite(rate_hz) and rate_hz > 0.0):
        return RecordSurvey()  # no record of this rig: said by what uses it
    reach_hz = usable_hz(model.anti_alias, rate_hz)

    def surveyed(k: int) -> tuple[ChannelRecord, ChannelSummary, list[RecordFinding]]:
        return _surveyed(model.channels[k], y[:, k], rate_hz, reach_hz)

    columns = range(y.shape[1])
    each = map_threads(surveyed, columns) if y.nbytes <= LONG_RECORD_BYTES else [surveyed(k) for k in columns]
    records, found = [record for record, _, _ in each], [finding for _, _, own in each for finding in own]
    still = {name for finding in found if finding.code in STILL_CODES for name in finding.channels}
    found += find_pair_faults([r for r in records if r.channel.name not in still], model.band)
    found += _missing(model.channels, y, rate_hz, still)
    return RecordSurvey(
        channels={record.channel.name: summary for record, summary, _ in each},
        findings=tuple(found),
        unusable=frozenset(name for finding in found for name in finding.unusable),
    )


def _surveyed(
    channel: Channel, y: Array, rate_hz: float, reach_hz: float
) -> tuple[ChannelRecord, ChannelSummary, list[RecordFinding]]:
    """One channel (n,), its summary, and its faults. reach_hz : up to which a level is known."""
    z = np.ascontiguousarray(y)  # read more than ten times
    own, largest, absurd = moments(z), RECORD_LIMITS.max_value_si, 0
    if max(own.high, -own.low) > largest or own.count + np.count_nonzero(np.isnan(z)) < len(z):
        wrong = np.abs(z) > largest
        absurd = int(np.count_nonzero(wrong & np.isfinite(z)))
        z = np.where(wrong, np.nan, z)
        own = moments(z)
    one = ChannelRecord(channel=channel, y=z, rate_hz=rate_hz, moments=own, reach_hz=reach_hz)
    found = find_channel_faults(one, absurd)
    return (one if absurd else replace(one, y=y)), one.summary, found


def _missing(channels: tuple[Channel, ...], y: Array, rate_hz: float, still: set[str]) -> list[RecordFinding]:
    """Findings on missing samples, of one channel and of all. Joined short records have few missing between them."""
    moving = [k for k, channel in enumerate(channels) if channel.name not in still]
    if not moving or not len(y):
        return []
    any_there, counts = np.zeros(len(y), bool), []
    for k in moving:
        there = np.isfinite(y[:, k])
        counts.append(int(np.count_nonzero(there)))
        any_there |= there
    total = int(np.count_nonzero(any_there))
    out = []
    for k, count in zip(moving, counts, strict=True):
        share = 1.0 - count / total if total else 0.0
        if share > RECORD_LIMITS.max_missing_share:
            name = channels[k].name
            text = f"{name} lacks {100 * share:.2g} % of the samples that other channels have: check its link"
            out.append(RecordFinding(code="missing_samples", channels=(name,), text=text, places=(channels[k].place,)))
    spans = true_runs(any_there)
    share = 1.0 - float(np.mean(any_there))
    if share > RECORD_LIMITS.max_missing_rows_share and len(spans) > 1:
        longest = longest_run(any_there)
        text = (
            f"{100 * share:.2g} % of the rows are missing in {len(spans) - 1} gaps; the longest stretch without one "
            f"has {longest / rate_hz:.3g} s: rotorscope info says why samples were lost"
        )
        out.append(RecordFinding(code="gaps", channels=tuple(channels[k].name for k in moving), text=text))
    return out
