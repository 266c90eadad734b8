"""The text of a new rig file, with a comment beside everything that the user is to check or may add."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

from .guess import Guess

RATE_PER_PASSED_HZ = 2.56  # what a recorder passes of its rate
DEFAULT_BAND_HZ = (10.0, 4000.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class NewRig:
    """Known properties of a new rig. origin : where the channels come from, for the first comment."""

    name: str
    origin: str
    channels: Sequence[Guess]
    rate_hz: float | None = None
    speed_rpm: float | None = None
    designation: str = ""
    mass_kg: float | None = None
    shaft: str = "none"
    dbc: str = ""


def rig_text(new: NewRig) -> str:
    """The rig file as TOML."""
    low, high = _band(new.rate_hz)
    lines = [
        f"# {new.origin}",
        "# rotorscope check FILE says what is open; the README has every key.",
        "schema = 1",
        "",
        "[rig]",
        f"name = {json.dumps(new.name)}",
        _said(f"shaft = {json.dumps(new.shaft)}", "chain or beam (with [rig.shaft_spring]); none: each cap by itself"),
        _open(new.speed_rpm, "speed_rpm = {!r}", 1480.0, "names 1X, 2X and the defects of the bearing"),
        "",
        _said("[rig.mass]", "kg, what moves with a bearing cap: gives N/m and N"),
        _open(new.mass_kg, "bearing1 = {!r}", 1.0, "a mass left out is unknown"),
        "",
    ]
    table = "[rig.bearing]" if new.designation else "# [rig.bearing]"
    lines += [
        _said(table, "names BPFO, BPFI, BSF, FTF; or balls, ball_diameter_mm, pitch_diameter_mm"),
        f"designation = {json.dumps(new.designation)}" if new.designation else '# designation = "6205"',
        "",
        _said("# [machine]", "zones of ISO 20816-3, of machines above 15 kW"),
        '# iso20816 = { part = 3, group = 2, support = "rigid" }',
        "",
        _said("[band]", "Hz: from well below the resonance of the bearing to what the sensor passes"),
        f"low = {low!r}",
        f"high = {high!r}",
        "",
    ]
    if new.rate_hz:
        lines += ["[acquisition]", f"rate_hz = {new.rate_hz!r}", ""]
    lines += ["[model]", _said("effects = []", "rotorscope diagnose says which is missing"), ""]
    for own in new.channels:
        lines += [*_channel(own, bool(new.dbc)), ""]
    if new.dbc:
        lines += ["[link]", f"dbc = {json.dumps(new.dbc)}", "", _said("[link.signals]", 'channel = "MESSAGE.SIGNAL"')]
        lines += [f"{json.dumps(c.name) if '.' in c.name else c.name} = {json.dumps(c.source)}" for c in new.channels]
    return "\n".join(lines).rstrip() + "\n"


def _said(text: str, comment: str) -> str:
    """A line with its comment."""
    return f"{text:<32} # {comment}"


def _open(value: float | None, form: str, example: float, comment: str) -> str:
    """A line with a value; as a comment where it is not known."""
    return _said(form.format(value) if value else "# " + form.format(example), comment)


def _band(rate_hz: float | None) -> tuple[float, float]:
    low, high = DEFAULT_BAND_HZ
    if rate_hz is None:
        return low, high
    high = float(f"{rate_hz / RATE_PER_PASSED_HZ:.3g}")
    return min(low, float(f"{high / 20:.2g}")), high


def _channel(own: Guess, on_link: bool) -> list[str]:
    lines = [
        "[[channel]]",
        f"name = {json.dumps(own.name)}",
        _said(f"node = {json.dumps(own.node)}", "check: bearing1 or bearing2"),
        _said(f"direction = {json.dumps(own.direction)}", "check: x, y across the shaft, z along it"),
        f"kind = {json.dumps(own.kind)}",
        f"unit = {json.dumps(own.unit)}"
        if own.sure
        else _said(f"unit = {json.dumps(own.unit)}", "check: not said there"),
    ]
    return lines if on_link or own.source == own.name else [*lines, f"alias = {json.dumps(own.source)}"]
