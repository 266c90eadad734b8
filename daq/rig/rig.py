"""The rig file: TOML in, an `estimator.model.rig.Model` in SI out, every problem reported at once."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from daq.base.console.file_kinds import is_log
from daq.base.contract.errors import ConfigError
from estimator.effects import NAMED
from estimator.model import (
    BEARING_NODES,
    MOTION_UNITS,
    AntiAlias,
    Channel,
    MachineClass,
    Model,
    RotorMatrices,
    Setting,
    Shaft,
)

from .alarm_table import AlarmTable, alarm_problems
from .effects import effects_of, setting
from .problems import Problem, did_you_mean, line_numbers, of_validation
from .rig_file import AcquisitionTable, ChannelTable, EstimatorTable, LinkTable, MachineTable, RigFile
from .rig_table import RigTable, name_problems
from .rotor_table import RotorError, attachment, check_directions, read_matrices, rotor_of_table
from .units import SI_UNIT, factor

_DECIMAL_COMMA = re.compile(r"^\s*[\w.-]+\s*=\s*([-+]?\d+,\d+)\s*(?:#.*)?$")
MAX_CHARACTERS, MAX_DOTS = 200_000, 100  # characters of a file; dots in a line


@dataclass(frozen=True)
class Rig:
    """A checked rig file.

    text : as it was read, with its comments.
    base : folder that relative paths in it start from.
    path : of the file; None if the text came out of a log.
    file : its tables, in the units of the file.
    model : what the estimator takes, in SI.
    """

    text: str
    base: Path
    path: Path | None
    file: RigFile
    _: KW_ONLY
    model: Model

    @classmethod
    def parse(
        cls, text: str, base: Path | None = None, path: Path | None = None, where: str = "rig file",
        attached: Mapping[str, bytes] = MappingProxyType({}),
    ) -> Rig:  # fmt: skip
        """The rig that a TOML text describes. Raises ConfigError with one line for each problem.

        No Python file is run for a text from a log. attached : the other files in the log.
        """
        base = base or Path()
        modules = None if path is None else base
        data = _toml(text, where)
        problems = _tables(data, modules)
        if not problems:
            try:
                file = RigFile.model_validate(data)
                model, problems = _model(file, modules, path, attached)
            except ValidationError as error:
                problems = of_validation(error, RigFile)
            except RotorError as error:
                problems = [Problem(("rig", "rotor", error.key), str(error))]
        if problems:
            lines = line_numbers(text)
            problems.sort(key=lambda problem: problem.line_number(lines))
            raise ConfigError("\n".join(dict.fromkeys(problem.line(where, lines) for problem in problems)))
        return cls(text, base, path, file, model=model)

    @property
    def acquisition(self) -> AcquisitionTable | None:
        """The [acquisition] table; None if the file has none."""
        return self.file.acquisition

    @property
    def estimator(self) -> EstimatorTable:
        """The [estimator] table: method and time constant of the rolling estimate."""
        return self.file.estimator

    @property
    def alarms(self) -> list[AlarmTable]:
        """The [[alarm]] tables."""
        return self.file.alarm

    @property
    def link(self) -> LinkTable:
        """The [link] table: name of the link, DBC, signals."""
        return self.file.link

    @cached_property
    def units(self) -> MappingProxyType[str, str]:
        """Channel name -> its unit in the file; of a channel in volts, that of what its sensor measures."""
        return MappingProxyType({c.name: c.quantity_unit for c in self.file.channel})

    @cached_property
    def factors(self) -> NDArray[np.float64]:
        """(channels,) SI value of one of each channel's unit."""
        return np.array([factor(c.kind, c.quantity_unit) for c in self.file.channel])

    @cached_property
    def si_units(self) -> tuple[str, ...]:
        """SI unit of each channel, in the order of `model.channels`."""
        return tuple(SI_UNIT[c.kind] for c in self.file.channel)

    @property
    def dbc(self) -> Path | None:
        """Where the DBC of [link] is."""
        return None if self.link.dbc is None else self.base / self.link.dbc

    def attachments(self) -> dict[str, bytes]:
        """Files that a log must hold to be replayed alone: the rig file, the DBC, modules of laws of the user's own.

        Paths of this computer that stand in a log are not followed.
        """
        files = {"rig.toml": self.text.encode()}
        if self.path is None:
            return files
        modules = {c.module.rpartition(":")[0] for c in self.file.model.custom if c.module}
        for path in [*([self.dbc] if self.dbc else []), *(self.base / m for m in sorted(modules))]:
            if path.is_file():
                files[path.name] = path.read_bytes()
        rotor = self.file.rig.rotor
        return files if rotor is None else files | attachment(rotor, self.base)


