"""Severity of vibration by channel: levels in fixed bands, velocity and displacement, zone of ISO 20816.

A number that the recorder, the sensor or the length of the record does not allow is None, with the reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from estimator.arrays import Array, real_samples
from estimator.model.rig import MOTION_UNITS, Model
from estimator.parallel import map_threads

from .channel_summary import longest_stretch, moments, power_spectrum, summarise, usable_hz
from .findings import CLIPPED_CODE, SPIKES_CODE, STILL_CODES, ChannelSummary, RecordFinding, RecordSurvey
from .survey import survey_record
from .thresholds import RECORD_LIMITS
from .usable import without_spikes
from .zones import Zone, iso_zone

WRONG_VALUE_CODES = STILL_CODES | {"wrong_unit", "absurd_values"}  # findings that no number of the channel outlives
SHAPE_NAMES = ("rms", "peak", "crest", "kurtosis")
ALL_NAMES = (*SHAPE_NAMES, "velocity_rms_mm_s", "displacement_rms_um", "zone", "bands")
HOUSING_TEXT = "a displacement channel: ISO 20816-3 judges the bearing housing; measure its acceleration or velocity"


@dataclass(frozen=True, kw_only=True, slots=True)
class BandLevel:
    """Level of a channel in a band.

    Parameters
    ----------
    low_hz, high_hz : float
        Edges of the band, Hz.
    rms : float or None
        In the SI unit of the channel; None where the record does not reach so far.
    """

    low_hz: float
    high_hz: float
    rms: float | None


@dataclass(frozen=True, kw_only=True, slots=True)
class ChannelSeverity:
    """Severity of vibration in one channel.

    Parameters
    ----------
    unit : str
        SI unit of rms, peak and bands.
    rms, peak, crest, kurtosis : float or None
        Of all samples without their mean and without spikes.
    velocity_rms_mm_s, displacement_rms_um : float or None
        From 10 to 1000 Hz.
    zone : {"A", "B", "C", "D"} or None
        Of the standard of the machine, the worse one of velocity and displacement.
    bands : tuple of BandLevel
        Levels in fixed bands, as far as the record reaches.
    void : mapping of str to str
        Name of a number that is None -> the reason. The key of a band is "bands", of the first that is None.
    """

    unit: str
    rms: float | None = None
    peak: float | None = None
    crest: float | None = None
    kurtosis: float | None = None
    velocity_rms_mm_s: float | None = None
    displacement_rms_um: float | None = None
    zone: Zone | None = None
    bands: tuple[BandLevel, ...] = ()
    void: Mapping[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The numbers by name."""
        return asdict(self) | {"bands": [asdict(band) for band in self.bands], "void": dict(self.void)}


def severity(
    model: Model,
    y: Array,
    rate_hz: float,
    survey: RecordSurvey | None = None,
    full_scale: Mapping[str, int] = MappingProxyType({}),
) -> dict[str, ChannelSeverity]:
    """Severity of every channel of motion.

    Parameters
    ----------
    model : Model
        The rig: channels, recorder's filter, machine class, speed.
    y : (n, channels) float64 or float32
        Samples in SI units; NaN where one is missing.
    rate_hz : float
        Sampling rate, Hz.
    survey : RecordSurvey or None
        What the record layer says of these samples; None: they are surveyed.
    full_scale : mapping of str to int
        Channel -> number of its samples that were at full scale and are NaN.

    Returns
    -------
    dict of str to ChannelSeverity
        By name of the channel. Nothing is raised; an array that is no record of this rig gives an empty dict.

    References
    ----------
    ISO 20816-1:2016; ISO 20816-3:2022, annex A; ISO 2954:2012 (tolerance of the band).
    """
    y = real_samples(y)
    survey = survey_record(model, y, rate_hz) if survey is None else survey

    def severity_of(k: int) -> ChannelSeverity:
        channel = model.channels[k]
        own = [f for f in survey.findings if channel.name in f.channels]
        z, summary = y[:, k], survey.channels[channel.name]
        if any(f.code == SPIKES_CODE for f in own):
            z = without_spikes(model, y, survey)[:, k]
            summary = summarise(z, channel.kind, rate_hz, usable_hz(model.anti_alias, rate_hz), moments(z))
        void = _wrong_values(channel.name, z, own, full_scale.get(channel.name, 0))
        return _of_channel(model, channel.kind, z, rate_hz, summary, void)

    asked = [k for k, c in enumerate(model.channels) if c.kind in MOTION_UNITS and c.name in survey.channels]
    return {model.channels[k].name: own for k, own in zip(asked, map_threads(severity_of, asked), strict=True)}


