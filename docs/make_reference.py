"""Writes the reference pages from the code: `python docs/make_reference.py`. A test compares them.

commands.md : every command with its options, from the command line itself. rig-file.md : every key, from the schema.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

DOCS_FOLDER = Path(__file__).resolve().parent
MAX_ENUM = 12  # values that are listed


def commands_page() -> str:
    """Every command: what it does, its arguments and options."""
    import typer.main

    from daq.commands.cli.app import ABOUT_TEXT, EPILOG_TEXT, application

    group: Any = typer.main.get_command(application())
    lines = ["# Commands", "", ABOUT_TEXT, "", EPILOG_TEXT, ""]
    for name, command in group.commands.items():
        lines += [f"## {name}", "", " ".join((command.help or "").split()), ""]
        usage = [p.metavar or p.name.upper() for p in command.params if p.param_type_name == "argument"]
        required = [f"{p.opts[0]} {p.metavar or ''}".strip() for p in command.params
                    if p.param_type_name == "option" and p.required]  # fmt: skip
        lines += [f"    {' '.join(['rotorscope', name, *usage, *required, '[OPTIONS]'])}", ""]
        lines += ["| argument or option | what |", "|---|---|"]
        for p in command.params:
            shown = p.metavar or "" if p.param_type_name == "argument" else ", ".join(p.opts)
            if p.param_type_name == "option" and not p.is_flag:
                shown += " " + (p.metavar or "VALUE").replace("|", " or ")
            none = p.required or p.default in (None, False, ()) or callable(p.default)
            default = "" if none else f" Default: {p.default}."
            lines.append(f"| `{_cell(shown)}` | {_cell(' '.join((getattr(p, 'help', '') or '').split()) + default)} |")
        lines.append("")
    return "\n".join(lines)


def rig_page() -> str:
    """Every table and key of a rig file."""
    schema = json.loads((DOCS_FOLDER / "rig.schema.json").read_text("utf-8"))
    lines = [
        "# The rig file, key by key",
        "",
        "TOML. Unknown keys are errors; `rotorscope check RIG` names each with its line.",
        "The schema for editors is [rig.schema.json](rig.schema.json). Effects have tables of their own, see",
        "[effects](effects.md).",
        "",
    ]
    lines += _table("(top)", schema, schema, [])
    return "\n".join(lines)


def _table(title: str, table: dict[str, Any], schema: dict[str, Any], done: list[str]) -> list[str]:
    if title in done:
        return []
    done.append(title)
    lines = [f"## `{title}`" if title != "(top)" else "## Top level", ""]
    if table.get("description"):
        lines += [" ".join(table["description"].split()), ""]
    lines += ["| key | type | default | what |", "|---|---|---|---|"]
    inner: list[tuple[str, dict[str, Any]]] = []
    for key, value in table.get("properties", {}).items():
        if title == "[model]" and "properties" in value and key not in ("linear", "custom"):
            continue  # the tables of the effects
        kind, tables = _type(value, schema)
        default = value.get("default")
        shown = "" if default is None or isinstance(default, dict | list) else _cell(json.dumps(default))
        required = "required" if key in table.get("required", ()) else shown
        what = " ".join(str(value.get("description", "")).split())
        lines.append(f"| `{key}` | {kind} | {required} | {_cell(what)} |")
        prefix = "" if title == "(top)" else title.strip("[]") + "."
        inner += [(f"[{prefix}{key}]", found) for found in tables]
    lines.append("")
    for name, found in inner:
        lines += _table(name, found, schema, done)
    return lines


def _type(value: dict[str, Any], schema: dict[str, Any]) -> tuple[str, list[dict[str, Any]]]:
    """In words, and the tables that it may be."""
    if "$ref" in value:
        found = schema["$defs"][value["$ref"].rsplit("/", 1)[1]]
        if "anyOf" in found and "properties" not in found:
            return _type(found, schema)
        return "table", [found]
    if "anyOf" in value and "properties" not in value:
        parts = [_type(part, schema) for part in value["anyOf"] if part.get("type") != "null"]
        return " or ".join(dict.fromkeys(kind for kind, _ in parts)), [t for _, tables in parts for t in tables]
    if "const" in value:
        return f"`{value['const']}`", []
    if "enum" in value:
        return ", ".join(f"`{v}`" for v in value["enum"][:MAX_ENUM]), []
    if value.get("type") == "array":
        kind, tables = _type(value.get("items", {}), schema)
        return f"list of {kind}", tables
    if "properties" in value:
        return "table", [value]
    signs = {"exclusiveMinimum": "above", "minimum": "from", "maximum": "to"}
    limits = [f"{sign} {value[key]:g}" for key, sign in signs.items() if key in value]
    return " ".join([str(value.get("type", "any")), *limits]).replace("object", "table").replace("string", "text"), []


def _cell(text: str) -> str:
    return str(text).replace("|", "\\|")


def pages() -> dict[str, str]:
    """File name -> text."""
    return {"commands.md": commands_page().rstrip() + "\n", "rig-file.md": rig_page().rstrip() + "\n"}


if __name__ == "__main__":
    sys.path.insert(0, str(DOCS_FOLDER.parent))
    for name, text in pages().items():
        (DOCS_FOLDER / name).write_text(text, "utf-8")