def _toml(text: str, where: str) -> dict[str, Any]:
    """The tables of a text. Refuses a text on which the library takes long or fails, and which no rig file needs."""
    if len(text) > MAX_CHARACTERS:
        raise ConfigError(f"{where}: larger than {MAX_CHARACTERS / 1e3:g} kB; a rig file has a few: check the path")
    for number, line in enumerate(text.splitlines(), 1):
        if line.count(".") > MAX_DOTS and not line.lstrip().startswith("#"):
            raise ConfigError(
                f"{where}:{number}: a key of more than {MAX_DOTS} levels, or much in one line; simplify it"
            )
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ConfigError(f"{where}: lists or tables nested too deeply; a rig file needs a few levels") from error
    except ValueError as error:  # of TOML, or a whole number of thousands of digits
        for number, line in enumerate(text.splitlines(), 1):
            if comma := _DECIMAL_COMMA.match(line):
                point = comma[1].replace(",", ".")
                raise ConfigError(f"{where}:{number}: {comma[1]}: a decimal comma; write {point}") from error
        raise ConfigError(f"{where}: not a TOML file: {error}; correct that line first") from error


def load_rig(path: str | Path) -> Rig:
    """Read and check a rig file.

    Parameters
    ----------
    path : path
        A TOML file; its keys are in docs/rig.schema.json.

    Returns
    -------
    Rig
        ``model`` is the `estimator.Model`, in SI; ``acquisition``, ``link`` and ``estimator`` are the other tables.

    Raises
    ------
    ConfigError
        The file is missing, no text or no TOML; or one line for each problem in it.

    Examples
    --------
    >>> from daq import load_rig
    >>> rig = load_rig("configs/one_bearing.toml")
    >>> [channel.name for channel in rig.model.channels], rig.model.band
    (['drive_x', 'drive_y'], (100.0, 4000.0))
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig") as file:
            text = file.read(MAX_CHARACTERS + 1)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such rig file; check the path, or make one: rotorscope init") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {_not_read(path, error)}") from error
    return Rig.parse(text, path.parent, path, str(path))


def _not_read(path: Path, error: OSError | UnicodeDecodeError) -> str:
    """Why a file is no rig file, with a remedy."""
    if isinstance(error, PermissionError):
        return f"cannot be read: {error.strerror}; ask its owner to let you read it"
    if isinstance(error, OSError):
        return f"cannot be read as a rig file: {error.strerror}; give a TOML file"
    if is_log(path):
        return "is a log (.mcap) and no rig file; give the rig file (TOML) here, and the log where LOG stands"
    return "cannot be read as a rig file: not a UTF-8 text; give a TOML file, or save it as UTF-8 if it is one"


def check_laws(rig: Rig, path: Path) -> None:
    """ConfigError with its line for a law of the user's that is not finite."""
    for use in rig.model.effects:
        if use.custom is not None:
            from estimator.effects.engine import custom_effect
            from estimator.errors import ModelError

            try:
                custom_effect(use)
            except ModelError as error:
                number = next((k for k, c in enumerate(rig.file.model.custom) if c.name == use.name), 0)
                key = "module" if use.custom.expression is None else "expression"
                line = line_numbers(rig.text).get(("model", "custom", number, key))
                where = f"{path}:{line}: " if line else f"{path}: "
                text = f"model.custom[{number}].{key}: {error}; correct it, or give values within its range"
                raise ConfigError(where + text) from error


