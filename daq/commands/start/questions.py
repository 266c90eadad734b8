"""A few questions on a terminal: enough for a rig file that works."""

from __future__ import annotations

from collections.abc import Callable

from daq.rig.rig_table import of_designation

from .guess import RADIAL_PLACES, Guess, kind_of_unit
from .text import NewRig

MAX_CHANNELS = 4


def ask(name: str, answer: Callable[[str], str] = input) -> NewRig:
    """The rig by the answers; an empty answer takes what stands in brackets.

    answer : asks a question and returns what was typed.
    """
    count = int(_number(answer, "How many accelerometers or velocity sensors, 1 to 4? [2] ", 2.0, MAX_CHANNELS) or 2)
    unit = _unit(answer)
    rate_hz = _number(answer, "Sampling rate in Hz, if known? [unknown] ", None)
    speed_rpm = _number(answer, "Speed of the shaft in rpm, if known? [unknown] ", None)
    mass_kg = _number(answer, "Mass that moves with a bearing cap in kg, if known? [unknown] ", None)
    bearing = _bearing(answer)
    kind = kind_of_unit(unit)
    channels = [
        Guess(name=f"b{node[-1]}{direction}", source=f"b{node[-1]}{direction}", kind=kind, unit=unit, node=node,
              direction=direction, sure=True)
        for node, direction in RADIAL_PLACES[:count]
    ]  # fmt: skip
    return NewRig(
        name=name, origin="Written by rotorscope init from answers.", channels=channels, rate_hz=rate_hz,
        speed_rpm=speed_rpm, mass_kg=mass_kg, designation=bearing,
    )  # fmt: skip


def _number(answer: Callable[[str], str], question: str, default: float | None, most: float = 1e9) -> float | None:
    while True:
        text = answer(question).strip().replace(",", ".")
        if not text:
            return default
        try:
            value = float(text)
        except ValueError:
            value = 0.0
        if 0 < value <= most:
            return value
        question = f"A number above 0, at most {most:g}, or nothing: "


def _unit(answer: Callable[[str], str]) -> str:
    question = "Unit of the values (m/s^2, g, mm/s)? [m/s^2] "
    while True:
        text = answer(question).strip() or "m/s^2"
        if kind_of_unit(text) in ("acceleration", "velocity", "displacement"):
            return text
        question = "A unit such as m/s^2, g, mg, mm/s, um: "


def _bearing(answer: Callable[[str], str]) -> str:
    question = "Designation of the bearing, such as 6205? [unknown] "
    while True:
        text = answer(question).strip()
        if not text or of_designation(text) is not None:
            return text
        question = f"{text} is not in our table; leave it empty, and give its geometry in the file: "
