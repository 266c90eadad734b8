"""Result of the machine layer of a record: speed of the shaft, tones, strike trains, remarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from estimator.model.rig import LineBand
from estimator.results import Message

from .thresholds import LIMITS

SpeedSource = Literal["tacho", "record", "rig file"]
ToneKind = Literal["order", "mains", "other"]
StrikeName = Literal["BPFO", "BPFI", "BSF", "FTF", "other"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ShaftSpeed:
    """Mean speed of the shaft.

    Parameters
    ----------
    value_rpm : float
        Turns per minute.
    sd_rpm : float
        Standard deviation of `value_rpm`; of a speed from the rig file, the usual deviation from a nameplate.
    source : {"tacho", "record", "rig file"}
        "record": from the harmonics of the shaft in the spectra of the channels.
    wander_rel : float
        Standard deviation of the speed along the record over its mean.
    range_rel : (float, float)
        Least and largest speed along the record over the mean, by a tacho; (1, 1) where it is not followed.
    """

    value_rpm: float
    sd_rpm: float
    source: SpeedSource
    wander_rel: float = 0.0
    range_rel: tuple[float, float] = (1.0, 1.0)

    @property
    def hz(self) -> float:
        """Turns per second."""
        return self.value_rpm / 60.0

    @property
    def is_swept(self) -> bool:
        """Whether the speed changes so much that an order is no line of the spectrum."""
        return self.range_rel[1] - self.range_rel[0] > LIMITS.min_sweep_rel

    @property
    def sd_hz(self) -> float:
        """Standard deviation of `hz`."""
        return self.sd_rpm / 60.0

    def to_json(self) -> dict[str, Any]:
        """`value`, `sd` (rpm) and `source`."""
        return {"value": self.value_rpm, "sd": self.sd_rpm, "source": self.source}


@dataclass(frozen=True, slots=True, kw_only=True)
class Tone:
    """A narrow line of the measured spectra.

    Parameters
    ----------
    kind : {"order", "mains", "other"}
        "order": a whole multiple of the shaft speed. "mains": a multiple of 50 or 60 Hz. "other": neither.
    order : float or None
        Frequency over the turns per second of the shaft; None where the speed is unknown.
    frequency_hz : float
        Hz.
    amplitude : mapping of str to float
        Channel -> peak amplitude in `unit`, for the channels in which the tone is significant.
    unit : str
        SI unit of the amplitudes.
    p_value : float
        Chance that noise of the record's spectrum has such a line anywhere in the record.
    """

    kind: ToneKind
    order: float | None
    frequency_hz: float
    amplitude: Mapping[str, float]
    unit: str
    p_value: float

    def to_json(self) -> dict[str, Any]:
        """An entry of `tones` in the JSON of a diagnosis."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class StrikeTrain:
    """Repetitive impacts: a comb of lines in the spectrum of the squared envelope.

    Parameters
    ----------
    name : {"BPFO", "BPFI", "BSF", "FTF", "other"}
        Kinematic frequency of the bearing that the train has; "BSF" for a ball, which strikes once or twice a spin.
    order : float or None
        Strikes per turn of the shaft; None where the speed is unknown.
    frequency_hz : float
        Strikes per second.
    slip_percent : float or None
        Deviation from the kinematic order, per cent; None of a train that has no kinematic name.
    channel : str
        Channel in which the train is clearest.
    band_hz : (float, float)
        Band in which it is clearest there, Hz.
    p_value : float
        Chance that noise of the record's spectrum has such a comb in any channel and band, at any order searched.
    severity : float
        Depth of modulation: rms of the periodic part of the squared envelope in the band over its mean.
    harmonics : int
        Significant harmonics of the comb.
    """

    name: StrikeName
    order: float | None
    frequency_hz: float
    slip_percent: float | None
    channel: str
    band_hz: tuple[float, float]
    p_value: float
    severity: float
    harmonics: int

    def to_json(self) -> dict[str, Any]:
        """An entry of `strikes` in the JSON of a diagnosis."""
        return asdict(self) | {"band_hz": list(self.band_hz)}


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineSurvey:
    """Shaft speed, tones and strike trains of a record.

    Parameters
    ----------
    speed : ShaftSpeed or None
        None: neither the record nor the rig file has a speed.
    tones : tuple of Tone
        Strongest first, at most ten.
    strikes : tuple of StrikeTrain
        Clearest first.
    messages : tuple of Message
        Remarks: a speed that the record contradicts, tones beyond the ten, what could not be searched and why.
    line_bands : mapping of str to tuple of LineBand
        Channel -> bands about its narrow lines, for a force balance to leave out.
    """

    speed: ShaftSpeed | None = None
    tones: tuple[Tone, ...] = ()
    strikes: tuple[StrikeTrain, ...] = ()
    messages: tuple[Message, ...] = field(default=())
    line_bands: Mapping[str, tuple[LineBand, ...]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The value of the key `machine` in the JSON of a diagnosis."""
        return {
            "speed_rpm": None if self.speed is None else self.speed.to_json(),
            "tones": [tone.to_json() for tone in self.tones],
            "strikes": [train.to_json() for train in self.strikes],
        }
