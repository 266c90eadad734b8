"""Kind, bearing and direction of a channel from its name and unit."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from daq.rig.units import UNITS_OF_KIND, canonical

RADIAL_PLACES = (("bearing1", "x"), ("bearing1", "y"), ("bearing2", "x"), ("bearing2", "y"))
SECOND_BEARING = re.compile(r"(?i)(?:^|[^a-z])(?:b|brg|bearing|cap|lager)[ _.-]*2|nde|(?:^|[^a-z])fe(?:[^a-z]|$)|fan")
AXIS_LETTER = re.compile(r"(?i)(?:^|[^a-z]|[a-z]*\d|acc(?:el(?:eration)?)?|vib|a|v)[ _.-]*([xyzhv])(?:[^a-z]|$)")
DIRECTION_OF_AXIS = {"h": "x", "v": "y"}  # horizontal, vertical
NO_SIGNAL = re.compile(r"(?i)^(?:index|sample|samples|row|counter|count|seq|temp\w*|status|crc|id)$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Guess:
    """A channel as the rig file is to have it.

    source : its name in the file, or "MESSAGE.SIGNAL". sure : whether the unit is known.
    """

    name: str
    source: str
    kind: str
    unit: str
    node: str
    direction: str
    sure: bool


def kind_of_unit(unit: str) -> str:
    """The kind of channel that a unit belongs to; "" where none, or where it is a tacho's."""
    text = canonical(unit) if unit else ""
    return next((kind for kind, units in UNITS_OF_KIND.items() if kind != "tacho" and text in units), "")


def plain_name(source: str) -> str:
    """A name that a rig file takes: "Acc X [g]" as "Acc_X"."""
    text = re.sub(r"[^\w.-]+", "_", source.strip()).strip("_.-") or "channel"
    return text if re.match(r"[A-Za-z_]", text) else f"ch_{text}"


def guesses(signals: Iterable[tuple[str, str]]) -> Iterator[Guess]:
    """Channels of signals (name, unit): each with a separate place. Signals that are no vibration are left out."""
    taken: set[tuple[str, str]] = set()
    names: set[str] = set()
    for source, unit in signals:
        kind = kind_of_unit(unit)
        last = source.rpartition(".")[2]
        if NO_SIGNAL.match(last) or (unit and not kind):
            continue
        place = _place(last, taken)
        if place is None:
            continue
        name = plain_name(last)
        while name in names:
            name += "_"
        names.add(name)
        taken.add(place)
        yield Guess(
            name=name, source=source, kind=kind or "acceleration", unit=canonical(unit) if kind else "m/s^2",
            node=place[0], direction=place[1], sure=bool(kind),
        )  # fmt: skip


def _place(name: str, taken: set[tuple[str, str]]) -> tuple[str, str] | None:
    """Bearing and direction by the name, else the next that is free; None where all are taken."""
    node = "bearing2" if SECOND_BEARING.search(name) else "bearing1"
    if found := AXIS_LETTER.search(name):
        letter = found[1].lower()
        direction = DIRECTION_OF_AXIS.get(letter, letter)
        other = "bearing2" if node == "bearing1" else "bearing1"
        for own in (node, other):
            if (own, direction) not in taken:
                return own, direction
    return next((place for place in RADIAL_PLACES if place not in taken), None)
