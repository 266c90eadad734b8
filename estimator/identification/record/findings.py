"""Results of the record layer: a summary of every channel, and findings on channels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

CLIPPED_CODE = "clipped"
SPIKES_CODE = "spikes"  # its rows are left out of everything
STILL_CODES = frozenset({"empty_channel", "dead_channel", "frozen_channel", "few_levels"})  # nothing to compare


@dataclass(frozen=True, kw_only=True, slots=True)
class ChannelSummary:
    """Level and shape of the samples of one channel, without their mean.

    Parameters
    ----------
    rms : float or None
        Root mean square in the SI unit of the channel; None of a channel without samples.
    peak : float or None
        Largest absolute value, SI.
    crest : float or None
        Peak over rms; None of a constant channel.
    kurtosis : float or None
        Fourth moment over the squared second moment, 3 of a Gaussian signal; None of a constant channel.
    velocity_rms_mm_s : float or None
        Velocity from 10 to 1000 Hz, mm/s rms (ISO 20816-1). None of other kinds than acceleration and velocity, of
        records without a stretch of 1 s, and where the recorder does not pass 1000 Hz.
    """

    rms: float | None = None
    peak: float | None = None
    crest: float | None = None
    kurtosis: float | None = None
    velocity_rms_mm_s: float | None = None

    def to_json(self) -> dict[str, float | None]:
        """The numbers by name."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordFinding:
    """One remark on the channels of a record.

    Parameters
    ----------
    code : str
        Stable snake_case word.
    channels : tuple of str
        Names of the channels that the remark is about.
    text : str
        One line for the user: what, where, what to do.
    rows : tuple of (int, int)
        First row and the row behind the last one of each stretch concerned; empty where it is the whole record.
    places : tuple of str
        Places of the channels, such as ``"bearing1.x"``.
    condemned : tuple of str
        Those of the channels from which no bearing is judged.
    unusable : tuple of str
        Those of the channels that no later layer may use.
    """

    code: str
    channels: tuple[str, ...]
    text: str
    rows: tuple[tuple[int, int], ...] = ()
    places: tuple[str, ...] = ()
    condemned: tuple[str, ...] = ()
    unusable: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Code, channels and text."""
        return {"code": self.code, "channels": list(self.channels), "text": self.text}


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordSurvey:
    """Whether a record is fit to be judged.

    Parameters
    ----------
    channels : mapping of str to ChannelSummary
        By name of the channel, in the order of the model.
    findings : tuple of RecordFinding
        Faults of channels first, then of pairs of channels, then of the sampling.
    unusable : frozenset of str
        Names of the channels that no later layer may use.
    """

    channels: Mapping[str, ChannelSummary] = field(default_factory=dict)
    findings: tuple[RecordFinding, ...] = ()
    unusable: frozenset[str] = frozenset()

    @property
    def unjudged(self) -> frozenset[str]:
        """Names of the channels from which no bearing is judged: the unusable ones, and those that clip."""
        return self.unusable.union(name for finding in self.findings for name in finding.condemned)

    def to_json(self) -> dict[str, Any]:
        """The part `record` of the result of `diagnose`."""
        return {
            "channels": {name: summary.to_json() for name, summary in self.channels.items()},
            "findings": [finding.to_json() for finding in self.findings],
        }
