"""The rig file as it is written: one pydantic model per table, values in the file's units (rig.py makes them SI)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from estimator.model import KEYS_OF_ISO_PART

from .alarm_table import AlarmTable
from .rig_table import ByBearing, RigTable
from .table import NotNegative, NumberOrTable, Positive, Table
from .units import UNITS_OF_KIND, VOLTS_OF_UNIT, canonical, factor, foreign, sensitivity_parts

MAX_ANALOGUE_ORDER = 20  # poles of an analogue filter: beyond them the design itself loses its digits


class SettingTable(NumberOrTable):
    """A parameter: a number, or a table of value, fixed, min and max (and `at`, for an effect's parameter)."""

    value: float | None = None
    fixed: bool = False
    min: float | None = None
    max: float | None = None
    at: str | list[str] | None = Field(default=None, description="the places it acts at, if not everywhere")
    unit: str | None = Field(default=None, description="for parameters of a law of one's own")

    @model_validator(mode="before")
    @classmethod
    def number(cls, data: Any) -> Any:
        if isinstance(data, dict):
            return data
        if isinstance(data, bool) or not isinstance(data, int | float):
            raise ValueError(f"{data!r} is neither a number nor a table such as {{ value = 1.0, fixed = true }}")
        return {"value": float(data)}

    @field_validator("unit")
    @classmethod
    def in_si(cls, value: str | None) -> str | None:
        if value and (part := foreign(value)):
            raise ValueError(f'"{value}": {part} is no SI unit; laws see m, m/s and s, and give N: convert the value')
        return value

    @model_validator(mode="after")
    def ordered(self) -> SettingTable:
        if self.fixed and self.value is None:
            raise ValueError("fixed without a value: give value =, or remove fixed")
        if self.min is not None and self.max is not None and self.min >= self.max:
            raise ValueError(f"min {self.min:g} is not below max {self.max:g}")
        for name, limit, outside in (("min", self.min, -1), ("max", self.max, 1)):
            if limit is not None and self.value is not None and (self.value - limit) * outside > 0:
                raise ValueError(f"value {self.value:g} is beyond {name} {limit:g}")
        return self


class BandTable(Table):
    """Hz, the analysis band."""

    low: NotNegative
    high: Positive

    @field_validator("high")
    @classmethod
    def above_low(cls, value: float, info: ValidationInfo) -> float:
        if value <= info.data.get("low", 0.0):
            raise ValueError(f"{value:g} Hz is not above low = {info.data['low']:g} Hz")
        return value


class AntiAliasTable(Table):
    """The recorder's anti-alias filter, undone in every analysis.

    cutoff_hz : 3 dB down; end of the ripples of chebyshev1; start of the stop band of chebyshev2; 6 dB down of fir.
    ripple_db : of chebyshev1 the ripple (0.5), of chebyshev2 the loss in the stop band (60).
    """

    kind: Literal["butterworth", "bessel", "chebyshev1", "chebyshev2", "fir"]
    order: Annotated[int, Field(ge=1, le=1024, description="poles; of fir the number of taps less one")]
    cutoff_hz: Positive
    ripple_db: Positive | None = None

    @field_validator("order")
    @classmethod
    def stable(cls, value: int, info: ValidationInfo) -> int:
        if value > MAX_ANALOGUE_ORDER and info.data.get("kind") != "fir":
            raise ValueError(f"{value}: an analogue filter has at most {MAX_ANALOGUE_ORDER} poles")
        return value


class AcquisitionTable(Table):
    """Samples of the device, expected or simulated (full_scale, noise: unit of the channels)."""

    rate_hz: Positive
    full_scale: Positive | None = None
    noise: NotNegative = 0.0
    anti_alias: AntiAliasTable | None = None


class Iso20816Table(Table):
    """Class of the machine for the zones of its vibration on bearing housings.

    Part 3 (ISO 20816-3, 15 kW and more, 120 to 30 000 rpm) needs group and support, part 7 (ISO 10816-7, pumps)
    category and power_kw, part 1 (the classes of ISO 10816-1) size.
    """

    part: int = Field(description="`1`, `3` or `7`")
    group: Literal[1, 2] | None = Field(
        default=None, description="part 3: 1 is above 300 kW or a shaft height from 315 mm, 2 is 15 to 300 kW"
    )
    support: Literal["rigid", "flexible"] | None = Field(
        default=None, description="part 3: rigid if the lowest natural frequency is at least 25 % above the speed"
    )
    category: Literal[1, 2] | None = Field(
        default=None, description="part 7: 1 is pumps that must be reliable or safe, 2 is pumps for general use"
    )
    power_kw: Positive | None = Field(default=None, description="part 7: of the pump")
    size: Literal["I", "II", "III", "IV"] | None = Field(
        default=None,
        description="part 1: I is to 15 kW, II to 75 kW (300 kW on a foundation of its own), III is large on a rigid, "
        "IV large on a soft foundation",
    )

    @field_validator("part")
    @classmethod
    def known_part(cls, value: int) -> int:
        if value not in KEYS_OF_ISO_PART:
            known = "zones are known for parts 1, 3 and 7"
            raise ValueError(f"{value}: {known}; leave iso20816 out for numbers without zone")
        return value

    @model_validator(mode="after")
    def what_the_part_needs(self) -> Iso20816Table:
        needed = KEYS_OF_ISO_PART[self.part]
        if missing := [name for name in needed if getattr(self, name) is None]:
            raise ValueError(f"part {self.part} needs {' and '.join(missing)}")
        if others := [n for keys in KEYS_OF_ISO_PART.values() for n in keys if n not in needed and getattr(self, n)]:
            text = f"{', '.join(others)} is not of part {self.part}, which has {' and '.join(needed)}"
            raise ValueError(f"{text}; remove it")
        return self


class MachineTable(Table):
    """The machine: its masses, shaft, speed and bearings."""

    iso20816: Iso20816Table | None = None


class EstimatorTable(Table):
    method: Literal["spectral", "score-matching"] = "spectral"
    time_constant_s: Positive = 10.0
    watch: Literal["usual", "catalogue", "none"] = "usual"


class LinearTable(Table):
    """N/m, N s/m, N^2/Hz (one-sided): start of a fit, truth of a simulation. Left out: unknown."""

    kL: SettingTable | None = None
    c: SettingTable | None = None
    S: SettingTable | None = None


class LinearNode(Table):
    x: LinearTable | None = None
    y: LinearTable | None = None


class LinearNodes(ByBearing):
    bearing1: LinearNode | None = None
    bearing2: LinearNode | None = None
    __pydantic_extra__: dict[str, LinearNode] = Field(init=False)


class CustomTable(Table):
    """A user's own restoring force, by expression or by module = "FILE.py:NAME".

    candidate : not in the model, but on trial when it is diagnosed, like an effect of the catalogue, until
    model.effects names it.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    expression: str | None = None
    module: Annotated[str, Field(pattern=r"^.+\.py:[A-Za-z_]\w*$")] | None = None
    parameters: dict[str, SettingTable] = {}
    at: str | list[str] | None = None
    candidate: bool = False

    @model_validator(mode="after")
    def one_source(self) -> CustomTable:
        if (self.expression is None) == (self.module is None):
            raise ValueError("give expression or module, one of the two")
        return self


class ModelTable(BaseModel):
    """Linear stiffness and damping are always there. [model.EFFECT] tables are checked against the catalogue."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False, frozen=True)
    effects: list[str] = []
    linear: LinearNodes = LinearNodes()
    custom: list[CustomTable] = []
    __pydantic_extra__: dict[str, dict[str, Any]] = Field(init=False)


class SensitivityTable(Table):
    """Sensitivity of a sensor: volts for each unit of the quantity measured. A negative value turns the sign."""

    value: float
    unit: Annotated[str, Field(description='such as "mV/g" or "mV/(m/s^2)"')]

    @field_validator("value")
    @classmethod
    def some(cls, value: float) -> float:
        if value == 0:
            raise ValueError("0: a sensor that gives nothing; give what its certificate says")
        return value

    @field_validator("unit")
    @classmethod
    def of_a_voltage(cls, value: str) -> str:
        if sensitivity_parts(value)[0] not in VOLTS_OF_UNIT:
            raise ValueError(f'"{value}" is not a voltage for each unit; write it as "mV/g", "mV/(m/s^2)" or "V/mm"')
        return value

    @property
    def denominator(self) -> str:
        """The unit of what is measured."""
        return sensitivity_parts(self.unit)[1]

    def volts_per_si(self, kind: str) -> float:
        """Volts for one SI unit of `kind`. Raises ValueError if it is no sensitivity of that kind."""
        return self.value * VOLTS_OF_UNIT[sensitivity_parts(self.unit)[0]] / factor(kind, self.denominator)


class ChannelTable(Table):
    """A measured channel. Direction z (axial) is recorded only."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z_][\w.-]*$")]
    kind: Literal["acceleration", "velocity", "displacement", "force", "tacho"] = "acceleration"
    node: str | None = Field(default=None, validate_default=True, description="name of the bearing; not of a tacho")
    direction: Literal["x", "y", "z"] | None = Field(default=None, validate_default=True, description="not of a tacho")
    sensitivity: SensitivityTable | None = Field(default=None, description="of its sensor, for values in volts")
    unit: str = Field(description="of the values, where the file or the device does not say it")
    offset: float = Field(default=0.0, description="the value at rest, in that unit: it is subtracted")
    alias: str | None = Field(default=None, description="its name in files of others")

    @field_validator("node", "direction")
    @classmethod
    def known(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is None and info.data.get("kind") != "tacho":
            raise ValueError("is missing; add it")
        return value

    @field_validator("unit")
    @classmethod
    def of_the_kind(cls, value: str, info: ValidationInfo) -> str:
        kind, sensitivity = info.data.get("kind"), info.data.get("sensitivity")
        if kind is None or (canonical(value) in VOLTS_OF_UNIT and sensitivity is not None):
            return value
        if canonical(value) in VOLTS_OF_UNIT and canonical(value) not in UNITS_OF_KIND[kind]:
            raise ValueError(f'"{value}" needs the sensor: add sensitivity = {{ value = 100.0, unit = "mV/g" }}')
        factor(kind, value)
        return value

    @field_validator("sensitivity")
    @classmethod
    def of_that_kind(cls, value: SensitivityTable | None, info: ValidationInfo) -> SensitivityTable | None:
        if value is not None and "kind" in info.data:
            value.volts_per_si(info.data["kind"])
        return value

    @property
    def quantity_unit(self) -> str:
        """The unit of what is measured: for values in volts, that of the sensitivity."""
        volts = canonical(self.unit) in VOLTS_OF_UNIT and self.sensitivity is not None
        return self.sensitivity.denominator if volts and self.sensitivity else self.unit


class LinkTable(Table):
    """The link (--link overrides it); with dbc and a signal map (channel = "MESSAGE.SIGNAL") for devices of others."""

    url: str | None = None
    dbc: str | None = Field(default=None, description="path from the rig file")
    signals: dict[str, Annotated[str, Field(pattern=r"^[^.]+\.[^.]+$")]] = {}


class RigFile(Table):
    """A Rotorscope rig file (TOML)."""

    schema_: Literal[1] = Field(alias="schema", description="version of this format")
    rig: RigTable = Field(default=RigTable(), description="shaft, masses, speed, bearings")
    band: BandTable = Field(description="of the analysis, Hz")
    acquisition: AcquisitionTable | None = Field(default=None, description="rate and filter of the recorder")
    machine: MachineTable = Field(default=MachineTable(), description="its class, for zones of vibration")
    estimator: EstimatorTable = Field(default=EstimatorTable(), description="the rolling estimate of a session")
    model: ModelTable = Field(default=ModelTable(), description="effects, and values to start from")
    channel: Annotated[list[ChannelTable], Field(min_length=1, description="what is measured, and where")]
    link: LinkTable = Field(default=LinkTable(), description="the device, if `--link` does not say it")
    alarm: list[AlarmTable] = Field(default=[], description="limits and changes that are told")
