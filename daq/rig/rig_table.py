"""[rig]: the machine. Masses, the shaft, the bearings and their names, as they are written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import radians
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field, GetJsonSchemaHandler, ValidationInfo, field_validator, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from estimator.model import BEARING_NODES, BearingGeometry

from .problems import Path, Problem, did_you_mean
from .rotor_table import MAX_BEARINGS, NodeName, RotorTable
from .table import NotNegative, NumberOrTable, Positive, Table

if TYPE_CHECKING:
    from .rig_file import ChannelTable, ModelTable

RESERVED_NAMES = ("disc", "shaft", "both", "all")  # of places that are no bearing
# Ring and ball dimensions inside a bearing are not standardised: makers differ by 1 to 2 % in the pitch diameter, which
# moves a defect order by less than 0.5 %. Values in the rig file go first.
BEARING_GEOMETRIES: dict[str, dict[str, int | float]] = {
    # Case Western Reserve University Bearing Data Center, bearing information (SKF 6203-2RS JEM, 6205-2RS JEM)
    "6203": {"balls": 8, "ball_diameter_mm": 6.746, "pitch_diameter_mm": 28.50},
    "6205": {"balls": 9, "ball_diameter_mm": 7.940, "pitch_diameter_mm": 39.04},
    # Wang et al., IEEE Trans. Reliability 69 (2020): XJTU-SY bearing data sets (LDK UER204)
    "UER204": {"balls": 8, "ball_diameter_mm": 7.92, "pitch_diameter_mm": 34.55},
    # Huang & Baddour, Data in Brief 21 (2018): University of Ottawa bearing data (ER16K)
    "ER16K": {"balls": 9, "ball_diameter_mm": 7.94, "pitch_diameter_mm": 38.52},
}
Names = Annotated[list[NodeName], Field(min_length=1, max_length=MAX_BEARINGS)]


class CapMass(NumberOrTable):
    """A cap's mass in kg: a number, or one for each direction."""

    x: Positive | None = None
    y: Positive | None = None

    @model_validator(mode="before")
    @classmethod
    def number(cls, data: Any) -> Any:
        if not isinstance(data, int | float) or isinstance(data, bool):
            return data
        if data <= 0:
            raise ValueError(f"{data:g} kg is not above 0; leave the key out if the mass is unknown")
        return {"x": float(data), "y": float(data)}