def _tables(data: dict[str, Any], base: Path | None) -> list[Problem]:
    """Problems of each table separately, so that a mistake in one hides none in another; then of all together."""
    problems: list[Problem] = []
    parts: dict[str, Any] = {}
    for name, field in RigFile.model_fields.items():
        key = field.alias or name
        if key not in data:
            if field.is_required():
                problems.append(Problem((key,), _MISSING_TABLE[key]))
            continue
        table = _adapter(name)
        try:
            parts[key] = table.validate_python(data[key])
        except ValidationError as error:
            problems += of_validation(error, RigFile, (key,), (key,))
            wrong = {e["loc"][0] for e in error.errors() if e["loc"]}
            if isinstance(data[key], dict):  # its valid keys still take part in the checks across tables
                with suppress(ValidationError):
                    parts[key] = table.validate_python({k: v for k, v in data[key].items() if k not in wrong})
    known = [f.alias or name for name, f in RigFile.model_fields.items()]
    for key in data:
        if key not in known:
            problems.append(Problem((key,), f"unknown key; {did_you_mean(key, known, 'the keys here are')}"))
    return problems + _together(data, parts, base)


@cache
def _adapter(name: str) -> TypeAdapter[Any]:
    """The type adapter of one table, built once: building takes longer than checking."""
    return TypeAdapter(RigFile.model_fields[name].rebuild_annotation())


_MISSING_TABLE = {
    "schema": "schema = 1 is missing; add it as the first line",
    "band": "the [band] table is missing; add low and high, in Hz, of the analysis band",
    "channel": "there is no [[channel]] table; add one for each measured channel",
}


def _together(data: dict[str, Any], parts: dict[str, Any], base: Path | None) -> list[Problem]:
    problems: list[Problem] = []
    channels: list[ChannelTable] = parts.get("channel", [])
    seen: dict[Any, int] = {}
    for i, c in enumerate(channels):
        key = (c.node, c.direction, c.kind)
        if c.name in (names := [other.name for other in channels[:i]]):
            text = f'"{c.name}" is also the name of channel[{names.index(c.name)}]; rename one'
            problems.append(Problem(("channel", i, "name"), text))
        elif key in seen:
            what = "is a tacho" if c.kind == "tacho" else f"measures {c.kind} of {c.node}.{c.direction}"
            problems.append(Problem(("channel", i, "node"), f"channel[{seen[key]}] {what} already; correct one"))
        if c.kind in ("velocity", "displacement", "acceleration") and c.direction in ("x", "y"):
            other = next((k for k in seen if k[:2] == key[:2] and k[2] not in ("force", "tacho", c.kind)), None)
            if other is not None:
                text = f"channel[{seen[other]}] measures the motion of {c.node}.{c.direction} already; keep one of them"
                problems.append(Problem(("channel", i, "kind"), text))
        seen.setdefault(key, i)
    motions = [c for c in channels if c.kind in MOTION_UNITS and c.direction != "z"]
    if channels and not motions:
        text = "no channel measures the motion of a bearing in x or y; nothing can be estimated without one"
        problems.append(Problem(("channel",), text))
    band, acquisition = parts.get("band"), parts.get("acquisition")
    if band is not None and band.low == 0 and any(c.kind != "displacement" for c in motions):
        text = "0 Hz: acceleration and velocity cannot be integrated from 0 Hz; choose low well below the resonance"
        problems.append(Problem(("band", "low"), text))
    if band is not None and acquisition is not None and band.high >= acquisition.rate_hz / 2:
        text = f"{band.high:g} Hz is not below half of acquisition.rate_hz = {acquisition.rate_hz:g} Hz; lower it"
        problems.append(Problem(("band", "high"), text))
    filtered = None if acquisition is None else acquisition.anti_alias
    if filtered is not None and filtered.kind == "fir" and filtered.cutoff_hz >= parts["acquisition"].rate_hz / 2:
        text = f"{filtered.cutoff_hz:g} Hz is not below half of acquisition.rate_hz, at which a fir filter works"
        problems.append(Problem(("acquisition", "anti_alias", "cutoff_hz"), text))
    link: LinkTable | None = parts.get("link")
    for name in link.signals if link and channels else ():
        if name not in (names := [c.name for c in channels]):
            text = f"there is no channel of this name; {did_you_mean(name, names, 'there are')}"
            problems.append(Problem(("link", "signals", name), text))
    if "rig" in parts or "rig" not in data:
        problems += name_problems(parts.get("rig", RigTable()), channels, parts.get("model"))
    if channels and "alarm" in parts:
        places = [f"{c.node}.{c.direction}" for c in motions]
        classed = parts["machine"].iso20816 is not None if "machine" in parts else "machine" in data
        problems += alarm_problems(parts["alarm"], [c.name for c in channels], places, classed)
    if "model" in parts:
        shaft: Shaft = parts["rig"].shaft if "rig" in parts else "none" if "rig" not in data else "chain"
        rpm = parts["rig"].speed_rpm if "rig" in parts else None if "rig" not in data else 1.0
        nodes = tuple(dict.fromkeys(c.node for c in channels if c.node))
        bearings = parts["rig"].names if "rig" in parts else nodes or BEARING_NODES
        known = _channels(channels) if motions else tuple(Channel(f"{n}{d}", n, d) for n in bearings for d in "xy")
        rotor = None if "rig" not in parts or parts["rig"].rotor is None else parts["rig"].rotor.names
        model = Model(known, (1.0, 2.0), shaft, speed_rpm=rpm, bearings=bearings, rotor=rotor)
        problems += effects_of(parts["model"], NAMED, model, base)[1]
    return problems


