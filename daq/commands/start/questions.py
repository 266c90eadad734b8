"""A few questions on a terminal: enough for a rig file that works."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable

from daq.base.contract.errors import ConfigError
from daq.rig.rig_table import of_designation

from .guess import RADIAL_PLACES, Guess, kind_of_unit
from .text import NewRig

MAX_CHANNELS = 4
MAX_ANSWER = 1e9
NOT_KNOWN = ("", "unknown")


def typed(question: str) -> str:
    """One answer from the terminal. Raises ConfigError where it ends before the last one."""
    try:
        return input(question)
    except EOFError:
        sys.stdout.write("\n")  # the question has no end of line
        raise ConfigError(
            "init: the answers ended before the last question, so no rig file was written; start again, "
            "or give --from FILE or --example NAME"
        ) from None


def ask(name: str, answer: Callable[[str], str] = typed) -> NewRig:
    """The rig by the answers; an empty answer takes what stands in brackets.

    answer : asks a question and returns what was typed.
    """
    count = _number(answer, "How many accelerometers or velocity sensors, 1 to 4? [2] ", MAX_CHANNELS)
    unit = _unit(answer)
    rate_hz = _number(answer, "Sampling rate in Hz, if known? [unknown] ")
    speed_rpm = _number(answer, "Speed of the shaft in rpm, if known? [unknown] ")
    mass_kg = _number(answer, "Mass that moves with a bearing cap in kg, if known? [unknown] ")
    bearing = _bearing(answer)
    kind = kind_of_unit(unit)
    channels = [
        Guess(name=f"b{node[-1]}{direction}", source=f"b{node[-1]}{direction}", kind=kind, unit=unit, node=node,
              direction=direction, sure=True)
        for node, direction in RADIAL_PLACES[: int(count or 2)]
    ]  # fmt: skip
    return NewRig(
        name=name, origin="Written by rotorscope init from answers.", channels=channels, rate_hz=rate_hz,
        speed_rpm=speed_rpm, mass_kg=mass_kg, designation=bearing,
    )  # fmt: skip


def _number(answer: Callable[[str], str], question: str, most: int | None = None) -> float | None:
    """A number above 0, None where it is left open. most : a whole number up to it is asked for."""
    again = question
    while True:
        text = answer(again).strip()
        if text in NOT_KNOWN:
            return None
        wanted = "is no number above 0" if most is None else f"is no whole number from 1 to {most}"
        two_ways = re.fullmatch(r"\d{1,3}(,\d{3})+", text) is not None
        if two_ways:
            wanted = f"can be read in two ways: type {text.replace(',', '')} or {text.replace(',', '.', 1)}"
        try:
            value = float(text.replace(",", "."))
        except ValueError:
            value = math.nan
        if not two_ways and 0 < value <= (most or MAX_ANSWER) and (most is None or value.is_integer()):
            return value
        again = f"{text}: {wanted}\n{question}"


def _unit(answer: Callable[[str], str]) -> str:
    again = question = "Unit of the values (m/s^2, g, mm/s)? [m/s^2] "
    while True:
        text = answer(again).strip() or "m/s^2"
        if kind_of_unit(text) in ("acceleration", "velocity", "displacement"):
            return text
        again = f"{text}: is no unit of a vibration; known are m/s^2, g, mg, mm/s, um and others\n{question}"


def _bearing(answer: Callable[[str], str]) -> str:
    again = question = "Designation of the bearing, such as 6205? [unknown] "
    while True:
        text = answer(again).strip()
        if text in NOT_KNOWN:
            return ""
        if of_designation(text) is not None:
            return text
        again = f"{text}: is not in the table; leave it empty, and give its geometry in the file\n{question}"
