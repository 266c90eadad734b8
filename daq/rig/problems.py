"""Problems of a rig file, for people: path and line of each, and what to do about it."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

Path = tuple[str | int, ...]
TABLE_HEADER = re.compile(r"^\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(#.*)?$")
_KEY_LINE = re.compile(r"""^\s*((?:[\w-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w-]+|"[^"]*"|'[^']*'))*)\s*=""")
_KEY_PART = re.compile(r"""[\w-]+|"[^"]*"|'[^']*'""")


@dataclass(frozen=True, slots=True)
class Problem:
    path: Path
    text: str

    def line_number(self, lines: dict[Path, int]) -> int:
        """The nearest line to it in the file; 0 if there is none."""
        return next((lines[self.path[:n]] for n in range(len(self.path), 0, -1) if self.path[:n] in lines), 0)

    def line(self, where: str, lines: dict[Path, int]) -> str:
        """ "FILE:12: channel[2].unit: what is wrong and what to do"."""
        at = self.line_number(lines)
        return f"{where}{f':{at}' if at else ''}: {dotted(self.path)}: {self.text}".replace(": : ", ": ")


def dotted(path: Path) -> str:
    """("channel", 2, "unit") as channel[2].unit."""
    return "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")


def parts(key: str) -> tuple[str, ...]:
    """The names in a dotted key."""
    return tuple(p.strip("\"'") for p in _KEY_PART.findall(key))


def line_numbers(text: str) -> dict[Path, int]:
    """The line of every table header and key of a TOML text (keys of inline tables share their line)."""
    lines: dict[Path, int] = {}
    counts: dict[Path, int] = {}  # tables so far in each array of tables
    table: Path = ()
    for number, line in enumerate(text.splitlines(), 1):
        if header := TABLE_HEADER.match(line):
            table = ()
            names = parts(header[2])
            for i, part in enumerate(names):
                table += (part,)
                if header[1] == "[[" and i == len(names) - 1:
                    counts[table] = counts.get(table, -1) + 1
                if table in counts:
                    lines.setdefault(table, number)
                    table += (counts[table],)
            lines.setdefault(table, number)
        elif key := _KEY_LINE.match(line):
            path = table
            for part in parts(key[1]):
                path += (part,)
                lines.setdefault(path, number)
    return lines


def did_you_mean(word: str, words: Iterable[str], otherwise: str = "use") -> str:
    """A remedy: the nearest word, or all of them."""
    words = list(words)
    if question := _nearest(word, words):
        return question
    return f"{otherwise} {', '.join(words)}" if words else "remove it"


def _nearest(word: str, words: list[str]) -> str:
    """A question for the nearest word; "" where none is near."""
    near = difflib.get_close_matches(word.lower(), [w.lower() for w in words], n=1, cutoff=0.6)
    return f'did you mean "{next(w for w in words if w.lower() == near[0])}"?' if near else ""


def of_validation(
    error: ValidationError, table: type[BaseModel], prefix: Path = (), inside: Path = ()
) -> list[Problem]:
    """A pydantic error as problems, in our words. inside : where in `table` the validated part is."""
    errors = error.errors(include_url=False)
    places = [tuple(part for part in e["loc"] if part != "[key]") for e in errors]
    return [Problem(prefix + at, _text(e, table, inside + at)) for e, at in zip(errors, places, strict=True)]


def _text(e: Any, table: type[BaseModel], loc: Path) -> str:
    kind, given = e["type"], e.get("input")
    if kind == "extra_forbidden":
        return f"unknown key; {did_you_mean(str(loc[-1]), _keys(table, loc[:-1]), 'the keys here are')}"
    if kind == "missing":
        return "is missing; add it"
    if kind == "literal_error":
        allowed = re.findall(r"'([^']*)'", e["ctx"]["expected"]) or [e["ctx"]["expected"]]
        if len(allowed) == 1:
            return f"{_toml(given)} is not {allowed[0]}, the only value that is known"
        near = _nearest(str(given), allowed)
        return f"{_toml(given)} is not one of {', '.join(allowed)}" + (f"; {near}" if near else "")
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return f"{_toml(given)} is not a table"
    if kind == "value_error":
        return str(e["ctx"]["error"])
    if kind == "string_pattern_mismatch":
        return f"{_toml(given)} does not have the form {_FORM_WORDS.get(e['ctx']['pattern'], e['ctx']['pattern'])}"
    words = e["msg"].removeprefix("Input should be a valid ").removeprefix("Input should be ")
    return f"{_toml(given)} is not {'a ' if e['msg'].startswith('Input should be a valid') else ''}{words}"


_FORM_WORDS = {
    r"^[a-z][a-z0-9_]*$": "of a name: small letters, digits and _",
    r"^.+\.py:[A-Za-z_]\w*$": '"FILE.py:NAME"',
    r"^[A-Za-z_][\w.-]*$": "of a name: letters, digits, _ . -, not beginning with a digit",
    r"^[^.]+\.[^.]+$": '"MESSAGE.SIGNAL"',
}


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return "a table" if isinstance(value, dict) else "a list" if isinstance(value, list) else str(value)


def _keys(table: type[BaseModel], loc: Sequence[str | int]) -> list[str]:
    """The keys that the table at `loc` may have."""
    for part in loc:
        if isinstance(part, int):
            continue
        field = next((f for name, f in table.model_fields.items() if part in (name, f.alias)), None)
        inner = [] if field is None else [t for t in _types(field.annotation) if issubclass(t, BaseModel)]
        if inner:
            table = inner[0]
    return [f.alias or name for name, f in table.model_fields.items()]


def _types(annotation: Any) -> list[type]:
    if isinstance(annotation, type) and not get_args(annotation):
        return [annotation]
    return [t for a in get_args(annotation) for t in _types(a)]
