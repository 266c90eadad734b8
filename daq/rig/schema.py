"""The JSON schema of a rig file, for editors and other programs."""

from __future__ import annotations

from typing import Any

from daq.base.console.output import Output
from estimator.effects import CATALOGUE
from estimator.model import BEARING_NODES

from .rig_file import RigFile


def rig_schema() -> dict[str, Any]:
    """JSON Schema (2020-12) of a rig file. The catalogue's effects and their parameters are in it."""
    out: dict[str, Any] = RigFile.model_json_schema()
    value = {"$ref": "#/$defs/SettingTable"}
    place = {"anyOf": [{"type": "string"}, {"items": {"type": "string"}, "type": "array"}]}
    model = out["$defs"]["ModelTable"]
    for effect in CATALOGUE.values():
        own = {p.name: value | {"description": f"{p.unit}: {p.description}"} for p in effect.parameters}
        nodes = {
            node: {
                "type": "object",
                "properties": own | {d: {"type": "object", "properties": own} for d in ("x", "y")},
                "additionalProperties": False,
            }
            for node in BEARING_NODES
        }
        model["properties"][effect.name] = {
            "type": "object",
            "description": effect.equation,
            "properties": own | {"at": place, "fixed": {"type": "boolean"}, "value": value} | nodes,
        }
    model["properties"]["effects"]["items"] = {"type": "string", "examples": list(CATALOGUE)}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **out, "title": "Rotorscope rig file"}


def schema(output: Output) -> None:
    import json

    text = json.dumps(rig_schema(), indent=1, ensure_ascii=False)
    if output.json is None:
        output.say(text)
    else:
        output.result(rig_schema())
