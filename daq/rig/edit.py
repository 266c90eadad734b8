"""Edits a rig file for its owner; comments and layout are kept (tomlkit)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import Float, InlineTable, Trivia

from daq.base.console.output import Output, write_whole
from daq.base.contract.errors import ConfigError
from estimator.effects import CATALOGUE, MORE_LINES, NAMED, places
from estimator.results import Parameter

from .effects import at_places
from .problems import did_you_mean
from .rig import Rig, load_rig
from .toml_text import blocks, insert_key, insert_table, remove_tables

ANY_LINES = "without a frequency it stands for every line seen there; fit --out writes each: line, line_2 ..."


def add(output: Output, effect: str, path: Path, out: Path, at: Sequence[str]) -> None:
    rig = load_rig(path)
    text = with_effect(rig, effect, at)
    write_whole(out, text)
    what = f"added {effect}{_at(at)}" + (f" ({ANY_LINES})" if effect == "line" else "")
    _said(output, Rig.parse(text, out.parent, out, str(out)), out, what)


def remove(output: Output, effect: str, path: Path, out: Path, at: Sequence[str]) -> None:
    rig = load_rig(path)
    text = without_effect(rig, effect, at)
    write_whole(out, text)
    _said(output, Rig.parse(text, out.parent, out, str(out)), out, f"removed {effect}{_at(at)}")


def _at(at: Sequence[str]) -> str:
    return f" at {', '.join(at)}" if at else ""


def _said(output: Output, rig: Rig, out: Path, what: str) -> None:
    effects = [{"effect": use.name, "at": list(use.at)} for use in rig.model.effects]
    people = ", ".join(f"{use.name} ({', '.join(use.at)})" for use in rig.model.effects) or "linear only"
    output.result({"schema": 1, "effects": effects, "file": str(out)}, f"{out}: {what}; the effects are now {people}")


def with_effect(
    rig: Rig, effect: str, at: Sequence[str] = (), parameters: Mapping[str, Mapping[str, float]] | None = None
) -> str:
    """The text of the rig file with an effect added at places (none given: wherever it can act), its values left to
    the fit unless `parameters` (place -> name -> value) has them. Raises ConfigError for an unknown effect, a place
    where it cannot act, or one where it is already."""
    if effect not in NAMED:
        candidates = [u.name for u in rig.model.candidates]
        if effect in [c.name for c in rig.file.model.custom if c.name not in candidates]:
            raise ConfigError(f"{_where(rig)}: {effect} is a law of this file already; nothing to add")
        if effect not in candidates:
            remedy = did_you_mean(effect, [*CATALOGUE, *candidates], "there are")
            own = "a law of your own goes into the file as [[model.custom]]"
            raise ConfigError(f'"{effect}" is not an effect; {remedy} ({own})')
    use = next((u for u in rig.model.effects if u.name == effect), None)
    if use is not None and not at:
        raise ConfigError(
            f"{_where(rig)}: {effect} is in the model already, at {', '.join(use.at)}; {_again(rig, effect)}"
        )
    text = rig.text
    if use is None:
        text = _listed(text, effect)
    if at:
        wanted = places_at(rig, effect, at)
        if use is not None and (twice := [p for p in wanted if p in use.at]):
            raise ConfigError(f"{_where(rig)}: {effect} acts at {', '.join(twice)} already; choose another --at")
        places = dict.fromkeys([*(use.at if use else ()), *wanted])
        text = _with_at(text, effect, list(places), places_at(rig, effect, ["all"]))
    for place, values in (parameters or {}).items():
        text = _with_numbers(text, ("model", effect, *place.split(".")), values)
    return _checked(rig, text)


def _again(rig: Rig, effect: str) -> str:
    """Remedy for an effect that is already in the model everywhere."""
    taken = [use.name for use in rig.model.effects]
    further = next((name for name in MORE_LINES if name not in taken), None) if effect == "line" else None
    return "nothing to add" if further is None else f"a further line is called {further}"


def of_channels(rig: Rig, names: Sequence[str]) -> Rig:
    """The rig with some of its channels only, as if the others were not measured; () for all.

    Raises ConfigError for a channel that the rig does not have, or for a rig that is none without the others.
    """
    held = [c.name for c in rig.model.channels]
    for name in names:
        if name not in held:
            text = f'there is no channel "{name}"; {did_you_mean(name, held, "there are")}'
            raise ConfigError(f"{_where(rig)}: --channels: {text}")
    gone = set(held) - set(names) if names else set()
    if not gone:
        return rig

    places = {c.place for c in rig.model.channels if c.name in gone}
    places -= {c.place for c in rig.model.channels if c.name not in gone}
    for use in (*rig.model.effects, *rig.model.candidates):
        if unmeasured := [place for place in use.at if place in places]:
            rig = Rig.parse(without_effect(rig, use.name, unmeasured), rig.base, rig.path)

    def left_out(name: tuple[str, ...], table: str) -> bool:
        return name == ("channel",) and tomlkit.parse(table)["channel"][0].get("name") in gone

    document = tomlkit.parse(remove_tables(rig.text, left_out))
    tables: Any = document.get("channel", [])
    for k in [k for k, table in enumerate(tables) if table.get("name") in gone][::-1]:  # written inline
        del tables[k]
    link: Any = document.get("link", {})
    for name in gone & set(link.get("signals", {})):
        del link["signals"][name]
    where = f"{_where(rig)}, with --channels {','.join(names)}"
    return Rig.parse(tomlkit.dumps(document), rig.base, rig.path, where)


def without_effect(rig: Rig, effect: str, at: Sequence[str] = ()) -> str:
    """The text of the rig file without an effect, everywhere or at the places given. Raises ConfigError if it is not
    there."""
    use = next((u for u in rig.model.effects if u.name == effect), None)
    if use is None:
        names = [u.name for u in rig.model.effects]
        raise ConfigError(f"{_where(rig)}: {effect} is not in the model; {did_you_mean(effect, names, 'there are')}")
    gone = places_at(rig, effect, at) if at else use.at
    if missing := [p for p in gone if p not in use.at]:
        text = f"{effect} does not act at {', '.join(missing)}; it acts at {', '.join(use.at)}"
        raise ConfigError(f"{_where(rig)}: {text}")
    left = [p for p in use.at if p not in gone]
    if left:
        own = {("model", effect, *p.split(".")) for p in gone} | {("model", effect, p.split(".")[0]) for p in gone}
        own -= {("model", effect, p.split(".")[0]) for p in left}
        text = remove_tables(rig.text, lambda name, _: name in own)
        return _checked(rig, _with_at(text, effect, left, places_at(rig, effect, ["all"])))

    def condemned(name: tuple[str, ...], table: str) -> bool:
        own_law = name == ("model", "custom") and tomlkit.parse(table)["model"]["custom"][0].get("name") == effect
        return name[:2] == ("model", effect) or own_law

    document = tomlkit.parse(remove_tables(rig.text, condemned))
    model: Any = document.get("model", {})
    if effect in (listed := model.get("effects", [])):
        listed.remove(effect)
    if effect in model:  # written inline
        del model[effect]
    return _checked(rig, tomlkit.dumps(document))


def with_values(rig: Rig, parameters: Mapping[str, Parameter], digits: int = 9) -> str:
    """The text of the rig file with fitted values in [model...], and in [rig.mass] where it has none. Values
    that are not identifiable or fixed, and all other keys, are kept. digits : 17 for the exact values."""
    tables: dict[tuple[str, ...], dict[str, float]] = {}
    uses = {use.name: use for use in rig.model.effects}
    for name, parameter in parameters.items():
        *path, key = name.split(".")
        place = ".".join(path[:2])
        if parameter.value is None or not parameter.identifiable or not path:
            continue
        if path[-1] in uses:
            place = ".".join(path[:-1])
            now = uses[path[-1]].parameters.get(place, {}).get(key)
            if now is not None and not now.fixed:
                tables.setdefault(("model", path[-1], *path[:-1]), {})[key] = parameter.value
        elif key in ("kL", "c", "S") and len(path) == 2 and not rig.model.linear[place][key].fixed:
            tables.setdefault(("model", "linear", *path), {})[key] = parameter.value
        elif key == "m" and len(path) == 2 and rig.model.cap_mass(place) is None:
            tables.setdefault(("rig", "mass", path[0]), {})[path[1]] = parameter.value
    text = rig.text
    for table, values in tables.items():
        text = _with_numbers(text, table, values, digits)
    return _checked(rig, text)


def _where(rig: Rig) -> str:
    return str(rig.path or "rig file")


def _checked(rig: Rig, text: str) -> str:
    Rig.parse(text, rig.base, rig.path, _where(rig))
    return text


def places_at(rig: Rig, effect: str, at: Iterable[str]) -> tuple[str, ...]:
    """The places that --at means for an effect. Raises ConfigError for one where it cannot act."""
    items = [item.strip() for given in at for item in given.split(",")]
    possible = places(NAMED[effect], rig.model) if effect in NAMED else rig.model.places
    found, problems = at_places(items, possible, {c.name: c.place for c in rig.model.channels})
    if problems:
        raise ConfigError(f"--at: {effect}: {problems[0]}")
    return found


def _listed(text: str, effect: str) -> str:
    """The text with the effect at the end of model.effects."""
    document = tomlkit.parse(text)
    model: Any = document.get("model")
    if model is None or "effects" not in model:
        line = f'effects = ["{effect}"]'
        has_table = any(b.name == ("model",) for b in blocks(text.splitlines()))
        return insert_key(text, ("model",), line) if has_table else insert_table(text, ("model",), [line])
    model["effects"].append(effect)
    return tomlkit.dumps(document)


def _with_at(text: str, effect: str, at: Sequence[str], possible: Sequence[str]) -> str:
    """The text with `at` of an effect, a node's name standing for all of its places."""
    names: dict[str, None] = {}
    for place in at:
        node = place.split(".")[0]
        names[node if all(p in at for p in possible if p.split(".")[0] == node) else place] = None
    return _with_key(text, ("model", effect), "at", list(names))


