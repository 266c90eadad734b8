"""Whole tables in and out of a TOML text, line by line, so that comments stay with what they stand above.

tomlkit gives a comment that stands above a header to the table before it: it would go or stay with the wrong one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from .problems import TABLE_HEADER, parts

Name = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Block:
    """One [table] of a text: its lines from `start`, keys up to `body`, and what stands above the next up to `end`."""

    name: Name
    start: int
    body: int
    end: int


def blocks(lines: Sequence[str]) -> Iterator[Block]:
    """The tables of a text in order; the keys above the first header are table ()."""
    headers = [(i, parts(m[2])) for i, line in enumerate(lines) if (m := TABLE_HEADER.match(line))]
    starts = [(0, ()), *headers] if not headers or headers[0][0] > 0 else headers
    for k, (start, name) in enumerate(starts):
        end = starts[k + 1][0] if k + 1 < len(starts) else len(lines)
        keys = [i for i in range(start, end) if lines[i].strip() and not lines[i].lstrip().startswith("#")]
        body = keys[-1] + 1 if keys else start
        after = body
        while after < end and lines[after].lstrip().startswith("#"):
            after += 1
        if after == len(lines) or (after < end and not lines[after].strip()):
            body = after  # comments right below the keys, and not right above the next header
        yield Block(name, start, body, end)


def insert_table(text: str, name: Name, keys: Sequence[str]) -> str:
    """The text with a new table after the last one of its family (the same first name), else after all others."""
    lines = text.splitlines()
    all_blocks = list(blocks(lines))
    family = [b for b in all_blocks if b.name[:1] == name[:1]]
    at = (family or all_blocks)[-1].body
    new = [f"[{'.'.join(name)}]", *keys]
    before = [""] if at and lines[at - 1].strip() else []
    return "\n".join([*lines[:at], *before, *new, *lines[at:]]) + "\n"


def insert_key(text: str, name: Name, key: str) -> str:
    """The text with a line `key` at the end of the keys of an existing table."""
    lines = text.splitlines()
    at = next(b for b in blocks(lines) if b.name == name).body
    return "\n".join([*lines[:at], key, *lines[at:]]) + "\n"


def remove_tables(text: str, condemned: Callable[[Name, str], bool]) -> str:
    """The text without the tables for which condemned(name, their text) is true."""
    lines = text.splitlines()
    kept: list[str] = []
    for b in blocks(lines):
        if not condemned(b.name, "\n".join(lines[b.start : b.body])):
            kept += lines[b.start : b.end]
            continue
        rest = lines[b.body : b.end]
        if not any(line.strip() for line in rest) or (kept and not kept[-1].strip()):
            while rest and not rest[0].strip():
                rest.pop(0)
        kept += rest
    return "\n".join(kept) + "\n"
