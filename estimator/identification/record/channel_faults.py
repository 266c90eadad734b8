"""Faults that one channel shows by itself: dead, frozen, clipped, coarse, with spikes, offset, or in a wrong unit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.constants import g
from scipy.special import ndtri

from estimator.arrays import Array, true_runs
from estimator.model.rig import MOTION_UNITS, Channel

from .channel_summary import Moments, finite_pieces, longest_stretch, power_spectrum, summarise
from .clipping import clipping_level
from .findings import CLIPPED_CODE, SPIKES_CODE, STILL_CODES, ChannelSummary, RecordFinding
from .spikes import robust_scale, spike_rows
from .thresholds import RECORD_LIMITS


@dataclass(frozen=True, kw_only=True)
class ChannelRecord:
    """The samples of one channel, and what several checks need of them.

    Parameters
    ----------
    channel : Channel
        The channel.
    y : (n,) float64 or float32
        Samples in SI units; NaN where one is missing.
    rate_hz : float
        Sampling rate, Hz.
    moments : Moments
        Of the finite samples.
    reach_hz : float
        Frequency up to which a level is known, Hz.
    """

    channel: Channel
    y: Array
    rate_hz: float
    moments: Moments
    reach_hz: float

    @cached_property
    def summary(self) -> ChannelSummary:
        """The summary of the channel for the user."""
        return summarise(self.y, self.channel.kind, self.rate_hz, self.reach_hz, self.moments)

    @cached_property
    def robust(self) -> tuple[float, float]:
        """Median, and standard deviation of a Gaussian signal with the median absolute deviation of the channel."""
        return robust_scale(self.y)

    def finding(
        self, code: str, text: str, rows: tuple[tuple[int, int], ...] = (), usable: bool = True, judged: bool = True
    ) -> RecordFinding:
        """A finding on this channel.

        text : what follows its name. usable : whether later layers may use the channel. judged : whether a bearing may
        be judged from it; from an unusable one it may not.
        """
        name = self.channel.name
        return RecordFinding(
            code=code,
            channels=(name,),
            text=f"{name} {text}",
            rows=rows,
            places=(self.channel.place,),
            condemned=() if usable and judged else (name,),
            unusable=() if usable else (name,),
        )


def find_channel_faults(record: ChannelRecord, absurd: int = 0) -> list[RecordFinding]:
    """Findings on one channel. A dead, frozen or coarse channel has no other finding.

    Parameters
    ----------
    record : ChannelRecord
        The channel.
    absurd : int
        Number of samples that were left out because no sensor has such values.
    """
    found = []
    if absurd:
        found.append(
            record.finding(
                "absurd_values",
                f"has {absurd} samples beyond {RECORD_LIMITS.max_value_si:g} {record.channel.unit}, which are left "
                "out: check its unit, its scale and its byte order",
                usable=absurd < 0.01 * (absurd + record.moments.count),
            )
        )
    if (dead := _dead(record)) is not None:
        return [*found, dead]
    if record.channel.kind == "tacho":
        return []
    for check in _MOTION_CHECKS if record.channel.kind in MOTION_UNITS else _FORCE_CHECKS:
        if (fault := check(record)) is not None:
            found.append(fault)
            if fault.code in STILL_CODES:
                break
    return found


def _dead(record: ChannelRecord) -> RecordFinding | None:
    """A channel without samples, or with a single value."""
    if record.moments.count < 2:
        return record.finding(
            "empty_channel", "has no valid samples: check its cable and its signal in the rig file", usable=False
        )
    low, high = record.moments.low, record.moments.high
    if low < high:
        return None
    what = "is zero throughout" if low == 0.0 else f"is constant at {low:g} {record.channel.unit} throughout"
    return record.finding("dead_channel", f"{what}: check the sensor, its supply and its cable", usable=False)


def _frozen(record: ChannelRecord) -> RecordFinding | None:
    """Stretches in which the channel stands still much longer than its usual motion allows."""
    y = record.y
    runs = true_runs(y[1:] == y[:-1]) + [0, 1]
    runs = runs[runs[:, 1] - runs[:, 0] >= RECORD_LIMITS.min_frozen_samples]
    if not runs.size:
        return None
    up = int(np.count_nonzero((y[1:] > record.robust[0]) & (y[:-1] <= record.robust[0])))
    moving = record.moments.count - int(np.diff(runs).sum())
    period = max(moving, 1) / max(up, 1)
    frozen = [(a, b) for a, b in runs.tolist() if b - a >= RECORD_LIMITS.min_frozen_periods * period]
    if not frozen:
        return None
    share = sum(b - a for a, b in frozen) / record.moments.count
    a, b = max(frozen, key=lambda rows: rows[1] - rows[0])
    more = f" and {len(frozen) - 1} more times" if len(frozen) > 1 else ""
    return record.finding(
        "frozen_channel",
        f"is frozen: it stands still at {y[a]:.4g} {record.channel.unit} from {a / record.rate_hz:.4g} s to "
        f"{b / record.rate_hz:.4g} s{more} ({_per_cent(share)} of the record): leave this time out (--from, --to), "
        "check the sensor and its cable",
        tuple(frozen),
        usable=share <= RECORD_LIMITS.max_frozen_share,
    )


def _few_levels(record: ChannelRecord) -> RecordFinding | None:
    """A quantisation step that is coarse against the signal."""
    part = next(z for z in finite_pieces(record.y) if z.size)[: RECORD_LIMITS.levels_samples]
    levels = np.unique(part)
    if levels.size > 64:
        return None
    step, sd = float(np.median(np.diff(levels))) if levels.size > 1 else np.inf, float(np.std(part))
    if levels.size > 2 and step <= RECORD_LIMITS.max_step_per_sd * sd:
        return None
    if levels.size <= 2:
        what = "has only two values: one bit of information"
    else:
        unit = record.channel.unit
        what = f"has only {levels.size} levels, {step:.3g} {unit} apart, with an rms of {sd:.3g} {unit}"
    return record.finding(
        "few_levels",
        f"{what}; use a smaller sensor range or more bits, and check bit position, length and scale of the signal",
        usable=levels.size > 2 and step <= RECORD_LIMITS.max_step_per_sd_usable * sd,
    )


def _spikes(record: ChannelRecord) -> RecordFinding | None:
    """Single samples far outside all others."""
    rows = spike_rows(record.y)
    if not rows.size:
        return None
    top = int(rows[np.argmax(np.abs(record.y[rows] - record.robust[0]))])
    more, unit = f", the largest of {rows.size}" if rows.size > 1 else "", record.channel.unit
    return record.finding(
        SPIKES_CODE,
        f"has a spike of {record.y[top]:.3g} {unit} at {top / record.rate_hz:.4f} s (row {top}){more}; the rest has an "
        f"rms of {record.robust[1]:.3g} {unit}: no vibration, left out; check the link and the cable",
        tuple((int(row), int(row) + 1) for row in rows),
    )


def _clipped(record: ChannelRecord) -> RecordFinding | None:
    """Samples at the rails."""
    if (found := clipping_level(record.y)) is None:
        return None
    level, count = found
    share = count / record.moments.count
    text = f"is clipped at +-{level:.3g} {record.channel.unit} in {_per_cent(share)} of its samples"
    if share <= RECORD_LIMITS.max_clipped_share_bearing:
        return record.finding("peaks_clipped", f"{text}: too few to matter; a larger sensor range is safer")
    advice = _range_to_take(record, level, share)
    return record.finding(
        CLIPPED_CODE,
        f"{text}: no value is reliable; {advice}",
        usable=share <= RECORD_LIMITS.max_clipped_share,
        judged=False,
    )


def _range_to_take(record: ChannelRecord, level: float, share: float) -> str:
    """The sensor range that a clipped channel asks for: five standard deviations of the Gaussian signal that is beyond
    the level for this share of time."""
    if not 0.0 < share < 0.9:
        return "use a much larger sensor range"
    need = 5.0 * level / float(-ndtri(0.5 * share))
    return f"use a sensor range of at least {float(f'{need:.2g}'):g} {record.channel.unit}"


def _offset(record: ChannelRecord) -> RecordFinding | None:
    """A mean that no sensor at rest has."""
    mean, sd, unit = record.moments.mean, record.moments.sd, record.channel.unit
    if record.channel.kind == "acceleration":
        if abs(mean) > RECORD_LIMITS.max_offset_m_s2 and abs(abs(mean) / g**2 - 1.0) < RECORD_LIMITS.gravity_error_rel:
            return record.finding(
                "wrong_unit",
                f"has a mean of {mean:.4g} m/s^2, gravity times 9.81: its samples are m/s^2 and the rig file says g",
            )
        if abs(abs(mean) - 1.0) < RECORD_LIMITS.gravity_error_rel and sd < 0.1:
            return record.finding(
                "wrong_unit",
                f"has a mean of {mean:.4g} m/s^2, as gravity has in g: check whether its unit is g",
            )
    big = record.channel.kind == "acceleration" and abs(mean) > max(RECORD_LIMITS.max_offset_m_s2, 3.0 * sd)
    if not big and abs(mean) <= RECORD_LIMITS.max_offset_per_sd * sd:
        return None
    return record.finding(
        "offset",
        f"has a mean of {mean:.4g} {unit} and an rms about it of {sd:.3g} {unit}: check its offset, the bias of the "
        "sensor, and the unit",
    )


def _wrong_unit(record: ChannelRecord) -> RecordFinding | None:
    """Values that no machine has, by the rms, or by the median absolute deviation where spikes make up the rms."""
    kind, sd = record.channel.kind, record.moments.sd
    size = min(sd, 3.0 * record.robust[1]) if record.robust[1] > 0.0 else sd
    what = ""
    if kind == "acceleration":
        if not RECORD_LIMITS.min_acceleration_rms <= size <= RECORD_LIMITS.max_acceleration_rms:
            what = f"an rms of {size:.3g} m/s^2 ({size / g:.2g} g)"
        elif (
            v := 1e-3 * (record.summary.velocity_rms_mm_s or 0.0)
        ) > RECORD_LIMITS.max_velocity_rms and size > 0.5 * sd:
            what = f"a velocity of {1e3 * v:.3g} mm/s rms from 10 to 1000 Hz"
    elif kind == "velocity":
        if not RECORD_LIMITS.min_velocity_rms_any <= size <= RECORD_LIMITS.max_velocity_rms:
            what = f"an rms of {1e3 * size:.3g} mm/s"
    elif kind == "displacement":
        peak, follows = record.moments.span / 2.0, _acceleration_of(record)
        if size < RECORD_LIMITS.min_displacement_rms:
            what = f"an rms of {size:.3g} m"
        elif peak > RECORD_LIMITS.max_displacement_m and size > 0.5 * sd:
            what = f"a displacement of +-{peak:.3g} m"
        elif follows > RECORD_LIMITS.max_displacement_acceleration and size > 0.5 * sd:
            what = f"an acceleration of {follows:.3g} m/s^2 rms by its displacement"
    if not what:
        return None
    return record.finding("wrong_unit", f"has {what}: no machine has that; check its unit and its scale")


def _acceleration_of(record: ChannelRecord) -> float:
    """rms of the acceleration, m/s^2, of a displacement channel below a tenth of the rate: above that it is noise."""
    longest = longest_stretch(record.y)
    if longest < 64:
        return 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        f, psd, _ = power_spectrum(record.y, record.rate_hz, min(longest, 4096))
        low = f < 0.1 * record.rate_hz
        power = float(np.sum((psd * (2.0 * np.pi * f) ** 4)[low]) * f[1])
    return float(np.sqrt(power)) if np.isfinite(power) else np.inf


def _repeated(record: ChannelRecord) -> RecordFinding | None:
    """Samples that repeat the previous sample more often than quantisation explains."""
    part = record.y[: 1 << 18]
    inner = (part > record.moments.low) & (part < record.moments.high)  # a clipped channel repeats its rails
    step = np.abs(np.diff(np.where(inner, part, np.nan)))
    step = step[np.isfinite(step)]
    if step.size < 100:
        return None
    share = float(np.mean(step == 0.0))
    if share < RECORD_LIMITS.min_repeated_share or share > 0.999:
        return None
    moved = step[step > 0.0]
    least = float(np.quantile(moved, min(share, 0.5)))
    sizes = np.unique(np.round(moved[moved <= least] / least, 3))
    if sizes.size <= 20:  # the steps of a converter: neighbours are equal as its resolution is coarse
        return None
    runs = np.diff(np.flatnonzero(np.append(True, step != 0.0)))
    times = int(np.median(runs)) if runs.size else 1
    if times > 1 and float(np.mean(runs == times)) > 0.8:
        text = (
            f"repeats each value {times} times: its true rate is {record.rate_hz / times:.5g} Hz, not "
            f"{record.rate_hz:.5g} Hz; record at the sensor's own rate"
        )
    else:
        text = f"repeats the sample before in {_per_cent(share)} of its samples: a link or a logger fills lost samples"
    return record.finding("repeated_samples", text)


def _empty_spectrum(record: ChannelRecord) -> RecordFinding | None:
    """A spectrum that holds not even the rounding of a converter above some frequency."""
    longest = longest_stretch(record.y)
    if longest < 1024:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        f, psd, _ = power_spectrum(record.y, record.rate_hz, min(4096, longest))
        floor = (record.moments.span * 2.0**-RECORD_LIMITS.converter_bits) ** 2 / 12.0 / (0.5 * record.rate_hz)
        full = np.flatnonzero(~(psd < floor))
    edge = float(f[full[-1]]) if full.size else 0.0
    if edge >= RECORD_LIMITS.empty_spectrum_share * record.rate_hz:
        return None
    return record.finding(
        "empty_spectrum",
        f"has nothing above {edge:.4g} Hz, not even noise: it was resampled or smoothed from a lower rate; end the "
        "band below that and do not use this rate for delays",
    )


def _per_cent(share: float) -> str:
    """A share as the user reads it."""
    return f"{100.0 * share:.2g} %" if share < 0.995 else "100 %"


Check = Callable[[ChannelRecord], RecordFinding | None]
_FORCE_CHECKS: tuple[Check, ...] = (_spikes, _offset)  # a force may rest, be smooth, and have two levels
_MOTION_CHECKS: tuple[Check, ...] = (
    _spikes,
    _few_levels,
    _frozen,
    _clipped,
    _offset,
    _wrong_unit,
    _repeated,
    _empty_spectrum,
)
