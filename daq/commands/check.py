"""`rotorscope check`: a summary of what a rig file says (problems come from load_rig)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text
from scipy.linalg import eigh

from daq.base.console.output import Output
from daq.rig.rig import Rig, check_laws, load_rig
from daq.rig.rotor_table import read_matrices
from daq.session.links import check_signals
from estimator.model import Model, RotorMatrices, Setting, assemble

MAX_MODES_SHOWN = 8
OUR_PACKAGES = ("daq", "drivers", "estimator")
SHAFT_WORDS = {
    "chain": "chain (caps joined through the disc)",
    "beam": "free-free beam",
    "matrices": "matrices",
    "none": "none: caps uncoupled",
}


def check(output: Output, path: Path) -> None:
    rig = load_rig(path)
    check_laws(rig, path)
    check_signals(rig)
    remarks = _remarks(rig) + overwritten()
    notes = [f"note: {text}" for text in remarks]
    value = {"schema": 1, "valid": True, "summary": _facts(rig), "notes": remarks}
    output.result(value, _summary(rig), "", *notes, f"{path}: valid")


def overwritten() -> list[str]:
    """Other packages with files of the same names as Rotorscope's, so that either may be imported."""
    from importlib.metadata import distributions  # packages_distributions takes half the time of a whole check

    owners: dict[str, set[str]] = {name: set() for name in OUR_PACKAGES}
    for other in distributions():
        files = "\n" + (other.read_text("RECORD") or "")
        for name in OUR_PACKAGES:
            if f"\n{name}/" in files and other.name != "rotorscope":
                owners[name].add(other.name)
    return [
        f'the package "{name}" is also installed by {", ".join(sorted(others))}: uninstall that, '
        "and install rotorscope again"
        for name, others in owners.items()
        if others
    ]


def _facts(rig: Rig) -> dict[str, Any]:
    model = rig.model
    return {
        "name": model.name,
        "shaft": model.shaft,
        "bearings": list(model.bearings),
        "speed_rpm": model.speed_rpm,
        "mass": dict(model.mass),
        "band": list(model.band),
        "channels": [
            {"name": c.name, "node": c.node, "direction": c.direction, "kind": c.kind, "unit": rig.units[c.name]}
            for c in model.channels
        ],
        "effects": [{"effect": use.name, "at": list(use.at)} for use in model.effects],
        "unknown": unknown(model),
        "link": rig.link.url,
    }


def unknown(model: Model) -> list[str]:
    """Parameters without a value in the file; a fit estimates them."""
    linear = [f"{place}.{k}" for place, table in model.linear.items() for k, s in table.items() if s.value is None]
    own = [
        f"{place}.{use.name}.{k}"
        for use in model.effects
        for place, table in use.parameters.items()
        for k, s in table.items()
        if s.value is None
    ]
    masses = dict.fromkeys(f"{p.split('.')[0]} mass" for p in model.places if model.cap_mass(p) is None)
    return [*masses, *linear, *own]


def _summary(rig: Rig) -> Table:
    model = rig.model
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    masses = ", ".join(f"{k} {v:g} kg" for k, v in model.mass.items()) or "unknown"
    rows = [
        ("rig", model.name),
        ("shaft", SHAFT_WORDS[model.shaft]),
        *_rotor_rows(model),
        ("speed", "not given" if model.speed_rpm is None else f"{model.speed_rpm:g} rpm"),
        ("masses", masses),
        ("analysis band", f"{model.band[0]:g} to {model.band[1]:g} Hz"),
        ("effects", ", ".join(f"{u.name} at {', '.join(u.at)}" for u in model.effects) or "linear only"),
        ("link", rig.link.url or "not given: say --link"),
    ]
    rows += [
        (f"channel {i}", f"{c.name}: {c.kind} of {c.place.rstrip('.')} in {rig.units[c.name]}")
        for i, c in enumerate(model.channels)
    ]
    for heading, text in rows:
        table.add_row(heading, Text(text))
    return table