def _wrong_values(name: str, z: Array, findings: Sequence[RecordFinding], at_full_scale: int) -> dict[str, str]:
    """Numbers that the samples themselves do not allow, with the reason. at_full_scale : samples that are left out."""
    if wrong := next((f.text for f in findings if f.code in WRONG_VALUE_CODES), ""):
        return dict.fromkeys(ALL_NAMES, wrong)
    share = at_full_scale / max(1, at_full_scale + int(np.count_nonzero(np.isfinite(z))))
    if share > RECORD_LIMITS.max_clipped_share_bearing:
        text = f"{name} is at full scale in {100 * share:.2g} % of its samples: use a larger range"
        return dict.fromkeys(ALL_NAMES if share > RECORD_LIMITS.max_clipped_share else SHAPE_NAMES[1:], text)
    clipped = next((f for f in findings if f.code == CLIPPED_CODE), None)
    if clipped is None:
        return {}
    return dict.fromkeys(ALL_NAMES if clipped.unusable else SHAPE_NAMES[1:], clipped.text)


def _of_channel(
    model: Model, kind: str, y: Array, rate_hz: float, summary: ChannelSummary, void: dict[str, str]
) -> ChannelSeverity:
    """Severity of one channel. void : numbers that its samples do not allow."""
    unit = MOTION_UNITS[kind]
    if "rms" in void:
        return ChannelSeverity(unit=unit, void=void)
    reach_hz, seconds = usable_hz(model.anti_alias, rate_hz), longest_stretch(y) / rate_hz
    bands, displacement = _levels(y, kind, rate_hz, reach_hz)
    velocity = summary.velocity_rms_mm_s
    least_s, short = RECORD_LIMITS.min_stretch_s, ""
    if seconds < least_s:
        short = f"the longest stretch without a gap has {seconds:.3g} s: 10 Hz needs {least_s:g} s"
    beyond = _reach_text(model, rate_hz, reach_hz)
    unreached = beyond if reach_hz < RECORD_LIMITS.iso_band_hz[1] else short
    if kind == "displacement" and not unreached:
        void["velocity_rms_mm_s"] = HOUSING_TEXT
    if unreached:
        void |= dict.fromkeys(("velocity_rms_mm_s", "displacement_rms_um"), unreached)
    if not bands or any(band.rms is None for band in bands):
        void["bands"] = short or beyond
    zone = None
    if why := void.get("velocity_rms_mm_s") or _why_no_zone(model):
        void["zone"] = why
    elif velocity is not None and model.iso20816 is not None:
        zone = iso_zone(model.iso20816, velocity, displacement or 0.0)
    return ChannelSeverity(
        unit=unit,
        velocity_rms_mm_s=velocity,
        displacement_rms_um=displacement,
        zone=zone,
        bands=bands,
        void=void,
        **{name: None if name in void else getattr(summary, name) for name in SHAPE_NAMES},
    )


def _levels(y: Array, kind: str, rate_hz: float, reach_hz: float) -> tuple[tuple[BandLevel, ...], float | None]:
    """Levels in the fixed bands, and displacement from 10 to 1000 Hz in um rms; none of a record that is too short."""
    longest = longest_stretch(y)
    if longest < RECORD_LIMITS.min_stretch_s * rate_hz:
        return (), None
    scale = float(np.nanmax(np.abs(y))) or 1.0
    f, psd, _ = power_spectrum(y, rate_hz, int(min(longest, RECORD_LIMITS.segment_s * rate_hz)), scale)
    bands = []
    for low, high in zip(RECORD_LIMITS.band_edges_hz[:-1], RECORD_LIMITS.band_edges_hz[1:], strict=True):
        if low >= reach_hz:
            break
        inside = (f >= low) & (f < high)
        rms = float(np.sqrt(np.sum(psd[inside]) * f[1])) * scale if high <= reach_hz else None
        bands.append(BandLevel(low_hz=low, high_hz=high, rms=rms))
    low, high = RECORD_LIMITS.iso_band_hz
    inside = (f >= low) & (f <= high)
    order = {"acceleration": 4.0, "velocity": 2.0, "displacement": 0.0}[kind]
    power = float(np.sum(psd[inside] / (2.0 * np.pi * f[inside]) ** order) * f[1])
    return tuple(bands), (1e6 * scale * float(np.sqrt(power)) if high <= reach_hz else None)


def _reach_text(model: Model, rate_hz: float, reach_hz: float) -> str:
    if model.anti_alias is not None:
        return f"the anti-alias filter of the rig file passes up to {reach_hz:.0f} Hz: record with a higher one"
    return (
        f"at {rate_hz:g} Hz a recorder passes up to about {reach_hz:.0f} Hz (rate / 2.56): record at a higher rate, or "
        "state acquisition.anti_alias in the rig file"
    )


def _why_no_zone(model: Model) -> str:
    """Why a velocity has no zone; "" if it has one."""
    if model.iso20816 is None:
        return 'no machine class: add [machine] iso20816 = { part = 3, group = 2, support = "rigid" } to the rig file'
    if model.speed_rpm is not None and model.speed_rpm < RECORD_LIMITS.min_iso_speed_rpm:
        return f"at {model.speed_rpm:g} rpm the standard judges from 2 Hz on, and this velocity begins at 10 Hz"
    return ""