class ByBearing(Table):
    """A table with a key for each bearing, by its name: bearing1 and bearing2, or those that the rig file gives."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False, frozen=True)


class MassTable(ByBearing):
    """kg, by name of the bearing; a key left out is unknown and estimated if the data can tell.

    With shaft = "matrices" it is what moves with the bearing's node beside the matrices, and 0 if it is left out.
    """

    disc: Positive | None = None
    bearing1: CapMass | None = None
    bearing2: CapMass | None = None
    __pydantic_extra__: dict[str, CapMass] = Field(init=False)

    def by_place(self, names: tuple[str, ...]) -> dict[str, float]:
        """kg of the disc and of the caps of the named bearings, by bearing or by place such as "bearing1.x"."""
        out = {} if self.disc is None else {"disc": self.disc}
        for node in names:
            cap = getattr(self, node, None)
            if cap is None:
                continue
            if cap.x is not None and cap.x == cap.y:
                out[node] = cap.x
            else:
                out |= {f"{node}.{d}": m for d, m in (("x", cap.x), ("y", cap.y)) if m is not None}
        return out


class ShaftSpringTable(Table):
    """N/m and N s/m of each half of the shaft."""

    stiffness: NotNegative
    damping: NotNegative = 0.0


class BearingTable(Table):
    """Ball bearing geometry: kinematics, and with the groove's radius theory. A negative preload is a clearance."""

    designation: str | None = Field(default=None, description="of a bearing in our table, instead of its geometry")
    balls: Annotated[int, Field(ge=3, le=100)]
    ball_diameter_mm: Positive
    pitch_diameter_mm: Positive
    groove_radius_mm: Positive | None = Field(default=None, description="needed for theory alone")
    preload_um: float | None = None
    contact_angle_deg: Annotated[float, Field(ge=0, lt=90)] = 0.0

    @model_validator(mode="before")
    @classmethod
    def by_designation(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not isinstance(name := data.get("designation"), str):
            return data
        if (known := of_designation(name)) is not None:
            return known | data
        if {"balls", "ball_diameter_mm", "pitch_diameter_mm"} <= data.keys():
            return data
        known_names = ", ".join(BEARING_GEOMETRIES)
        raise ValueError(
            f'designation "{name}" is not in our table ({known_names}): give balls, ball_diameter_mm and '
            "pitch_diameter_mm"
        )

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The designation or the geometry is required."""
        table = dict(handler.resolve_ref_schema(handler(schema)))
        return table | {"anyOf": [{"required": ["designation"]}, {"required": table.pop("required")}]}

    @property
    def geometry(self) -> BearingGeometry:
        """In SI units."""
        return BearingGeometry(
            balls=self.balls,
            ball_diameter=1e-3 * self.ball_diameter_mm,
            pitch_diameter=1e-3 * self.pitch_diameter_mm,
            groove_radius=None if self.groove_radius_mm is None else 1e-3 * self.groove_radius_mm,
            preload=None if self.preload_um is None else 1e-6 * self.preload_um,
            contact_angle=radians(self.contact_angle_deg),
        )

    @field_validator("pitch_diameter_mm")
    @classmethod
    def holds_the_balls(cls, value: float, info: ValidationInfo) -> float:
        if value <= info.data.get("ball_diameter_mm", 0.0):
            raise ValueError("is not larger than ball_diameter_mm: the two may be swapped")
        return value

    @field_validator("groove_radius_mm")
    @classmethod
    def wider_than_the_ball(cls, value: float | None, info: ValidationInfo) -> float | None:
        if value is not None and value <= info.data.get("ball_diameter_mm", 0.0) / 2:
            raise ValueError("is not larger than half of ball_diameter_mm (a groove is about 0.52 ball diameters)")
        return value


class RigTable(Table):
    name: str = Field(default="", description="of the rig; without: that of the file")
    shaft: Literal["chain", "beam", "matrices", "none"] = Field(
        default="none", description="chain: caps joined through the disc; beam: a free shaft; none: each cap by itself"
    )
    bearings: Names | None = Field(default=None, description="their names; without: bearing1, bearing2")
    speed_rpm: NotNegative | None = Field(default=None, description="of the shaft; names 1X and the defects")
    ball_pass_order: Positive | None = Field(default=None, description="ball passes a turn, if geometry is unknown")
    mass: MassTable = Field(default=MassTable(), description="what is known of the masses, kg")
    shaft_spring: ShaftSpringTable | None = Field(
        default=None, validate_default=True, description="of each half of the shaft; of chain and beam"
    )
    rotor: RotorTable | None = Field(default=None, validate_default=True, description='of shaft = "matrices"')
    bearing: BearingTable | None = Field(default=None, description="its geometry; names BPFO, BPFI, BSF, FTF")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bearings."""
        return tuple(self.rotor.bearings if self.rotor is not None else self.bearings or BEARING_NODES)

    @field_validator("bearings")
    @classmethod
    def on_a_shaft(cls, value: list[str] | None, info: ValidationInfo) -> list[str] | None:
        shaft = info.data.get("shaft", "none")
        if value is not None and shaft == "matrices":
            raise ValueError("the names are those of [rig.rotor] bearings: remove this key")
        if value is not None and shaft != "none" and len(value) != 2:
            raise ValueError(f'shaft = "{shaft}" joins two bearings, not {len(value)}: use shaft = "matrices"')
        if value is not None and len(set(value)) < len(value):
            raise ValueError("a name is there twice; rename one")
        return value

    @field_validator("rotor")
    @classmethod
    def of_matrices(cls, value: RotorTable | None, info: ValidationInfo) -> RotorTable | None:
        shaft = info.data.get("shaft", "none")
        if shaft == "matrices" and value is None:
            raise ValueError('shaft = "matrices" needs [rig.rotor]: its file and its bearings')
        if shaft != "matrices" and value is not None:
            raise ValueError(f'is used by shaft = "matrices" alone, and the shaft is "{shaft}": set it')
        return value

    @field_validator("shaft_spring")
    @classmethod
    def of_a_shaft(cls, value: ShaftSpringTable | None, info: ValidationInfo) -> ShaftSpringTable | None:
        shaft = info.data.get("shaft", "none")
        if shaft == "matrices" and value is not None:
            raise ValueError('shaft = "matrices" has its stiffness in [rig.rotor]: remove this table')
        if shaft in ("chain", "beam") and value is None:
            raise ValueError(f'shaft = "{shaft}" needs [rig.shaft_spring] with its stiffness; or say shaft = "none"')
        return value


def of_designation(name: str) -> dict[str, int | float] | None:
    """The geometry of a bearing; None where the table lacks it.

    name : designation. Suffixes of seals, cages and clearance ("6205-2RS", "6205 C3") are left out: they do not change
    the geometry.
    """
    word = name.upper().replace("SKF", "").strip()
    first = word.split()[0].split("/")[0] if word else ""
    for known, geometry in BEARING_GEOMETRIES.items():
        rest = first.removeprefix(known)
        if first.replace("-", "").startswith(known) and not rest[:1].isdigit():
            return geometry
    return None


def name_problems(rig: RigTable, channels: Sequence[ChannelTable], model: ModelTable | None) -> list[Problem]:
    """Keys that name a bearing which the rig does not have, and names that no bearing may have."""
    names = rig.names
    out = [
        Problem(("rig", "rotor", "bearings") if rig.rotor else ("rig", "bearings"), f'"{n}" is no name for a bearing')
        for n in names if n in RESERVED_NAMES
    ]  # fmt: skip
    for i, c in enumerate(channels):
        if c.kind != "tacho" and c.node is not None and c.node not in names:
            near = did_you_mean(c.node, names, "")
            remedy = f"; {near}" if near.startswith("did") else ""
            out.append(Problem(("channel", i, "node"), f'"{c.node}" is not one of {", ".join(names)}{remedy}'))
    out += _unknown(("rig", "mass"), rig.mass, names, () if rig.rotor else ("disc",))
    out += [] if model is None else _unknown(("model", "linear"), model.linear, names)
    if rig.rotor is not None and rig.mass.disc is not None:
        out.append(Problem(("rig", "mass", "disc"), "discs are in the matrices of [rig.rotor]: remove this key"))
    return out


def _unknown(path: Path, table: ByBearing, names: Sequence[str], others: Iterable[str] = ()) -> list[Problem]:
    given = [*(table.model_fields_set - {"disc"}), *(table.__pydantic_extra__ or {})]
    known = [*others, *names]
    return [
        Problem((*path, key), f"unknown key; {did_you_mean(key, known, 'the keys here are')}")
        for key in dict.fromkeys(given) if key not in names
    ]  # fmt: skip
