"""The words and tables of a comparison as Markdown, for the viewer: what the report has as HTML."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from daq.report import layers as layers
from daq.report import words as words
from daq.report.figures import model_name
from daq.report.first_numbers import severity_rows
from daq.report.numbers import fixed, number, odds, parameter, percent
from daq.report.page import described, worth_showing

Json = Mapping[str, Any]


def documents(
    title: str, comparison: Json | None, before: Json | None, diagnoses: Sequence[Json], ladder: Sequence[Json],
    notes: Sequence[str], seen: Json | None = None,
) -> dict[str, str]:  # fmt: skip
    """Heading -> Markdown, in the order of the tabs."""
    said = [*notes, *(seen or {}).get("said", ())]
    levels = {name: own for name, own in (seen or {}).get("record", {}).get("channels", {}).items() if "unit" in own}
    said += [table(*severity_rows(levels))] if levels and comparison is None else []
    out = {"Summary": summary(title, comparison, diagnoses, ladder, said)}
    if rows := words.regions(before, comparison):
        cells = [
            (n, r["channel"], r["against"].replace("_", " "), r["region"], percent(r["share_percent"])) for n, r in rows
        ]
        heads = ("model", "channel", "against", "region", "share of the missing force")
        out["Map"] = f"# {words.heading_of_map(comparison)}\n\n" + table(heads, cells)
    units = {name: own["unit"] for name, own in levels.items()}
    if rows_of_layers := layers.lines(diagnoses[0] if diagnoses else seen or {}, units):
        said_of = [f"**{name}** {line}" if name else line for name, line in rows_of_layers]  # a table would be cut
        out["Layers"] = "\n\n".join(["# What the record shows", *said_of])
    if diagnoses:
        out["Diagnosis"] = "\n\n".join(diagnosed(d) for d in diagnoses)
    if values := (comparison or {}).get("parameters"):
        pairs = [(name, parameter(p)) for name, p in values.items()]
        out["Parameters"] = "# Parameters\n\n" + table(("parameter", "value and 95 % interval"), pairs)
    return out


def summary(
    title: str, comparison: Json | None, diagnoses: Sequence[Json], ladder: Sequence[Json], notes: Sequence[str]
) -> str:
    lines = [f"# {title}", *words.summary(comparison, diagnoses, ladder), *notes]
    if ladder:
        cells = [
            (model_name(s["effects"]), fixed(s["heldout_nll"]), percent(s["missing_force_percent"]["value"]))
            for s in ladder
        ]
        lines.append(table(("model", "held-out NLL", "missing force"), cells))
    if comparison is None:
        return "\n\n".join([*lines, "Grey: measured."])
    lines.append("Blue: the model now. Orange: the model before (step back on the time line). Grey: measured.")
    return "\n\n".join(lines)


def diagnosed(diagnosis: Json) -> str:
    """One diagnosis: verdict, what to check, ranking, what could have been seen."""
    verdict = diagnosis["verdict"]
    lines = [f"# Verdict: {verdict}"]
    effect = described(verdict)
    if effect is not None:
        lines += [f"`{effect.equation}`", f"Signature: {effect.signature}"]
        lines += [f"**What to check on the machine:** {effect.on_machine}"]
        lines += [f"**What separates it from the runner-up:** {diagnosis.get('separates') or effect.distinguish}"]
    if rows := worth_showing(diagnosis):
        cells = [
            (r["effect"], words.listed(r["at"]), number(r["heldout_gain"]), odds(r["p_value"]),
             percent(r["missing_force_after_percent"]), words.detectable(r))
            for r in rows
        ]  # fmt: skip
        lines.append(table(("effect", "at", "gain, nats", "p", "missing after", "can be seen from"), cells))
    return "\n\n".join([*lines, *diagnosis.get("messages", ())])


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(str(c).replace("|", "\\|") for c in line) + " |" for line in lines)
