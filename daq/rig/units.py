"""Units at the edge: what a rig file may say for each kind of channel, and its factor to SI."""

from __future__ import annotations

import re
from types import MappingProxyType

STANDARD_GRAVITY = 9.80665  # m/s^2, the standard value
UNITS_OF_KIND = MappingProxyType(
    {
        "acceleration": {
            "m/s^2": 1.0,
            "mm/s^2": 1e-3,
            "g": STANDARD_GRAVITY,
            "mg": 1e-3 * STANDARD_GRAVITY,
            "ug": 1e-6 * STANDARD_GRAVITY,
            "Gal": 1e-2,
            "cm/s^2": 1e-2,
            "um/s^2": 1e-6,
            "ft/s^2": 0.3048,
            "in/s^2": 0.0254,
        },
        "velocity": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "um/s": 1e-6, "in/s": 0.0254, "ft/s": 0.3048},
        "displacement": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "nm": 1e-9, "mil": 2.54e-5, "in": 0.0254},
        "force": {"N": 1.0, "kN": 1e3, "mN": 1e-3, "kgf": STANDARD_GRAVITY, "lbf": 4.4482216152605},
        "tacho": {"pulse": 1.0, "V": 1.0, "mV": 1e-3, "1": 1.0},  # a pulse train: one pulse a turn
    }
)
VOLTS_OF_UNIT = MappingProxyType({"V": 1.0, "mV": 1e-3, "uV": 1e-6})  # of channels with a sensitivity
SI_UNIT = MappingProxyType({kind: next(iter(units)) for kind, units in UNITS_OF_KIND.items()})
OF_LAWS = frozenset(("m", "s", "kg", "N", "Hz", "rad", "J", "W", "Pa"))  # of a law's parameters
_UNIT_SPELLINGS = str.maketrans(
    {"²": "2", "¹": "1", "⁻": "-", "−": "-", "µ": "u", "μ": "u", "·": "*", "⋅": "*", "×": "*"}
)
_INVERSE_SECONDS = re.compile(r"(u?m|[cm]m|ft|in)[*.]?s\^?\(?-([12])\)?")  # "m*s^-2", "mm.s-1"
_OTHER_SPELLINGS = MappingProxyType(
    {"gn": "g", "g_n": "g", "G": "g", "gravity": "g", "g's": "g", "gs": "g", "mG": "mg", "gal": "Gal", "micron": "um",
     "microns": "um", "inch": "in", "ips": "in/s", "mils": "mil", "thou": "mil", "lb": "lbf", "lbs": "lbf",
     "volt": "V", "Volt": "V", "volts": "V", "Volts": "V", "newton": "N", "Newton": "N",
     "kp": "kgf"}
)  # fmt: skip


def canonical(unit: str) -> str:
    """The unit as the table spells it: "m/s²", "m/s2", "m/s/s" and "m/s**2" are all "m/s^2"."""
    text = unit.strip().translate(_UNIT_SPELLINGS).replace(" ", "").replace("**", "^")
    text = text.replace("sec", "s").replace("*s^-1", "/s").replace("*s^-2", "/s^2").replace("(s^2)", "s^2")
    if text.endswith("/s/s"):
        text = text[:-4] + "/s^2"
    text = text[:-3] + "/s^2" if text.endswith("/s2") else text
    if inverse := _INVERSE_SECONDS.fullmatch(text):
        text = inverse[1] + ("/s" if inverse[2] == "1" else "/s^2")
    return _OTHER_SPELLINGS.get(text, text)


def is_unit(unit: str) -> bool:
    """Whether a channel may have this unit, or be in volts."""
    text = canonical(unit)
    return text in VOLTS_OF_UNIT or any(text in units for units in UNITS_OF_KIND.values())


def sensitivity_parts(unit: str) -> tuple[str, str]:
    """ "mV/(m/s^2)" as ("mV", "m/s^2")."""
    volts, _, quantity = unit.partition("/")
    quantity = quantity.strip()
    if quantity.startswith("(") and quantity.endswith(")"):
        quantity = quantity[1:-1]
    return canonical(volts), canonical(quantity)


def foreign(unit: str) -> str:
    """The first part of a parameter's unit that is not SI; "" where all are."""
    return next((part for part in re.findall(r"[^\W\d_]+|[%°]", unit) if part not in OF_LAWS), "")


def factor(kind: str, unit: str) -> float:
    """SI value of one `unit`. Raises ValueError naming the units that fit, and the kind that `unit` belongs to."""
    units = UNITS_OF_KIND[kind]
    text = canonical(unit)
    if text in units:
        return units[text]
    owner = next((k for k, table in UNITS_OF_KIND.items() if text in table), None)
    of = f" (it is one of {owner})" if owner else ""
    raise ValueError(f'"{unit}" is not a unit of {kind}{of}; use {", ".join(units)}')
