"""A rotor model as data: what the rig file says, in SI units. Every part of the estimator starts from a `Model`.

Conventions. One transverse direction at a time: x, then y (rotation takes x to y). Forces are written as *restoring*
forces on the left-hand side: M a + C v + K x + sum(effects) = F, with F the unknown excitation. S is the one-sided
PSD of F in N^2/Hz (white noise of intensity Q, E[F F'] = Q delta, has S = 2 Q). Places are written "bearing1.x".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from .effect import Effect
from .recorder import RollOff

Shaft = Literal["chain", "beam", "none"]
NODES = ("bearing1", "bearing2")
DIRECTIONS = ("x", "y")
UNITS = MappingProxyType({"kL": "N/m", "c": "N s/m", "m": "kg", "S": "N^2/Hz"})
MOTION = MappingProxyType({"acceleration": "m/s^2", "velocity": "m/s", "displacement": "m"})  # kind of a sensor -> unit
EMPTY: Mapping[str, Mapping[str, Setting]] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Setting:
    """One parameter at one place: a value (start of a fit, truth of a simulation), perhaps fixed or bounded."""

    value: float | None = None
    fixed: bool = False
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, slots=True)
class Channel:
    """One measured channel. kind: acceleration | velocity | displacement | force | tacho; data come in SI."""

    name: str
    node: str
    direction: str
    kind: str = "acceleration"

    @property
    def place(self) -> str:
        """What it measures, such as "bearing1.x"; a tacho is of the shaft, wherever it stands."""
        return "." if self.kind == "tacho" else f"{self.node}.{self.direction}"


@dataclass(frozen=True, slots=True)
class BearingGeometry:
    """A ball bearing, in metres. preload < 0 is a clearance."""

    balls: int
    ball_diameter: float
    pitch_diameter: float
    groove_radius: float
    preload: float | None = None
    contact_angle: float = 0.0


@dataclass(frozen=True, slots=True)
class CustomLaw:
    """A user's own restoring force: an expression (see custom.py) or a module's object, and its units.

    effect : the loaded object of `module`; the estimator opens no files, so whoever reads the rig file puts it here.
    """

    expression: str | None = None
    module: str | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    effect: Effect | None = None


@dataclass(frozen=True, slots=True)
class EffectUse:
    """An effect in a model. `parameters`: place -> parameter name -> Setting, for every place it acts at."""

    name: str
    parameters: Mapping[str, Mapping[str, Setting]]
    custom: CustomLaw | None = None

    @property
    def at(self) -> tuple[str, ...]:
        """Locations (dofs) at which the law acts."""
        return tuple(self.parameters)


@dataclass(frozen=True, slots=True)
class Model:
    """The whole rig. `linear`: place -> {"kL", "c", "S"} -> Setting (values None: unknown, to be estimated).

    mass : kg, keys "disc", "bearing1", "bearing2" (also "bearing1.x" where directions differ); absent = unknown.
    candidates : laws of the user that are not in the model, but on trial when it is diagnosed.
    order_found : whether ball_pass_order is only an estimate, from the record.
    roll_off : by place, what the recorder takes, found in the record (recorder.py); None where nothing is known.
    shaft_stiffness, shaft_damping : N/m and N s/m of each half of the shaft (physics: k of chain or beam form).
    """

    channels: tuple[Channel, ...]
    band: tuple[float, float]
    shaft: Shaft = "none"
    mass: Mapping[str, float] = field(default_factory=dict)
    shaft_stiffness: float = 0.0
    shaft_damping: float = 0.0
    speed_rpm: float | None = None
    ball_pass_order: float | None = None
    order_found: bool = False
    bearing: BearingGeometry | None = None
    linear: Mapping[str, Mapping[str, Setting]] = field(default_factory=lambda: EMPTY)
    effects: tuple[EffectUse, ...] = ()
    candidates: tuple[EffectUse, ...] = ()
    name: str = ""
    roll_off: RollOff | None = None

    @property
    def places(self) -> tuple[str, ...]:
        """Measured cap places in the order of the channels, each once: the degrees of freedom of a fit."""
        seen = dict.fromkeys(c.place for c in self.channels if c.kind in MOTION)
        return tuple(p for p in seen if p.split(".")[0] in NODES and p.split(".")[1] in DIRECTIONS)

    @property
    def tacho(self) -> int | None:
        """Number of the channel of a tacho; None without one."""
        return next((i for i, c in enumerate(self.channels) if c.kind == "tacho"), None)

    def cap_mass(self, place: str) -> float | None:
        """Mass in kg of the cap at a place such as "bearing1.x"; None if unknown."""
        return self.mass.get(place, self.mass.get(place.split(".")[0]))
