"""Names of bearings: every key and every channel of a rig file that names one has to name one that is there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from .problems import Path, Problem, did_you_mean
from .rig_file import ChannelTable, ModelTable
from .rig_table import ByBearing, RigTable

RESERVED_NAMES = ("disc", "shaft", "both", "all")  # of places that are no bearing


def name_problems(rig: RigTable, channels: Sequence[ChannelTable], model: ModelTable | None) -> list[Problem]:
    """What names a bearing that the rig does not have, and names that no bearing may have."""
    names = rig.names
    out = [
        Problem(("rig", "rotor", "bearings") if rig.rotor else ("rig", "bearings"), f'"{n}" is no name for a bearing')
        for n in names if n in RESERVED_NAMES
    ]  # fmt: skip
    for i, c in enumerate(channels):
        if c.kind != "tacho" and c.node is not None and c.node not in names:
            near = did_you_mean(c.node, names, "")
            remedy = f"; {near}" if near.startswith("did") else ""
            out.append(Problem(("channel", i, "node"), f'"{c.node}" is not one of {", ".join(names)}{remedy}'))
    out += _unknown(("rig", "mass"), rig.mass, names, () if rig.rotor else ("disc",))
    out += [] if model is None else _unknown(("model", "linear"), model.linear, names)
    if rig.rotor is not None and rig.mass.disc is not None:
        out.append(Problem(("rig", "mass", "disc"), "discs are in the matrices of [rig.rotor]: remove this key"))
    return out


def _unknown(path: Path, table: ByBearing, names: Sequence[str], others: Iterable[str] = ()) -> list[Problem]:
    given = [*(table.model_fields_set - {"disc"}), *(table.__pydantic_extra__ or {})]
    known = [*others, *names]
    return [
        Problem((*path, key), f"unknown key; {did_you_mean(key, known, 'the keys here are')}")
        for key in dict.fromkeys(given) if key not in names
    ]  # fmt: skip
