"""Values as a file or a device has them, to SI: by their unit, and the sensitivity and offset of the rig file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .units import UNITS_OF_KIND, VOLTS_OF_UNIT, canonical, factor

if TYPE_CHECKING:
    from .rig_file import ChannelTable


@dataclass(frozen=True, slots=True)
class Conversion:
    """SI value = value * scale + offset.

    unit : of the values, as the table of units spells it.
    """

    scale: float
    offset: float
    unit: str


def conversion(channel: ChannelTable, stated: str = "") -> Conversion:
    """How values of a channel become SI.

    stated : their unit as the file or the device says it; "": that of the rig file.
    Raises ValueError: what does not fit, and what to write.
    """
    own = canonical(channel.unit)
    unit = canonical(stated) or own
    if stated.isupper() and canonical(stated.lower()) in UNITS_OF_KIND[channel.kind] and unit not in VOLTS_OF_UNIT:
        unit = canonical(stated.lower())  # "MM/SEC", as old analysers write
    known = unit in UNITS_OF_KIND[channel.kind] or unit in VOLTS_OF_UNIT
    if not stated and channel.sensitivity is not None and own not in VOLTS_OF_UNIT:
        text = f'has a sensitivity and the unit "{channel.unit}" in the rig file, and the file says no unit'
        raise ValueError(f'{text}; write unit = "V" (or mV) if its values are volts, else leave the sensitivity out')
    if not known:
        owner = next((kind for kind, units in UNITS_OF_KIND.items() if unit in units), None)
        what = f"a unit of {owner}" if owner else "no unit known here"
        fitting = ", ".join(UNITS_OF_KIND[channel.kind])
        text = f'is in "{stated}" there, {what}; a channel of kind {channel.kind} may be in {fitting}'
        raise ValueError(f"{text}, or V with a sensitivity: correct kind, or the unit in the file")
    scale = _scale(channel, unit)
    return Conversion(scale, -channel.offset * _scale(channel, own) if channel.offset else 0.0, unit)


def _scale(channel: ChannelTable, unit: str) -> float:
    """SI value of one `unit`."""
    if unit in UNITS_OF_KIND[channel.kind]:
        return factor(channel.kind, unit)
    if channel.sensitivity is None:
        example = 'sensitivity = { value = 100.0, unit = "mV/g" }'
        if channel.kind != "acceleration":
            example = f'sensitivity = {{ value = 10.0, unit = "mV/({next(iter(UNITS_OF_KIND[channel.kind]))})" }}'
        raise ValueError(f'is in "{unit}" there; say what its sensor gives, in the rig file: {example}')
    return VOLTS_OF_UNIT[unit] / channel.sensitivity.volts_per_si(channel.kind)
