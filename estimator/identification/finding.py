"""A finding that is not a force law on the states: a line, a sensor fault, a shaped or shared excitation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from estimator.model.rig import EffectUse, Setting
from estimator.results import Parameter


@dataclass(frozen=True, slots=True)
class Suspect:
    """effect : catalogue name. at : canonical places (they become the keys of the model). gain : nats; df : parameters.

    p_value : after counting what this search tried. power : N^2 by place index, its share of the missing force.
    against, region : for the map of comparison. settings : by canonical place, parameter name -> Parameter.
    """

    effect: str
    at: tuple[str, ...]
    gain: float
    df: int
    p_value: float
    power: dict[int, float]
    against: str
    region: str
    settings: dict[str, dict[str, Parameter]] = field(default_factory=dict)
    note: str = ""
    detectable: tuple[float, str] | None = None


CLAIMED = 1e-3  # p-value above which nothing is counted as missing
UNKNOWN = "unknown"  # effect of a finding that nothing of the catalogue explains
# causes of one spectrum
SHAPES = ("coloured_excitation", "sensor_resonance", "pedestal", "sensor_noise", "sensor_gain", "sensor_skew", UNKNOWN)


@dataclass(frozen=True, slots=True)
class Share:
    """A part of the missing force that no state explains: N^2 at a place, for the map."""

    place: int
    against: str
    region: str
    power: float


def shares(suspects: list[Suspect]) -> list[Share]:
    """Each part once: of several causes for one spectrum the likeliest counts."""
    out: list[Share] = []
    shaped: dict[int, tuple[float, Share]] = {}
    for s in suspects:
        if s.p_value > CLAIMED:
            continue
        for place, power in s.power.items():
            share = Share(place, s.against, s.region, power)
            if s.effect not in SHAPES:
                out.append(share)
            elif place not in shaped or s.gain > shaped[place][0]:
                shaped[place] = (s.gain, share)
    return [s for s in out + [v for _, v in shaped.values()] if s.power > 0]


def as_use(effect: str, settings: Mapping[str, Mapping[str, Parameter]]) -> EffectUse:
    """An effect at the values found, as a model has it. settings : by canonical place, parameter name -> Parameter."""
    return EffectUse(effect, {key: {n: Setting(p.value) for n, p in own.items()} for key, own in settings.items()})