def _rotor_rows(model: Model) -> list[tuple[str, str]]:
    """Properties of a rotor's matrices, to compare with the program that made them."""
    if model.rotor is None:
        return []
    bending, on_bearings = modes_hz(model, model.rotor)
    discs = ", ".join(model.discs) or "none"
    rows = [("bearings", ", ".join(model.bearings)), ("discs", discs), ("bending modes, free", _hz(bending))]
    return [*rows, ("modes on bearings", _hz(on_bearings))] if on_bearings else rows


def _hz(values: Sequence[float]) -> str:
    return ", ".join(f"{hz:.1f}" for hz in values[:MAX_MODES_SHOWN]) + " Hz" if values else "none in the band"


def modes_hz(model: Model, rotor: RotorMatrices) -> tuple[list[float], list[float]]:
    """Hz up to the end of the band: bending modes of the free shaft in x at rest, and damped modes of the rotor on its
    bearings at its speed, by the values of the file; none of these where a stiffness is unknown."""
    most = (2 * pi * model.band[1]) ** 2
    plane = rotor.only([i for i, dof in enumerate(rotor.dofs) if dof.endswith(".x")])
    p = eigh(plane.K, plane.M, eigvals_only=True)
    free = [sqrt(one) / (2 * pi) for one in p if 1e-8 * p[-1] < one < most]
    caps = [f"{n}.{d}" for n in model.bearings for d in "xy"]
    known = {c: model.linear[c] for c in caps if c in model.linear and model.linear[c]["kL"].value is not None}
    if len(known) < len(caps):
        return free, []
    given = {c: {**s} | {k: Setting(s[k].value or 0.0) for k in ("c", "S")} for c, s in known.items()}
    rig = assemble(replace(model, linear=given, effects=()))
    n = len(rig.dofs)
    flow = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(rig.M, np.hstack([rig.K, rig.C]))]])
    found = np.linalg.eigvals(flow).imag / (2 * pi)
    return free, sorted(found[(found > 0.0) & (found < model.band[1])].tolist())


def _remarks(rig: Rig) -> list[str]:
    model = rig.model
    remarks = []
    if model.rotor is not None:
        unmeasured = [n for n in model.bearings if not any(p.startswith(f"{n}.") for p in model.places)]
        if unmeasured:
            text = "not measured, so what it does acts on the others as excitation: measure every bearing"
            remarks.append(f"{', '.join(unmeasured)}: {text}")
        table = rig.file.rig.rotor
        if not model.speed_rpm and table is not None and "G" in read_matrices(table, rig.base, {}):
            remarks.append("no rig.speed_rpm: the gyroscopic matrix G does nothing")
    if missing := unknown(model):
        remarks.append(f"{len(missing)} values are not given and will be fitted: {_some(missing)}")
    if not any(model.cap_mass(p) for p in model.places):
        text = "no cap mass is known: forces and stiffnesses then rest on the shaft alone"
        remarks.append(text if model.shaft != "none" else "no mass is known: only ratios such as kL/m can be found")
    remarks += _resonances(model)
    for c in model.channels:
        if c.direction == "z":
            remarks.append(f"{c.name} is axial: recorded only")
    return remarks


def _resonances(model: Model) -> list[str]:
    """Where the file's own values put a cap on its bearing outside the band: most often a mistake of units."""
    out = []
    low, high = model.band
    for place in model.places:
        stiffness, mass = model.linear.get(place, {}).get("kL"), model.cap_mass(place)
        if stiffness is None or not stiffness.value or not mass:
            continue
        hz = sqrt(abs(stiffness.value) / mass) / (2 * pi)
        if not low < hz < high:
            text = f"{place}: kL = {stiffness.value:g} N/m on {mass:g} kg resonates at {hz:.3g} Hz, outside the band"
            out.append(f"{text} of {low:g} to {high:g} Hz; are they in N/m, kg and Hz?")
    return out


def _some(items: list[str], most: int = 6) -> str:
    return ", ".join(items[:most]) + (f" and {len(items) - most} more" if len(items) > most else "")
