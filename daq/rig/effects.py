"""The [model] tables of effects: the places of each effect, and a setting for every parameter there."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path as Folder
from typing import Any

from pydantic import ValidationError

from estimator.effects import CATALOGUE, places
from estimator.model import CAP_DIRECTIONS, CustomLaw, Effect, EffectUse, Model, Setting

from .problems import Path, Problem, did_you_mean, of_validation
from .rig_file import CustomTable, ModelTable, SettingTable

OF_ALL = ("at", "fixed", "value", "min", "max")  # keys of the whole effect's table

_NO_SHAFT_ANGLE = (
    "needs the shaft angle, which is not known: give rig.speed_rpm or a tacho channel, or remove the effect"
)
_MODEL_KEYS = ("effects", "linear", "custom")


def at_places(
    items: Iterable[str], possible: Sequence[str], channels: Mapping[str, str]
) -> tuple[tuple[str, ...], list[str]]:
    """The places for names of places, nodes, channels, or "all"; and the problems in these names."""
    found: list[str] = []
    wrong: list[str] = []
    for item in items:
        place = channels.get(item, item)
        hits = [p for p in possible if place in (p, p.split(".")[0], "both", "all") or place.split(".")[0] == p]
        if not hits:
            known = dict.fromkeys([p.split(".")[0] for p in possible] + list(possible))
            otherwise = "there is" if len(known) == 1 else "there are"
            wrong.append(f'it cannot act at "{item}"; {did_you_mean(item, known, otherwise)}')
        found += hits
    return tuple(p for p in possible if p in found), wrong


def effects_of(
    table: ModelTable, catalogue: Mapping[str, Effect], model: Model, base: Folder | None
) -> tuple[tuple[EffectUse, ...], list[Problem]]:
    """The effects of a [model] table in their order, with those that are only candidates, and all problems.

    model : the rig without them; base : where paths of modules start; None: none is run.
    """
    channels = {c.name: c.place for c in model.channels}
    nodes = (*model.bearings, *model.discs, "disc", "shaft")
    problems: list[Problem] = []
    uses: list[EffectUse] = []
    extra: Mapping[str, dict[str, Any]] = table.__pydantic_extra__ or {}
    customs = {custom.name: custom for custom in table.custom}
    for i, custom in enumerate(table.custom):
        if custom.name in catalogue:
            text = f'"{custom.name}" is the name of an effect of the catalogue; give the law another'
            problems.append(Problem(("model", "custom", i, "name"), text))
        if [c.name for c in table.custom].index(custom.name) < i:
            problems.append(Problem(("model", "custom", i, "name"), f'"{custom.name}" is there twice; rename one'))
    names = list(dict.fromkeys([*table.effects, *customs]))
    for i, name in enumerate(table.effects):
        if name not in catalogue and name not in customs:
            known = [*CATALOGUE, *customs]
            text = f'"{name}" is not an effect; {did_you_mean(name, known, "there are")}'
            problems.append(Problem(("model", "effects", i), text))
        if name in table.effects[:i]:
            problems.append(Problem(("model", "effects", i), f'"{name}" is there twice; remove one'))
    for name in extra:
        if name not in names:
            remedy = did_you_mean(name, [*_MODEL_KEYS, *names, *CATALOGUE])
            if name in catalogue:
                remedy = "add it to model.effects, or remove the table"
            problems.append(Problem(("model", name), f"settings of an effect that the model does not have; {remedy}"))
    for name in names:
        settings = extra.get(name, {})
        if name in customs:
            path: Path = ("model", "custom", [c.name for c in table.custom].index(name))
            own = customs[name]
            law, possible, wrong = _law(own, model, base)
            problems += [Problem((*path, *where.split(".")), text) for where, text in wrong]
            reader = _Reader(path, tuple(law.units), possible, channels, problems=problems, nodes=nodes)
            values = reader.read({"at": own.at} if own.at else {})
            for settings_there in values.values():
                settings_there |= {k: setting(p) for k, p in own.parameters.items() if k in law.units}
            reader.path = ("model", name)
            uses.append(EffectUse(name, reader.read(settings, values), law))
        elif name in catalogue:
            effect = catalogue[name]
            parameters = tuple(p.name for p in effect.parameters)
            possible = places(effect, model)
            if not possible:
                i = table.effects.index(name)
                problems.append(Problem(("model", "effects", i), f'"{name}" {_nowhere(effect, model)}'))
            elif effect.turns and not _knows_shaft_angle(model):
                problems.append(Problem(("model", "effects", table.effects.index(name)), f'"{name}" {_NO_SHAFT_ANGLE}'))
            reader = _Reader(("model", name), parameters, possible, channels, problems=problems, nodes=nodes)
            uses.append(EffectUse(name, reader.read(settings)))
    return tuple(uses), problems


def _knows_shaft_angle(model: Model) -> bool:
    """Whether the shaft angle is known."""
    return bool(model.speed_rpm) or any(c.kind == "tacho" for c in model.channels)


def _law(
    own: CustomTable, model: Model, base: Folder | None
) -> tuple[CustomLaw, tuple[str, ...], list[tuple[str, str]]]:
    """A law of the user, the places where it can act, and its problems: (key, text)."""
    units = {k: p.unit or "1" for k, p in own.parameters.items()}
    if own.module is not None and base is None:
        text = f"{own.module} is a Python file, and none that a log names is run; give the rig file itself: --rig"
        return CustomLaw(None, own.module, units), model.places, [("module", text)]
    if own.module is not None and base is not None:
        from .custom_module import load_effect

        try:
            effect = load_effect(own.module, base)
        except ValueError as error:
            return CustomLaw(None, own.module, units), model.places, [("module", str(error))]
        known = {p.name: p.unit for p in effect.parameters}
        wrong = [
            ("parameters", f"{own.module} has no parameter {k}; {did_you_mean(k, known, 'it has')}")
            for k in units
            if k not in known
        ]
        if effect.turns and not _knows_shaft_angle(model):
            wrong.append(("module", f"{own.module} {_NO_SHAFT_ANGLE}"))
        return CustomLaw(None, own.module, known, effect), places(effect, model), wrong
    from estimator.effects.engine import ExpressionError, compile_law

    law = CustomLaw(own.expression, None, units)
    try:
        compile_law(own.expression or "", tuple(units))
    except ExpressionError as error:
        if error.parameter:
            return law, model.places, [(f"parameters.{error.parameter}", str(error))]
        return law, model.places, [("expression", f'"{_in_a_line(own.expression or "")}": {error}')]
    if re.search(r"\bphase\b", own.expression or "") and not _knows_shaft_angle(model):
        return law, model.places, [("expression", f"the law {_NO_SHAFT_ANGLE}")]
    return law, model.places, []


def _in_a_line(expression: str, most: int = 80) -> str:
    text = " ".join(expression.split())
    return text if len(text) <= most else f"{text[:most]} ..."


def _nowhere(effect: Effect, model: Model) -> str:
    """Why an effect can act nowhere in this rig, with a remedy."""
    if effect.kind in ("disc", "shaft") and model.shaft == "none":
        return 'acts on the disc or the shaft: say rig.shaft = "chain" or "beam", or remove it'
    if effect.kind == "disc":
        return "acts on a disc: name one in [rig.rotor] discs, or remove it"
    if effect.kind == "shaft":
        return 'acts on a massless shaft, and is not known for shaft = "matrices": remove it'
    if effect.scope == "bearings" and len(model.bearings) != 2:
        return f"is known for two bearings, and this rig has {len(model.bearings)}: remove it"
    return "couples x and y, or two bearings, and the channels do not measure both; remove it"


def setting(table: SettingTable) -> Setting:
    return Setting(table.value, table.fixed, table.min, table.max)


class _Reader:
    """Reads the table of one effect; problems are appended to `problems`."""

    def __init__(
        self,
        path: Path,
        parameters: tuple[str, ...],
        places: tuple[str, ...],
        channels: Mapping[str, str],
        *,
        problems: list[Problem],
        nodes: tuple[str, ...],
    ) -> None:
        self.path, self.parameters, self.places = path, parameters, places
        self.channels, self.problems, self.nodes = channels, problems, nodes

    def read(
        self, table: Mapping[str, Any], base: dict[str, dict[str, Setting]] | None = None
    ) -> dict[str, dict[str, Setting]]:
        """place -> parameter -> Setting, over `base` (without one: at every place, nothing known)."""
        shared, own = self._split(table)
        at = self._at(self.path, table["at"]) if "at" in table else None
        if at is None:
            given = [self._at((*self.path, k, "at"), s.at) for k, s in shared.items() if s.at is not None]
            at = tuple(p for p in self.places if any(p in g for g in given)) if given else tuple(base or self.places)
        out = {place: dict((base or {}).get(place) or dict.fromkeys(self.parameters, Setting())) for place in at}
        for name, s in shared.items():
            where = self._at((*self.path, name, "at"), s.at) if s.at is not None else at
            for place in (p for p in at if p in where):
                out[place][name] = setting(s)
        for place, name, s in own:
            if place in out:
                out[place][name] = setting(s)
            else:
                text = f"the effect does not act at {place}: it is not in `at`; add it there or remove this table"
                self.problems.append(Problem((*self.path, *place.split(".")), text))
        return out

    def _split(self, table: Mapping[str, Any]) -> tuple[dict[str, SettingTable], list[tuple[str, str, SettingTable]]]:
        """Settings for every place, and those of [model.EFFECT.PLACE] tables."""
        shared: dict[str, SettingTable] = {}
        own: list[tuple[str, str, SettingTable]] = []
        whole = {k: v for k, v in table.items() if k in OF_ALL and k != "at" and k not in self.parameters}
        for key, value in table.items():
            if key in self.parameters:
                self._setting((*self.path, key), value, whole if "fixed" in whole else {}, shared)
            elif key in self.nodes and isinstance(value, dict):
                own += self._node(key, value)
            elif key not in OF_ALL:
                keys = [*self.parameters, "at"]
                text = f"unknown key; {did_you_mean(key, keys, 'the keys here are')}"
                self.problems.append(Problem((*self.path, key), text))
        if set(whole) - {"fixed"} and len(self.parameters) == 1:
            self._setting(self.path, whole, {}, shared, self.parameters[0])
        elif set(whole) - {"fixed"}:
            text = f"there are several parameters: say of which one, as in {self.parameters[0]} = {{ value = 1.0 }}"
            self.problems.append(Problem((*self.path, next(iter(set(whole) - {"fixed"}))), text))
        return shared, own

    def _node(self, node: str, table: Mapping[str, Any]) -> list[tuple[str, str, SettingTable]]:
        out: list[tuple[str, str, SettingTable]] = []
        for key, value in table.items():
            read: dict[str, SettingTable] = {}
            if key in self.parameters:
                self._setting((*self.path, node, key), value, {}, read)
                out += [(p, key, s) for p in self.places if p.split(".")[0] == node for s in read.values()]
            elif key in CAP_DIRECTIONS and isinstance(value, dict):
                for name, inner in value.items():
                    if name in self.parameters:
                        self._setting((*self.path, node, key, name), inner, {}, read)
                    else:
                        text = f"unknown key; {did_you_mean(name, self.parameters, 'the keys here are')}"
                        self.problems.append(Problem((*self.path, node, key, name), text))
                out += [(f"{node}.{key}", name, s) for name, s in read.items()]
            else:
                keys = [*self.parameters, *CAP_DIRECTIONS]
                text = f"unknown key; {did_you_mean(key, keys, 'the keys here are')}"
                self.problems.append(Problem((*self.path, node, key), text))
        return out

    def _setting(
        self, path: Path, value: Any, whole: Mapping[str, Any], into: dict[str, SettingTable], name: str = ""
    ) -> None:
        if whole and not isinstance(value, dict):
            value = {"value": value}
        try:
            into[name or str(path[-1])] = SettingTable.model_validate({**value, **whole} if whole else value)
        except ValidationError as error:
            self.problems += of_validation(error, SettingTable, path)

    def _at(self, path: Path, at: Any) -> tuple[str, ...]:
        items = [at] if isinstance(at, str) else at
        if not isinstance(items, Iterable) or not all(isinstance(item, str) for item in items) or not items:
            text = f'at = {at!r}: a place such as "bearing1" or "bearing1.x", or a list of them'
            self.problems.append(Problem((*path, "at"), text))
            return self.places
        found, wrong = at_places(items, self.places, self.channels)
        where = path if path[-1] == "at" else (*path, "at")
        self.problems += [Problem(where, text) for text in wrong if self.places]
        return found or self.places