def _with_numbers(text: str, table: tuple[str, ...], values: Mapping[str, float], digits: int = 9) -> str:
    for key, value in values.items():
        text = _with_key(text, table, key, _number(value, digits))
    return text


def _number(value: float, digits: int) -> Float:
    """A number as an engineer writes it: 10.4e6, 58.0, 90.0e-6."""
    exponent = 0 if value == 0 or 1e-3 <= abs(value) < 1e5 else 3 * math.floor(math.log10(abs(value)) / 3)
    shifted = Decimal(value).scaleb(-exponent)
    mantissa = f"{float(shifted):.{min(digits, 15)}g}"
    if float(f"{mantissa}e{exponent}") != value and digits > 15:
        mantissa = f"{shifted:.{digits}g}"
    if "." not in mantissa and "e" not in mantissa:
        mantissa += ".0"
    text = mantissa + (f"e{exponent}" if exponent else "")
    return Float(float(text), Trivia(), text)


def _with_key(text: str, name: tuple[str, ...], key: str, value: Any) -> str:
    """The text with one key set: in the place of the old value (within a table of value, fixed, ..., only `value`
    changes), at the end of its table, or in a new table."""
    document = tomlkit.parse(text)
    table = _at_path(document, name)
    line = f"{key} = {tomlkit.item(value).as_string()}"
    has_block = any(b.name == name for b in blocks(text.splitlines()))
    if table is None or (key not in table and not isinstance(table, InlineTable)):
        return insert_key(text, name, line) if has_block else insert_table(text, name, [line])
    if isinstance(table.get(key), Mapping):
        table[key]["value"] = value
    else:
        table[key] = value
    return tomlkit.dumps(document)


def _at_path(document: Any, name: Sequence[str]) -> Any:
    """The table of that name; None if there is none."""
    for part in name:
        document = document.get(part) if isinstance(document, Mapping) else None
    return document if isinstance(document, Mapping) else None
