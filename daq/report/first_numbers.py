"""The first numbers of a record in words and tables: levels, velocity with its zone, and why one is void."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from .numbers import number, unit_text

if TYPE_CHECKING:
    from estimator.identification.record import ChannelSeverity

Json = Mapping[str, Any]
ZONE_TEXT = {
    "A": "as of a new machine",
    "B": "good for unlimited operation",
    "C": "for a limited time only: plan the repair",
    "D": "severe enough to cause damage",
}
NAME_OF_KEY = {"velocity_rms_mm_s": "velocity", "displacement_rms_um": "displacement", "bands": "bands", "zone": "zone"}


def with_severity(record: Json, levels: Mapping[str, ChannelSeverity]) -> dict[str, Any]:
    """The part `record` of a diagnosis with the severity of each channel."""
    channels = {name: dict(own) | (levels[name].to_json() if name in levels else {})
                for name, own in record["channels"].items()}  # fmt: skip
    return dict(record) | {"channels": channels}


def severity_rows(channels: Json) -> tuple[list[str], list[list[str]]]:
    """Heading and cells of a table, a row for each channel."""
    headings = ["channel", "rms", "peak", "crest", "kurtosis", "v [mm/s]", "zone"]
    rows = []
    for name, own in channels.items():
        cells = [number(own["rms"]) + f" {unit_text(own['unit'])}" * (own["rms"] is not None), number(own["peak"])]
        cells += ["-" if own[key] is None else f"{own[key]:.1f}" for key in ("crest", "kurtosis")]
        rows.append([name, *cells, number(own["velocity_rms_mm_s"]), own["zone"] or "-"])
    return headings, rows


def band_rows(channels: Json) -> tuple[list[str], list[list[str]]]:
    """Heading and cells of the levels by band, a row for each channel that has any."""
    edges = list(dict.fromkeys((b["low_hz"], b["high_hz"]) for own in channels.values() for b in own["bands"]))
    rows = []
    for name, own in channels.items():
        level = {(b["low_hz"], b["high_hz"]): b["rms"] for b in own["bands"]}
        if level:
            rows.append([f"{name} [{unit_text(own['unit'])}]", *(number(level.get(edge)) for edge in edges)])
    return ["rms in"] + [f"{_hz(low)}-{_hz(high)}" for low, high in edges], rows


def _hz(value: float) -> str:
    return f"{value / 1000:g}k" if value >= 1000 else f"{value:g}"


def void_lines(channels: Json) -> list[str]:
    """Why numbers are void, a line for each reason."""
    found: dict[str, dict[str, list[str]]] = {}  # reason -> number -> channels
    for name, own in channels.items():
        for key, reason in own["void"].items():
            found.setdefault(reason, {}).setdefault(NAME_OF_KEY.get(key, key), []).append(name)
    lines = []
    for reason, keys in found.items():
        names = list(dict.fromkeys(name for own in keys.values() for name in own))
        where = "any channel" if len(names) == len(channels) > 1 else ", ".join(names)
        lines.append(f"no {', '.join(keys)} for {where}: {reason}")
    return lines


def zone_line(channels: Json, machine: Json | None) -> str:
    """The worst zone with what it means; "" without one."""
    zones = {name: own["zone"] for name, own in channels.items() if own["zone"]}
    if not zones or machine is None:
        return ""
    worst = max(zones.values())
    where = ", ".join(name for name, zone in zones.items() if zone == worst)
    return f"zone {worst} of {machine_words(machine)} at {where}: {ZONE_TEXT[worst]}"


def machine_words(machine: Json) -> str:
    """The standard, and the kind of machine."""
    if machine["part"] == 1:
        return f"ISO 10816-1 (class {machine['size']})"
    if machine["part"] == 7:
        return f"ISO 10816-7 (pump of category {machine['category']}, {machine['power_kw']:g} kW)"
    return f"ISO 20816-3 (group {machine['group']}, {machine['support']} support)"
