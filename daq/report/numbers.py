"""Numbers and units as an engineer reads them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

PREFIX_OF_POWER = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
TINY_VALUE = 1e-300  # a number below is shown as zero
SUPERSCRIPT_DIGITS = str.maketrans("0123456789-.", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻·")
PREFIXED_UNITS = ("m", "N", "N/m", "m/s", "s", "Hz")  # kg has its prefix already, and powers of a unit would mislead
UNIT_SPELLINGS = {"N s/m": "N·s/m", "N^2/Hz": "N²/Hz", "m/s^2": "m/s²"}


def unit_text(unit: str) -> str:
    """The unit with real superscripts."""
    raised = re.sub(r"\^(-?\d+(?:\.\d+)?)", lambda power: power[1].translate(SUPERSCRIPT_DIGITS), unit)
    return UNIT_SPELLINGS.get(unit) or raised


def prefix(peak: float, unit: str) -> tuple[float, str]:
    """Factor and prefixed unit that leave 1 to 1000 of `peak`: (1e9, "nm") for 3e-8 of "m"."""
    if not (peak > 0 and math.isfinite(peak)):
        return 1.0, unit_text(unit)
    exponent = min(9, max(-12, 3 * math.floor(math.log10(peak) / 3 + 1e-9)))
    return 10.0**-exponent, PREFIX_OF_POWER[exponent] + unit_text(unit)


def power(text: str, exponent: int) -> str:
    return text if not exponent else f"{text} × 10{str(exponent).translate(SUPERSCRIPT_DIGITS)}"


def number(value: float | None, digits: int = 3) -> str:
    """`digits` figures, with a power of ten where that reads better."""
    if value is None or not math.isfinite(value):
        return "-"
    if abs(value) < TINY_VALUE:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -3 <= exponent <= 4:
        return f"{float(f'{value:.{digits - 1}e}'):.{max(0, digits - 1 - exponent)}f}"
    return power(f"{value / 10.0**exponent:.{digits - 1}f}", exponent)


def interval(value: float, sd: float) -> str:
    """Value and 95 % interval with as many figures as the interval deserves: "1.30 ± 0.12 × 10¹⁸"."""
    half = 1.96 * sd
    if not (math.isfinite(value) and math.isfinite(half)) or half <= max(1e-9 * abs(value), TINY_VALUE):
        return number(value)
    top = math.floor(math.log10(max(abs(value), half)))
    exponent = 0 if -2 <= top <= 3 else 3 * (top // 3)
    places = max(0, 1 - math.floor(math.log10(half / 10.0**exponent)))
    pair = f"{value / 10.0**exponent:.{places}f} ± {half / 10.0**exponent:.{places}f}"
    return pair if not exponent else power(f"({pair})", exponent)


def fixed(value: float) -> str:
    """Five decimals and a real minus: log-likelihoods are compared in their last figures."""
    return f"{value:.5f}".replace("-", "\N{MINUS SIGN}")


def odds(p_value: float) -> str:
    """A p-value; beyond 1e-20 the figures mean nothing."""
    return "< " + power("1", -20)[4:] if p_value < 1e-20 else number(p_value, 2)


def percent(value: float) -> str:
    """Percentages without false precision."""
    if value == 0:
        return "0 %"
    return f"{value:.0f} %" if abs(value) >= 10 else f"{value:.1f} %" if abs(value) >= 0.095 else f"{value:.2f} %"


def parameter(p: Mapping[str, Any], brief: bool = False, digits: int = 3) -> str:
    """A parameter of the JSON results with its 95 % interval and unit, or (not if brief) why there is none."""
    value, sd, unit = p.get("value"), p.get("sd"), p.get("unit", "")
    if value is None:
        return f"not identifiable: {p['reason']}" if p.get("reason") and not brief else "not identifiable"
    gain = 1.0
    if unit in PREFIXED_UNITS:
        gain, unit = prefix(abs(value), unit)
    unit = "" if unit == "1" else unit_text(unit)
    return f"{interval(value * gain, sd * gain) if sd else number(value * gain, digits)} {unit}".strip()
