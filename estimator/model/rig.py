"""A rotor model as data: what the rig file says, in SI units. Every part of the estimator starts from a `Model`.

Conventions. One transverse direction at a time: x, then y (rotation takes x to y). Forces are written as *restoring*
forces on the left-hand side: M a + C v + K x + sum(effects) = F, with F the unknown excitation. S is the one-sided
PSD of F in N^2/Hz (white noise of intensity Q, E[F F'] = Q delta, has S = 2 Q). Places are written "bearing1.x".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from types import MappingProxyType
from typing import Any, Literal

from estimator.errors import ModelError

from .background import Background
from .effect import Effect
from .recorder import AntiAlias
from .rotor_matrices import RotorMatrices

Shaft = Literal["chain", "beam", "matrices", "none"]
BEARING_NODES = ("bearing1", "bearing2")  # names of bearings that have no other
CAP_DIRECTIONS = ("x", "y")
LINEAR_UNITS = MappingProxyType({"kL": "N/m", "c": "N s/m", "m": "kg", "S": "N^2/Hz"})
MOTION_UNITS = MappingProxyType({"acceleration": "m/s^2", "velocity": "m/s", "displacement": "m"})  # by kind
# part of ISO 20816 -> keys that distinguish the classes of its machines
KEYS_OF_ISO_PART: Mapping[int, tuple[str, ...]] = MappingProxyType(
    {1: ("size",), 3: ("group", "support"), 7: ("category", "power_kw")}
)
NO_SETTINGS: Mapping[str, Mapping[str, Setting]] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Setting:
    """One parameter at one place.

    Parameters
    ----------
    value : float or None
        Start of a fit, or truth of a simulation, in SI. None: unknown, to be estimated.
    fixed : bool
        Whether a fit keeps the value.
    low, high : float or None
        Limits of the value, in SI. None: no limit but those of the effect.
    """

    value: float | None = None
    fixed: bool = False
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, slots=True)
class Channel:
    """One measured channel.

    Parameters
    ----------
    name : str
        As in the rig file.
    node : str
        Name of the bearing, such as "bearing1"; "shaft" of a tacho.
    direction : str
        "x" or "y"; "" of a tacho.
    kind : str
        "acceleration" (m/s^2), "velocity" (m/s), "displacement" (m), "force" (N) or "tacho" (any unit).
    """

    name: str
    node: str
    direction: str
    kind: str = "acceleration"

    @property
    def place(self) -> str:
        """Location that the channel measures, such as "bearing1.x"; a tacho is of the shaft, wherever it stands."""
        return "." if self.kind == "tacho" else f"{self.node}.{self.direction}"

    @property
    def unit(self) -> str:
        """SI unit of the measured quantity; "" of a tacho."""
        return "N" if self.kind == "force" else MOTION_UNITS.get(self.kind, "")


@dataclass(frozen=True, slots=True)
class BearingGeometry:
    """Geometry of a ball bearing.

    Parameters
    ----------
    balls : int
        Number of balls.
    ball_diameter, pitch_diameter : float
        m; the pitch circle goes through the centres of the balls.
    groove_radius : float or None
        m, of the raceways across the direction of rolling. None: unknown; kinematics do without it.
    preload : float or None
        m, radial; below 0 a clearance. None: unknown.
    contact_angle : float
        rad.
    """

    balls: int
    ball_diameter: float
    pitch_diameter: float
    groove_radius: float | None = None
    _: KW_ONLY
    preload: float | None = None
    contact_angle: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineClass:
    """Class of a machine for the zones of its vibration, measured in place on bearing housings.

    Parameters
    ----------
    part : {1, 3, 7}
        3: ISO 20816-3, industrial machines above 15 kW, 120 to 30 000 rpm. 7: ISO 10816-7, rotodynamic pumps above
        1 kW. 1: the classes of ISO 10816-1:1995, which its successor gives no more.
    group : {1, 2} or None
        Of part 3. 1: above 300 kW or shaft height from 315 mm; 2: 15 to 300 kW, shaft height 160 to 315 mm.
    support : {"rigid", "flexible"} or None
        Of part 3. Rigid: the lowest natural frequency of machine and support is at least 25 % above the speed.
    category : {1, 2} or None
        Of part 7. 1: pumps that must be reliable or safe; 2: pumps for general use.
    power_kw : float or None
        Of part 7.
    size : {"I", "II", "III", "IV"} or None
        Of part 1. I: to 15 kW; II: 15 to 75 kW, or to 300 kW on a foundation of its own; III: large, on a rigid
        foundation; IV: large, on a soft one.

    Raises
    ------
    ModelError
        What the part needs is missing.
    """

    part: Literal[1, 3, 7] = 3
    group: Literal[1, 2] | None = None
    support: Literal["rigid", "flexible"] | None = None
    category: Literal[1, 2] | None = None
    power_kw: float | None = None
    size: Literal["I", "II", "III", "IV"] | None = None

    def __post_init__(self) -> None:
        """Raise ModelError where a key that the part needs is missing."""
        if missing := [name for name in KEYS_OF_ISO_PART[self.part] if getattr(self, name) is None]:
            raise ModelError(f"a machine of part {self.part} needs {' and '.join(missing)}")

    def to_json(self) -> dict[str, Any]:
        """The part, and the keys that it needs."""
        return {name: getattr(self, name) for name in ("part", *KEYS_OF_ISO_PART[self.part])}


@dataclass(frozen=True, slots=True)
class CustomLaw:
    """A user's own restoring force: an expression, or an effect defined in a Python module.

    Parameters
    ----------
    expression : str or None
        The force in N by x, v, xo, vo, t, phase and the parameters. None of a law from a module.
    module : str or None
        Where the effect is defined, as in the rig file. None of an expression.
    units : mapping of str to str
        Parameter of the expression -> its SI unit, in the order of p.
    effect : Effect or None
        What the module defines, loaded by the caller: the estimator opens no files. None of an expression.
    """

    expression: str | None = None
    module: str | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    effect: Effect | None = None


@dataclass(frozen=True, slots=True)
class EffectUse:
    """An effect in a model.

    Parameters
    ----------
    name : str
        Of the catalogue, or the user's own name.
    parameters : mapping of str to mapping of str to Setting
        Location -> parameter name -> setting, for every location where the effect acts.
    custom : CustomLaw or None
        The user's law. None of an effect of the catalogue.
    """

    name: str
    parameters: Mapping[str, Mapping[str, Setting]]
    custom: CustomLaw | None = None

    @property
    def at(self) -> tuple[str, ...]:
        """Locations (dofs) at which the law acts."""
        return tuple(self.parameters)


@dataclass(frozen=True, slots=True, kw_only=True)
class LineBand:
    """A narrow line of a record, whose bins no force balance judges.

    Parameters
    ----------
    low_hz, high_hz : float
        Edges of the band that the line may be in.
    power_over_psd_hz : float
        Power of the line over the power spectral density of the noise about it, Hz.
    has_cause : bool
        Whether the line is a harmonic of the shaft or of the mains.
    swept : bool
        Whether the line moves through the band as an order of a speed that changes.
    """

    low_hz: float
    high_hz: float
    power_over_psd_hz: float
    has_cause: bool = False
    swept: bool = False

    @property
    def centre_hz(self) -> float:
        """Middle of the band, Hz."""
        return 0.5 * (self.low_hz + self.high_hz)

    def holds(self, hz: float) -> bool:
        """Whether a frequency, Hz, is in the band."""
        return self.low_hz <= hz <= self.high_hz


@dataclass(frozen=True, slots=True)
class Model:
    """The whole rig.

    Parameters
    ----------
    channels : tuple of Channel
        In the order of the columns of a record.
    band : (float, float)
        Lower and upper edge of the analysed band, Hz.
    shaft : {"chain", "beam", "matrices", "none"}
        Form of the stiffness of the massless shaft between caps and disc; "matrices": `rotor`; "none": caps on their
        own.
    mass : mapping of str to float
        kg, keys "disc", "bearing1", "bearing2", or "bearing1.x" where directions differ. An absent mass is unknown;
        with `rotor` it is what moves with the bearing's node beside the matrices, 0 if absent.
    rotor : RotorMatrices or None
        Shaft and discs of the shaft "matrices".
    bearings : tuple of str
        Names of the bearings.
    shaft_stiffness : float
        N/m, the factor of the shaft's stiffness matrix.
    shaft_damping : float
        N s/m, the factor of the shaft's damping matrix of the same form.
    speed_rpm : float or None
        Mean shaft speed, turns per minute. None: unknown.
    ball_pass_order : float or None
        Ball passes of the outer ring per turn of the shaft. None: from the bearing's geometry, if that is known.
    order_found : bool
        Whether ball_pass_order is an estimate from the record.
    bearing : BearingGeometry or None
        Of both bearings. None: unknown.
    linear : mapping of str to mapping of str to Setting
        Location -> "kL" (N/m), "c" (N s/m), "S" (N^2/Hz, one-sided) -> setting.
    effects : tuple of EffectUse
        All effects of the model.
    candidates : tuple of EffectUse
        Laws of the user that are not in the model, but on trial when it is diagnosed.
    line_bands : tuple of LineBand
        Narrow lines found in the record, which are left out of the force balance.
    deflects_at_lines : bool
        Whether the bearings deflect at the narrow lines, as by a force. Hum of a sensor, and motion of the whole
        machine, deflect no bearing: no law sees them.
    record_lines : tuple of LineBand or None
        All narrow lines that a survey found in the record; None: a fit looks for them.
    unexplained_places : tuple of str
        Measured places that are left out of the model, as no mode there can be the bearing's.
    background : Background or None
        Structural modes and spectra of the excitation found in the record. None: no modes, a white force.
    name : str
        Of the rig, for the user.
    anti_alias : AntiAlias or None
        The recorder's anti-alias filter, undone in all channels of motion and force. None: no filter known.
    iso20816 : MachineClass or None
        Class of the machine for zones of its vibration. None: no zone.
    """

    channels: tuple[Channel, ...]
    band: tuple[float, float]
    shaft: Shaft = "none"
    mass: Mapping[str, float] = field(default_factory=dict)
    _: KW_ONLY
    shaft_stiffness: float = 0.0
    shaft_damping: float = 0.0
    rotor: RotorMatrices | None = None
    bearings: tuple[str, ...] = BEARING_NODES
    speed_rpm: float | None = None
    ball_pass_order: float | None = None
    order_found: bool = False
    bearing: BearingGeometry | None = None
    linear: Mapping[str, Mapping[str, Setting]] = field(default_factory=lambda: NO_SETTINGS)
    effects: tuple[EffectUse, ...] = ()
    candidates: tuple[EffectUse, ...] = ()
    line_bands: tuple[LineBand, ...] = ()
    deflects_at_lines: bool = True
    record_lines: tuple[LineBand, ...] | None = None
    unexplained_places: tuple[str, ...] = ()
    background: Background | None = None
    name: str = ""
    anti_alias: AntiAlias | None = None
    iso20816: MachineClass | None = None

    @property
    def places(self) -> tuple[str, ...]:
        """Measured cap places in the order of the channels, each once: the degrees of freedom of a fit."""
        measured = dict.fromkeys(c.place for c in self.channels if c.kind in MOTION_UNITS)
        return tuple(p for p in measured if p.split(".")[0] in self.bearings and p.split(".")[1] in CAP_DIRECTIONS)

    @property
    def tacho(self) -> int | None:
        """Number of the channel of a tacho; None without one."""
        return next((i for i, c in enumerate(self.channels) if c.kind == "tacho"), None)

    @property
    def discs(self) -> tuple[str, ...]:
        """Names of the discs on the shaft."""
        return self.rotor.discs if self.rotor is not None else () if self.shaft == "none" else ("disc",)

    def cap_mass(self, place: str) -> float | None:
        """Mass in kg at a place such as "bearing1.x", with that of a given rotor there; None if unknown."""
        given = self.mass.get(place, self.mass.get(place.split(".")[0]))
        return given if self.rotor is None else (given or 0.0) + self.rotor.bearing_mass(place)
