"""Mistakes in the rig file as hypotheses: a mass, the shaft's spring, two channels swapped, one inverted.

A wrong number or a wrong channel changes what the shaft is thought to carry from one bearing to the other. On one
bearing alone no record shows it. The machine layer finds a wrong speed or rate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import ClassVar, Protocol

from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects.sensor.sensor_gain import SENSOR_GAIN
from estimator.identification.batch.unknown_mass import places_without_mass
from estimator.identification.structure.rig_spectra import Arrangement
from estimator.model.rig import MOTION_UNITS, EffectUse, Model, Setting
from estimator.results import Parameter

Values = tuple[float, ...]  # none, or a factor and the standard deviation of its logarithm


def is_common_slip(values: Values) -> bool:
    """Whether a mistake has no factor, or a factor of about two or ten."""
    return not values or _log_from_common_slip(values[0]) < THRESHOLDS.max_factor_sd_log


def _log_from_common_slip(factor: float) -> float:
    """Distance of the logarithm of a factor from that of the nearest common slip."""
    return min(abs(math.log(factor / common)) for common in THRESHOLDS.trial_factors)


class Hypothesis(Protocol):
    """A named change of the model with a few numbers."""

    @property
    def name(self) -> str:
        """Key of the number or channel that the hypothesis changes, such as "rig.mass.bearing1"."""
        ...

    def propose(self, model: Model) -> Sequence[Values]:
        """Values to try."""
        return [()]

    def apply(self, model: Model, values: Values) -> Model:
        """The model with the change."""
        ...

    def arrange(self, model: Model, channels: Arrangement, places: tuple[str, ...]) -> Arrangement:
        """Places and signs of the channels with the change. places : of the channels as given."""
        return channels

    def is_slip(self, values: Values) -> bool:
        """Whether a user may have made the change by mistake."""
        return True

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        """Values that the rig file would have, by key."""
        ...

    def text(self, model: Model, values: Values) -> str:
        """Advice on what to check, one line."""
        ...


class ScaledNumber(Hypothesis, Protocol):
    """A number of the rig file is wrong by a factor."""

    unit: ClassVar[str]

    def number(self, model: Model) -> float:
        """The number in the rig file, SI."""
        ...

    def propose(self, model: Model) -> Sequence[Values]:
        return [(factor, 1.0) for factor in THRESHOLDS.trial_factors]

    def is_slip(self, values: Values) -> bool:
        """Whether the factor differs from one by more than instruments and its standard deviation allow, up to ten."""
        low = max(THRESHOLDS.min_factor_log, THRESHOLDS.min_factor_sd * values[1])
        high = math.log(max(THRESHOLDS.trial_factors)) + THRESHOLDS.min_factor_log
        return low < abs(math.log(values[0])) < high

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        number = values[0] * self.number(model)
        return {self.name: Parameter.from_estimate(number, values[1] * number, self.unit)}

    def text(self, model: Model, values: Values) -> str:
        rough = " or so" if values[1] > THRESHOLDS.max_factor_sd_log else ""
        factor = f"{values[0]:.2g} times its value{rough}"
        return f"check {self.name}: with {factor} the model explains the spectra of the caps"


@dataclass(frozen=True, slots=True)
class ScaledMass(ScaledNumber):
    """The mass of the disc or of a cap is wrong by a factor. key : of [rig.mass]."""

    unit = "kg"
    key: str

    @property
    def name(self) -> str:
        return f"rig.mass.{self.key}"

    def number(self, model: Model) -> float:
        return model.mass[self.key]

    def is_slip(self, values: Values) -> bool:
        """Whether the factor of a mass may be a mistake: it is less than two, or about two or ten."""
        odd = _log_from_common_slip(values[0]) > 2.0 * THRESHOLDS.max_factor_sd_log
        return ScaledNumber.is_slip(self, values) and not (odd and abs(math.log(values[0])) > math.log(2.0))

    def apply(self, model: Model, values: Values) -> Model:
        return replace(model, mass={**model.mass, self.key: values[0] * self.number(model)})


@dataclass(frozen=True, slots=True)
class ScaledSpring(ScaledNumber):
    """The stiffness of the shaft is wrong by a factor."""

    unit = "N/m"
    name: str = "rig.shaft_spring.stiffness"

    def number(self, model: Model) -> float:
        return model.shaft_stiffness

    def apply(self, model: Model, values: Values) -> Model:
        return replace(model, shaft_stiffness=values[0] * self.number(model))


@dataclass(frozen=True, slots=True)
class SwappedChannels(Hypothesis):
    """Two channels are swapped. first, second : their numbers."""

    first: int
    second: int

    @property
    def name(self) -> str:
        return f"channel.{self.first}.{self.second}"

    def apply(self, model: Model, values: Values) -> Model:
        channels = list(model.channels)
        one, other = channels[self.first], channels[self.second]
        channels[self.first] = replace(one, node=other.node, direction=other.direction)
        channels[self.second] = replace(other, node=one.node, direction=one.direction)
        return replace(model, channels=tuple(channels))

    def arrange(self, model: Model, channels: Arrangement, places: tuple[str, ...]) -> Arrangement:
        order = list(channels.channel_of)
        one, other = (places.index(model.channels[k].place) for k in (self.first, self.second))
        order[one], order[other] = order[other], order[one]
        return replace(channels, channel_of=tuple(order))

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        names = [model.channels[k].name for k in (self.first, self.second)]
        return {f"channel.{name}.swapped": Parameter(1.0, 0.0, "1") for name in names}

    def text(self, model: Model, values: Values) -> str:
        one, other = (model.channels[k].name for k in (self.first, self.second))
        return f"check the cables: {one} and {other} are swapped"


@dataclass(frozen=True, slots=True)
class InvertedChannel(Hypothesis):
    """A channel is inverted. number : of the channel."""

    number: int

    @property
    def name(self) -> str:
        return f"channel.{self.number}.sign"

    def apply(self, model: Model, values: Values) -> Model:
        place = model.channels[self.number].place
        turned = EffectUse(
            SENSOR_GAIN.name, {place: {SENSOR_GAIN.parameters[0].name: Setting(THRESHOLDS.inverted_error, fixed=True)}}
        )
        return replace(model, effects=(*(u for u in model.effects if u.name != turned.name), turned))

    def arrange(self, model: Model, channels: Arrangement, places: tuple[str, ...]) -> Arrangement:
        own = places.index(model.channels[self.number].place)
        return replace(channels, sign=tuple(-s if i == own else s for i, s in enumerate(channels.sign)))

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        return {f"channel.{model.channels[self.number].name}.sign": Parameter(-1.0, 0.0, "1")}

    def text(self, model: Model, values: Values) -> str:
        own = model.channels[self.number]
        across = [c.name for c in model.channels if c.direction == own.direction and c.kind in MOTION_UNITS]
        return f"check the mounting: the sign of {' or '.join(across)} is inverted"


def coupling_hypotheses(model: Model) -> list[Hypothesis]:
    """The mistakes that the coupling of the bearings shows; none without two bearings on a shaft.

    Of a rotor given by matrices the masses beside it and the channels: its own numbers come from a program.
    """
    nodes = {place.split(".")[0] for place in model.places}
    if places_without_mass(model) or any("." in key for key in model.mass):  # the shaft has to give masses: no witness
        return []
    of_disc = model.rotor is None and model.shaft != "none" and model.shaft_stiffness > 0.0 and "disc" in model.mass
    if not (of_disc or model.rotor is not None) or len(nodes) < 2:
        return []
    moving = [k for k, c in enumerate(model.channels) if c.kind in MOTION_UNITS]
    swappable = [
        (i, j) for i, j in combinations(moving, 2)
        if model.channels[i].kind == model.channels[j].kind and model.channels[i].place != model.channels[j].place
        and len(moving) > 2 and model.channels[i].direction != model.channels[j].direction
    ]  # fmt: skip
    first_bearing = [k for k in moving if model.channels[k].node == min(nodes)]
    return [
        *(ScaledMass(key) for key in model.mass), *([ScaledSpring()] if of_disc else []),
        *(SwappedChannels(i, j) for i, j in swappable), *(InvertedChannel(k) for k in first_bearing),
    ]  # fmt: skip