def _model(
    file: RigFile, base: Path | None, path: Path | None, attached: Mapping[str, bytes]
) -> tuple[Model, list[Problem]]:  # fmt: skip
    rig, spring = file.rig, file.rig.shaft_spring
    rotor: RotorMatrices | None = None
    if rig.rotor is not None:
        matrices = read_matrices(rig.rotor, base, attached)
        rotor = rotor_of_table(rig.rotor, matrices, rig.speed_rpm or 0.0, file.band.high)
    model = Model(
        channels=_channels(file.channel),
        band=(file.band.low, file.band.high),
        shaft=rig.shaft,
        mass=rig.mass.by_place(rig.names),
        shaft_stiffness=spring.stiffness if spring else 0.0,
        shaft_damping=spring.damping if spring else 0.0,
        rotor=rotor,
        bearings=rig.names,
        speed_rpm=rig.speed_rpm or None,  # a shaft at rest has no angle
        ball_pass_order=rig.ball_pass_order,
        bearing=None if rig.bearing is None else rig.bearing.geometry,
        name=rig.name or (path.stem if path else "rig"),
        anti_alias=_anti_alias(file.acquisition),
        iso20816=_machine_class(file.machine),
    )
    if rig.rotor is not None and rotor is not None:
        check_directions(rig.rotor, rotor, model.places)
    effects, problems = effects_of(file.model, NAMED, model, base)
    linear = {p: dict.fromkeys(("kL", "c", "S"), Setting()) for p in model.places}
    for node in rig.names:
        for direction in ("x", "y"):
            table = getattr(getattr(file.model.linear, node, None), direction, None)
            if table is not None:
                given = {k: setting(s) for k in ("kL", "c", "S") if (s := getattr(table, k)) is not None}
                place = f"{node}.{direction}"
                linear[place] = linear.get(place, dict.fromkeys(("kL", "c", "S"), Setting())) | given
    waiting = {c.name for c in file.model.custom if c.candidate} - set(file.model.effects)
    candidates = tuple(use for use in effects if use.name in waiting)
    effects = tuple(use for use in effects if use.name not in waiting)
    return replace(model, linear=linear, effects=effects, candidates=candidates), problems


def _channels(tables: list[ChannelTable]) -> tuple[Channel, ...]:
    return tuple(Channel(c.name, c.node or "shaft", c.direction or "", c.kind) for c in tables)


def _anti_alias(table: AcquisitionTable | None) -> AntiAlias | None:
    own = None if table is None else table.anti_alias
    if own is None:
        return None
    return AntiAlias(kind=own.kind, order=own.order, cutoff_hz=own.cutoff_hz, ripple_db=own.ripple_db)


def _machine_class(table: MachineTable) -> MachineClass | None:
    own = table.iso20816
    return None if own is None else MachineClass(**own.model_dump())
